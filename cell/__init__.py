"""A robot cell that identifies each cable it holds and inserts it.

From Python it offers the commands `fit`, `compare`, `diagnose` (`cell.diagnose_together`: of
several studies), `suggest`, `power` and `learn`; `cell.read_study` and `cell.write_study` are the
file form of a study.  `import`, `look`, `study`, `discover`, `effects` and `export` are commands
only.  Lengths are in m, times in s, angles in rad.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cell.api.lab import compare, diagnose, fit, power, read_study, suggest
    from cell.api.line import LearnResult, learn
    from cell.api.results import (
        CompareResult,
        DiagnoseResult,
        FitResult,
        PowerResult,
        SuggestResult,
    )
    from cell.api.several import TogetherResult, diagnose_together
    from cell.cable.geometry import Cable, Motion
    from cell.study.data import Markers, Study, Trial, Wrench, WrenchSensor
    from cell.study.folder import write_study

#: Public names, and where each is: it is imported when it is first used.
_PLACES = {
    name: place
    for place, names in {
        "cell.api.lab": ("compare", "diagnose", "fit", "power", "read_study", "suggest"),
        "cell.api.line": ("LearnResult", "learn"),
        "cell.api.results": (
            "CompareResult",
            "DiagnoseResult",
            "FitResult",
            "PowerResult",
            "SuggestResult",
        ),
        "cell.api.several": ("TogetherResult", "diagnose_together"),
        "cell.cable.geometry": ("Cable", "Motion"),
        "cell.study.data": ("Markers", "WrenchSensor", "Study", "Trial", "Wrench"),
        "cell.study.folder": ("write_study",),
    }.items()
    for name in names
}

__all__ = [
    "Cable",
    "CompareResult",
    "DiagnoseResult",
    "FitResult",
    "LearnResult",
    "Markers",
    "Motion",
    "PowerResult",
    "Study",
    "SuggestResult",
    "TogetherResult",
    "Trial",
    "Wrench",
    "WrenchSensor",
    "compare",
    "diagnose",
    "diagnose_together",
    "fit",
    "learn",
    "power",
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
