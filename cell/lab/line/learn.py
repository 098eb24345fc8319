"""Learning the effects that a line's model lacks, with their parameters, from recorded cables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial

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

#: Most cables that a model is fitted to.
FITTED_TO = 12


@dataclass(frozen=True)
class _Unidentified:
    """Why a cable cannot be identified; `by_model`: the model may lack an effect."""

    why: str
    by_model: bool = False


def _identified(
    cable: Cable, options: IdentifyOptions, cycle: RecordedCycle
) -> Identified | _Unidentified:
    """A cycle's cable identified from its hold, or why that failed."""
    if (unfit := _unfit(cycle.study)) is not None:
        return _Unidentified(unfit)
    trial = cycle.held or cycle.study.trials[0]
    try:
        return identify(trial, cycle.study.arc_length_m, cable, options=options)
    except CableRejectedError as error:
        return _Unidentified(str(error), error.reason is Reason.NO_FIT)


def _unfit(study: Study) -> str | None:
    """Why a study is unsuitable for learning a line's model; None = it is suitable."""
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
    with closing(executor.map(partial(_identified, cable, options), cycles)) as results:
        for cycle, result in zip(cycles, results, strict=True):
            identified = result.value
            if isinstance(identified, _Unidentified):
                notes = budget.left_out if identified.by_model else budget.cables
                notes.append(f"{cycle.name}: it cannot be identified, {identified.why}")
                continue
            if any(t.wrench is not None for t in cycle.study.trials):
                budget.cables.append(f"{cycle.name}: its wrench; a line weighs markers alone")
            progress(f"identified {cycle.name}")
            usable.append((cycle, identified))
    if not usable:
        why = "; ".join(dict.fromkeys([*budget.left_out, *budget.cables]))
        raise ValueError(f"none of these cables can be learned from: {why}")
    return usable


def learned_from(
    usable: Sequence[tuple[RecordedCycle, Identified]], budget: LearningBudget
) -> list[tuple[RecordedCycle, Identified]]:
    """The cycles used for learning, at most `FITTED_TO`, the most informative first.

    Measurements made to distinguish effects come first, then executions, as they are needed for
    forecasts; among these, the cables with the largest model error first.
    """

    def rank(pair: tuple[RecordedCycle, Identified]) -> tuple[bool, bool, float]:
        cycle, identified = pair
        return cycle.held is not None, cycle.executed is None, -identified.model_error_m

    chosen: list[tuple[RecordedCycle, Identified]] = []
    omitted: list[str] = []
    for pair in sorted(usable, key=rank):
        if len(chosen) == FITTED_TO:
            omitted.append(pair[0].name)
        elif original := _same_cycle(pair[0], [cycle for cycle, _ in chosen]):
            budget.cables.append(
                f"{pair[0].name}: the same recording as {original}, their noise is the same; "
                "it is counted once, record another cable"
            )
        else:
            chosen.append(pair)
    if omitted:
        named = ", ".join(sorted(omitted))
        budget.cables.append(f"{named}: {FITTED_TO} cables are learned from at most")
    return chosen


def _same_cycle(cycle: RecordedCycle, earlier: Sequence[RecordedCycle]) -> str:
    """Name of the first of other cycles that has a recording of this one; empty = none."""
    known = [(other.name, t.markers) for other in earlier for t in other.study.trials]
    matches = originals([t.markers for t in cycle.study.trials], [markers for _, markers in known])
    return next((known[number][0] for number in matches if number is not None), "")


#: Most effects that are added one after another.
MOST_EFFECTS = 2
#: A model is complete for the line if its error exceeds the noise by less than this, m.
NEGLIGIBLE_M = 5e-6
#: Largest deviation attributed to chance, standard deviations.
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

    One at first; a second if the residual of the first exceeds the noise.
    known     callback for intermediate results: error of the present model, first effect
    budget    of simulations; None = the usual one
    executor  of the identifications; None = all cores of this computer
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
        np.array([identified.mean for _, identified in chosen]),
        tuple(e for e in library.values() if e not in base.effects),
        budget,
        progress,
    )
    result = _learned(space, known)
    left_out, cables = tuple(budget.left_out), tuple(budget.cables)
    return replace(result, left_out=left_out, cables_left_out=cables)


def _learned(space: CablesSpace, known: Callable[[LearningResult], None]) -> LearningResult:
    """The effects that the present model of some cables lacks."""
    if (shifted := along_lines(space.without_effects.baseline)) is not None:
        space = replace(space, prepared=tuple(shifted))
    known(without_effects := space.without_effects)
    if negligible(without_effects.baseline):
        return without_effects
    for step, (result,) in enumerate(levels(without_effects, space.extended, space.select)):
        result = space.along_its_lines(result)
        enough = result.best is not None and negligible(result.best.fit)
        if enough or step == min(MOST_EFFECTS, len(space.others)):
            break
        if step:
            known(result)
    return result


def negligible(fit: SharedFit) -> bool:
    """Whether error beyond noise, and mean offset of the ends, are negligible for the line.

    The fit of each cable tolerates an offset of its end, which may hide a common offset of all
    cables: its mean must not be significant.
    """
    if fit.rms_m**2 - fit.noise_m**2 >= NEGLIGIBLE_M**2:
        return False
    return end_offset_stds(fit) < CHANCE


def end_offset_stds(fit: SharedFit) -> float:
    """Mean offset of detected from predicted cable ends, along the cable, in its own std."""
    offset_m = fit.end_offset_m
    return abs(float(offset_m.mean())) * float(np.sqrt(len(offset_m))) / fit.end_std_m
