"""Learning the effects that a line's model lacks, with their parameters, from recorded cables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.effects.base import Effect
from cell.cable.geometry import GRAVITY_M_PER_S2, Cable
from cell.cable.solver import threads
from cell.files.words import counted
from cell.identify.identified import Identified
from cell.identify.individual import CableRejectedError, IdentifyOptions, Reason, identify
from cell.lab.data.cycles import RecordedCycle
from cell.lab.data.prepared import all_fitted
from cell.lab.fit.shared import SharedFit, along_lines, prepared_cycle
from cell.lab.line.cables_space import CablesSpace, Progress
from cell.lab.line.effect_fit import LearningBudget, LearningResult
from cell.lab.search.stepwise import levels
from cell.study.data import Study
from cell.study.same_recording import originals
from cell.workers.executor import Executor
from cell.workers.here import this_computer

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
    """Cycles with the identified model of their cable; the budget notes cycles that have none."""
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
    """The cycles used for learning, at most `FITTED_TO`, the most informative first.

    What was measured to tell effects apart comes first, then executions, which are judged by; of
    these, those that the model misses most tell most.
    """

    def rank(pair: tuple[RecordedCycle, Identified]) -> tuple[bool, bool, float]:
        cycle, found = pair
        return cycle.held is not None, cycle.executed is None, -found.model_error_m

    chosen: list[tuple[RecordedCycle, Identified]] = []
    more: list[str] = []
    for pair in sorted(usable, key=rank):
        if len(chosen) == FITTED_TO:
            more.append(pair[0].name)
        elif original := _same_cycle(pair[0], [cycle for cycle, _ in chosen]):
            budget.cables.append(
                f"{pair[0].name}: the same recording as {original}, their noise is the same; "
                "it is counted once, record another cable"
            )
        else:
            chosen.append(pair)
    if more:
        named = ", ".join(sorted(more))
        budget.cables.append(f"{named}: {FITTED_TO} cables are learned from at most")
    return chosen


def _same_cycle(cycle: RecordedCycle, others: Sequence[RecordedCycle]) -> str:
    """Name of the first of other cycles with a recording that this one has too; empty = none."""
    known = [(other.name, t.markers) for other in others for t in other.study.trials]
    found = originals([t.markers for t in cycle.study.trials], [markers for _, markers in known])
    return next((known[number][0] for number in found if number is not None), "")


#: Effects that are added one after another, at most.
MOST_EFFECTS = 2
#: A model is complete for the line if it misses by no more than this above the noise, m.
NEGLIGIBLE_M = 5e-6
#: Standard deviations that are still chance.
CHANCE = 3.0


def learn(
    cycles: Sequence[RecordedCycle],
    cable: Cable,
    options: IdentifyOptions,
    library: Mapping[str, type[Effect]],
    progress: Progress = lambda _: None,
    known: Callable[[LearningResult], None] = lambda _: None,
    budget: LearningBudget | None = None,
    executor: Executor | None = None,
) -> LearningResult:
    """The effects that the model of `options` lacks, from all cycles together.

    One at first; a second if the first leaves more than the noise.
    known     is told of what is certain before the end: what the present model misses, the first
              effect
    budget    of simulations, the usual one if none is given
    executor  who identifies the cables; None = all cores of this computer
    raises  ValueError: no cable can be identified; NoiseUnknownError
    """
    budget = LearningBudget() if budget is None else budget
    executor = this_computer(min(threads(), len(cycles))) if executor is None else executor
    usable = identified_cables(cycles, cable, options, progress, budget, executor)
    chosen = learned_from(usable, budget)
    base = options.kind.space(cable, chosen[0][0].study.gravity_m_per_s2)
    space = CablesSpace(
        tuple(cycle for cycle, _ in chosen),
        tuple(prepared_cycle(all_fitted(cycle.study), budget.work) for cycle, _ in chosen),
        base,
        np.array([found.mean for _, found in chosen]),
        tuple(e for e in library.values() if e not in base.effects),
        budget,
        progress,
    )
    result = _learned(space, known)
    left_out, cables = tuple(budget.left_out), tuple(budget.cables)
    return replace(result, left_out=left_out, cables_left_out=cables)


def _learned(space: CablesSpace, known: Callable[[LearningResult], None]) -> LearningResult:
    """The effects that the present model of some cables lacks."""
    if (moving := along_lines(space.fit_without_effects().baseline)) is not None:
        space = replace(space, prepared=tuple(moving))
    none = result = space.fit_without_effects()
    known(none)
    if negligible(none.baseline):
        return none
    for step, (result,) in enumerate(levels(none, space.extended, space.kept)):
        result = space.along_its_lines(result)
        enough = result.best is not None and negligible(result.best.fit)
        if enough or step == min(MOST_EFFECTS, len(space.others)):
            break
        if step:
            known(result)
    return result


def negligible(fit: SharedFit) -> bool:
    """Whether the error beyond the noise is negligible for the line, and the ends are in place.

    How far along it a cable's end is seen is allowed for in each cable alone, and hides there how
    far all of them are: that must be no more than chance, too.
    """
    if fit.rms_m**2 - fit.noise_m**2 >= NEGLIGIBLE_M**2:
        return False
    return ends_seen_beyond(fit) < CHANCE


def ends_seen_beyond(fit: SharedFit) -> float:
    """Mean offset of detected from predicted cable ends, along the cable, in its own std."""
    beyond_m = fit.end_seen_beyond_m
    return abs(float(beyond_m.mean())) * float(np.sqrt(len(beyond_m))) / fit.end_std_m
