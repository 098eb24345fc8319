"""A robot cell that identifies each cable it holds and inserts it.

From Python it offers what the lab's commands do: `cell.read_study`, `cell.fit`, `cell.compare`,
`cell.diagnose`, `cell.suggest`.  Lengths are in m, times in s, angles in rad.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cell.api.lab import compare, diagnose, fit, read_study, suggest
    from cell.api.results import CompareResult, DiagnoseResult, FitResult, SuggestResult
    from cell.cable.geometry import Cable, Motion
    from cell.study.data import Markers, Study, Trial
    from cell.study.folder import write_study

#: Public names, and where each is: it is imported when it is first used.
_PLACES = {
    **dict.fromkeys(("compare", "diagnose", "fit", "read_study", "suggest"), "cell.api.lab"),
    **dict.fromkeys(
        ("CompareResult", "DiagnoseResult", "FitResult", "SuggestResult"), "cell.api.results"
    ),
    **dict.fromkeys(("Cable", "Motion"), "cell.cable.geometry"),
    **dict.fromkeys(("Markers", "Study", "Trial"), "cell.study.data"),
    "write_study": "cell.study.folder",
}

__all__ = [
    "Cable",
    "CompareResult",
    "DiagnoseResult",
    "FitResult",
    "Markers",
    "Motion",
    "Study",
    "SuggestResult",
    "Trial",
    "compare",
    "diagnose",
    "fit",
    "read_study",
    "suggest",
    "write_study",
]


def __getattr__(name: str) -> object:
    if name not in _PLACES:
        raise AttributeError(f"module 'cell' has no attribute {name!r}")
    found = getattr(import_module(_PLACES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
