"""The joint diagnosis of several studies as a function, `diagnose_together`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from cell.api.lab import (
    StudyOrFolder,
    Tell,
    check_study_argument,
    effect_names,
    examined,
    opened_study,
    rules_with,
    set_up_opened,
    several,
    silent,
)
from cell.api.results import Row, Shown
from cell.cable.solver import threads
from cell.files.table import TableData
from cell.lab.data.named_effects import EffectSelection, select_for_diagnosis
from cell.lab.data.rules import DEFAULT_RULES, Rules
from cell.lab.data.work import Progress, no_progress
from cell.lab.line.together import Together, check_names, together
from cell.lab.report.line_tables import together_page, together_parts
from cell.lab.search.fit_cache import FitCache
from cell.lab.verdict.conclusion import Examination
from cell.study.data import Study
from cell.study.independence import without_copies_of
from cell.workers.executor import Executor
from cell.workers.here import this_computer


@dataclass(frozen=True, eq=False, repr=False)
class TogetherResult(Shown):
    """Joint diagnosis of several studies, by `cell.diagnose_together`."""

    together: Together

    def parts(self) -> Sequence[str | TableData]:
        """The verdict, each study's part, parameters of all cables, and the tested effects."""
        return together_parts(self.together)

    def to_json(self) -> dict[str, Any]:
        """As `cell diagnose STUDY STUDY -o` writes it (cable-together/1)."""
        return self.together.to_json()

    def rows(self) -> list[Row]:
        """A row per study: its own verdict, and its evidence for the joint effects."""
        return [asdict(part) for part in self.together.studies]

    def write_report(self, path: Path | str) -> None:
        """Write the same as an HTML page."""
        from cell.files.page import write_page

        write_page(together_page(self.together), Path(path))


def diagnose_together(
    studies: Sequence[StudyOrFolder],
    *,
    effects: Sequence[Path | str] = (),
    known: Sequence[Path | str] = (),
    checks: Sequence[Path | str] = (),
    config: Path | str | None = None,
    progress: Progress = no_progress,
) -> TogetherResult:
    """Find the effect that several cables lack, each with its own parameters and noise.

    studies  two or more, of different names
    other arguments and errors as of `diagnose`
    """
    selection = select_for_diagnosis(effect_names(effects), effect_names(known, "known"))
    rules = rules_with(several(checks))
    return joint_diagnosis(several(studies), selection, config, progress, rules=rules)


def joint_diagnosis(
    studies: Sequence[StudyOrFolder],
    selection: EffectSelection,
    config: Path | str | None,
    progress: Progress,
    tell: Tell = silent,
    rules: Rules = DEFAULT_RULES,
    executor: Executor | None = None,
) -> TogetherResult:
    """The joint diagnosis of several studies; each is first diagnosed alone.

    executor  runs the diagnoses; None = all cores of this computer
    """
    names = _names(studies)
    if not names:
        raise ValueError("studies: there is none; give two or more")
    check_names(names)
    opened: list[Study] = []
    for study, name in zip(studies, names, strict=True):
        named = replace(opened_study(study), name=name)
        opened.append(without_copies_of(named, opened))
    made_ready = [set_up_opened(study, selection, None, config, tell=tell) for study in opened]
    executor = this_computer(min(threads(), len(names))) if executor is None else executor
    each = []
    progress("diagnosing each study", 0, len(names))
    with closing(executor.map(_Diagnosed(rules), made_ready)) as results:
        for result in results:
            each.append(result.value)
            progress("diagnosing each study", len(each), len(names))
    progress("comparing the studies")
    return TogetherResult(together(each))


@dataclass(frozen=True)
class _Diagnosed:
    """Diagnosis of one study alone, from its fits."""

    rules: Rules

    def __call__(self, fits: FitCache) -> Examination:
        examination = examined(fits, self.rules)
        examination.fits.work.renew()
        return examination


def _names(studies: Sequence[StudyOrFolder]) -> list[str]:
    """Names of studies or of their folders; with the parent folder where names are equal."""
    for study in studies:
        check_study_argument(study)
    places = [Path(s.name) if isinstance(s, Study) else Path(s).resolve() for s in studies]
    short = [p.name for p in places]
    names = [p.name if short.count(p.name) == 1 else f"{p.parent.name}/{p.name}" for p in places]
    if len(set(places)) < len(places):
        twice = next(str(s) for s, p in zip(studies, places, strict=True) if places.count(p) > 1)
        raise ValueError(f"{twice}: is given twice; give each study once")
    return names
