"""Several studies together, as a function: diagnose_together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cell.api.lab import StudyOrFolder, Tell, examined, rules_with, set_up, silent
from cell.api.shown import Row, Shown
from cell.files.table import TableData
from cell.lab.data.progress import Progress, no_progress
from cell.lab.data.selection import EffectSelection, select_for_diagnosis
from cell.lab.data.thresholds import DEFAULT_RULES, Rules
from cell.lab.many.results import Together
from cell.lab.many.together import Examined, check_names, together
from cell.lab.report.together_tables import together_page, together_parts
from cell.study.data import Study


@dataclass(frozen=True, eq=False, repr=False)
class TogetherResult(Shown):
    """What several studies say together, by `cell.diagnose_together`."""

    together: Together

    def parts(self) -> Sequence[str | TableData]:
        """The answer, each study's part, parameters of all cables, and what was tried."""
        return together_parts(self.together)

    def to_json(self) -> dict[str, Any]:
        """As `cell diagnose STUDY STUDY -o` writes it (cable-together/1)."""
        return self.together.to_json()

    def rows(self) -> list[Row]:
        """A row per study: its verdict alone, and what it says of the effects found."""
        return [asdict(part) for part in self.together.studies]

    def write_report(self, path: Path | str) -> None:
        """Write the same as an HTML page."""
        from cell.files.page import write_page

        write_page(together_page(self.together), Path(path))


def diagnose_together(
    studies: Sequence[StudyOrFolder],
    *,
    effects: Sequence[str] = (),
    known: Sequence[str] = (),
    checks: Sequence[Path | str] = (),
    config: Path | str | None = None,
    progress: Progress = no_progress,
) -> TogetherResult:
    """Find the effect that several cables lack, each with its own parameters and noise.

    studies  two or more, of different names
    other arguments and errors as of `diagnose`
    """
    selection = select_for_diagnosis(effects, known)
    return found_together(studies, selection, config, progress, rules=rules_with(checks))


def found_together(
    studies: Sequence[StudyOrFolder],
    selection: EffectSelection,
    config: Path | str | None,
    progress: Progress,
    tell: Tell = silent,
    rules: Rules = DEFAULT_RULES,
) -> TogetherResult:
    """Each study diagnosed alone, then all together."""
    names = _names(studies)
    check_names(names)
    ready = []  # all of them, before the first diagnosis: what is wrong with one is told at once
    for number, (study, name) in enumerate(zip(studies, names, strict=True), 1):
        told = _prefixed(progress, f"{name} ({number} of {len(names)})")
        ready.append(set_up(study, selection, None, config, told, tell))
    each = [Examined(n, examined(fits, rules)) for n, fits in zip(names, ready, strict=True)]
    progress("comparing the studies")
    return TogetherResult(together(each, rules))


def _prefixed(progress: Progress, name: str) -> Progress:
    def told(text: str, done: int = 0, total: int = 0) -> None:
        progress(f"{name}: {text}", done, total)

    return told


def _names(studies: Sequence[StudyOrFolder]) -> list[str]:
    """Names of studies or of their folders; with the folder above where that is needed."""
    places = [Path(s.name) if isinstance(s, Study) else Path(s).resolve() for s in studies]
    short = [p.name for p in places]
    names = [p.name if short.count(p.name) == 1 else f"{p.parent.name}/{p.name}" for p in places]
    if len(set(places)) < len(places):
        twice = next(str(s) for s, p in zip(studies, places, strict=True) if places.count(p) > 1)
        raise ValueError(f"{twice}: is given twice; give each study once")
    return names
