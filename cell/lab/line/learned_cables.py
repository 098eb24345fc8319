"""The recorded cables that a line's model is learned from, each identified by itself."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from cell.cable.geometry import GRAVITY_M_PER_S2, Cable
from cell.files.words import counted
from cell.identify.identified import Identified
from cell.identify.individual import CableRejectedError, IdentifyOptions, Reason, identify
from cell.lab.data.cycles import RecordedCycle
from cell.lab.line.cables_space import Progress
from cell.lab.line.effect_fit import LearningBudget
from cell.study.data import Study
from cell.workers.executor import Executor

#: Cables that a model is fitted to, at most.
FITTED_TO = 12


@dataclass(frozen=True)
class _Unidentified:
    """Why a cable cannot be identified, and whether by the model: then it may lack something."""

    why: str
    by_model: bool = False


@dataclass(frozen=True)
class _IdentifiedBy:
    """A cycle's cable as its hold shows it, or why it cannot be identified."""

    cable: Cable
    options: IdentifyOptions

    def __call__(self, cycle: RecordedCycle) -> Identified | _Unidentified:
        if (unfit := _unfit(cycle.study)) is not None:
            return _Unidentified(unfit)
        trial = cycle.held or cycle.study.trials[0]
        try:
            return identify(trial, cycle.study.arc_length_m, self.cable, options=self.options)
        except CableRejectedError as error:
            return _Unidentified(str(error), error.reason is Reason.NO_FIT)


def _unfit(study: Study) -> str | None:
    """Why no line's model can be learned from a study; None = it can."""
    if not np.allclose(study.gravity_m_per_s2, GRAVITY_M_PER_S2, rtol=0.01):
        return f"gravity is {list(study.gravity_m_per_s2)}, a line has {list(GRAVITY_M_PER_S2)}"
    if bent := [t for t in study.trials if t.bent]:
        return (
            f"trial {bent[0].name} has `start: {bent[0].start}`, a line's cables begin at rest; "
            "cell diagnose takes several studies"
        )
    if not any(np.isfinite(t.markers.xy_m).all(axis=2).any() for t in study.trials):
        return "one coordinate is measured, a line needs both; cell diagnose takes several studies"
    return None


def identified_cables(
    cycles: Sequence[RecordedCycle],
    cable: Cable,
    options: IdentifyOptions,
    progress: Progress,
    budget: LearningBudget,
    executor: Executor,
) -> list[tuple[RecordedCycle, Identified]]:
    """Cycles with what each says of its own cable; what says nothing is left out, and told."""
    usable = []
    progress(f"identifying {counted(len(cycles), 'cable')}")
    with closing(executor.map(_IdentifiedBy(cable, options), cycles)) as results:
        for cycle, result in zip(cycles, results, strict=True):
            found = result.value
            if isinstance(found, _Unidentified):
                told = budget.left_out if found.by_model else budget.cables
                told.append(f"{cycle.name}: it cannot be identified, {found.why}")
                continue
            if any(t.wrench is not None for t in cycle.study.trials):
                budget.cables.append(f"{cycle.name}: its wrench; a line weighs markers alone")
            progress(f"identified {cycle.name}")
            usable.append((cycle, found))
    if not usable:
        why = "; ".join(dict.fromkeys([*budget.left_out, *budget.cables]))
        raise ValueError(f"none of these cables can be learned from: {why}")
    return usable


def learned_from(
    usable: Sequence[tuple[RecordedCycle, Identified]], budget: LearningBudget
) -> list[tuple[RecordedCycle, Identified]]:
    """Those that are learned from.

    What was measured to tell effects apart comes first, then executions, which are judged by; of
    these, those that the model misses most tell most.
    """

    def rank(pair: tuple[RecordedCycle, Identified]) -> tuple[bool, bool, float]:
        cycle, found = pair
        return cycle.held is not None, cycle.executed is None, -found.model_error_m

    ranked = sorted(usable, key=rank)
    if more := ranked[FITTED_TO:]:
        named = ", ".join(sorted(cycle.name for cycle, _ in more))
        budget.cables.append(f"{named}: {FITTED_TO} cables are learned from at most")
    return ranked[:FITTED_TO]
