"""Learning the effects that a line's model lacks, with their parameters, from recorded cables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.cable.geometry import GRAVITY_M_PER_S2, Cable
from cell.cable.solver import threads
from cell.files.words import counted
from cell.identify.gauss_newton import UNSIMULATED
from cell.identify.identified import Identified
from cell.identify.individual import CableRejectedError, IdentifyOptions, Reason, identify
from cell.identify.parameters import ParameterSpace
from cell.lab.data.cycles import RecordedCycle
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.thresholds import SIGNIFICANCE
from cell.lab.fit.fitting import Rival, space_with
from cell.lab.fit.shared import SharedFit, Spread, along_lines, fit_shared, prepared_cycle
from cell.lab.line.cables_space import SECOND, CablesSpace, Progress, on_all
from cell.lab.line.effect_fit import EffectFit, LearningBudget, is_tied
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


#: Cables that the library is tried on, at most.
TRIED_ON = 4
#: Effects that are added one after another, at most.
MOST_EFFECTS = 2
#: A model is complete for the line if it misses by no more than this above the noise, m.
NEGLIGIBLE_M = 5e-6
#: Standard deviations that are still chance.
CHANCE = 3.0


@dataclass(frozen=True)
class CycleEvidence:
    """Evidence of one cycle for or against the effect that was added last.

    fall    of its own χ² over the inflation: positive speaks for the effect
    value   of its first parameter as this cable alone would have it
    std     of that
    """

    cycle: str
    fall: float
    value: float
    std: float


@dataclass(frozen=True, eq=False)
class LearningResult:
    """The result of learning from many cables: the missing effects, or that none is missing.

    cycles    that were learned from, as in `cycle_evidence`
    baseline  the present model, fitted to them
    ranking   effects that were refitted given those before, the likeliest first
    best      the likeliest, fitted to all of `cycles`; None = nothing significant is missing
    tied      effects that explain as much as the last of `best`
    spread    of the first parameter of each effect of `best` between cables
    cycle_evidence   for and against the last effect of `best`
    simpler   the result without the last effect; None = there is one effect, or none
    left_out  what the limit of work has left out, and cables of which the model is none
    cables_left_out   other cables that were not learned from, or not wholly, and why
    """

    cycles: tuple[RecordedCycle, ...]
    baseline: SharedFit
    ranking: tuple[EffectFit, ...] = ()
    best: EffectFit | None = None
    tied: tuple[str, ...] = ()
    spread: tuple[Spread, ...] = ()
    cycle_evidence: tuple[CycleEvidence, ...] = ()
    simpler: LearningResult | None = None
    left_out: tuple[str, ...] = ()
    cables_left_out: tuple[str, ...] = ()

    @property
    def between(self) -> FloatArray:
        """(m,) variance of each shared parameter between cables."""
        assert self.best is not None
        variance = np.zeros(len(self.best.names))
        for i, spread in zip(self.best.firsts, self.spread, strict=True):
            variance[i] = spread.tau**2
        return variance

    @property
    def noise_m(self) -> float:
        """Mean noise of the cycles."""
        return self.baseline.noise_m

    def rivals(self) -> list[Rival]:
        """Predictions for the next cable by the effect found and those tied with it, if any are."""
        likeliest = self.ranking[:1] if self.tied else ()
        tied = [t for t in self.ranking[1:] if t.effect.name in self.tied]
        return [t.on_next_cable() for t in (*likeliest, *tied)]


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
    line = _LineCables(
        tuple(c for c, _ in chosen),
        options.kind.space(cable, chosen[0][0].study.gravity_m_per_s2),
        np.array([found.mean for _, found in chosen]),
        tuple(library.values()),
        budget,
        progress,
        known,
    )
    result = line.learned([prepared_cycle(cycle.whole, budget.work) for cycle, _ in chosen])
    left_out, cables = tuple(budget.left_out), tuple(budget.cables)
    return replace(result, left_out=left_out, cables_left_out=cables)


@dataclass(frozen=True, eq=False)
class _LineCables:
    """Cables that are learned from, and what is tried on them.

    base       parameters of one cable by the present model
    plausible  (cables, own) each cable as its hold shows it
    """

    cycles: tuple[RecordedCycle, ...]
    base: ParameterSpace
    plausible: FloatArray
    library: tuple[type[Effect], ...]
    budget: LearningBudget
    progress: Progress
    known: Callable[[LearningResult], None]

    def learned(self, prepared: Sequence[PreparedStudy]) -> LearningResult:
        """The effects that the present model lacks."""
        alone, baseline = self._fitted(prepared)
        if (moving := along_lines(baseline)) is not None:
            alone, baseline = self._fitted(moving)
        none = result = LearningResult(self.cycles, baseline)
        self.known(none)
        if negligible(baseline):
            return none
        space = self._space(alone, baseline)
        for step, (result,) in enumerate(levels(none, space.extended, space.kept)):
            result = self._along_its_lines(result)
            enough = result.best is not None and negligible(result.best.fit)
            if enough or step == min(MOST_EFFECTS, len(space.others)):
                break
            if step:
                self.known(result)
        return result

    def _space(self, alone: Sequence[SharedFit], baseline: SharedFit) -> LearningSpace:
        others = [e for e in self.library if e not in self.base.effects]
        few, plausible = baseline.cables[:TRIED_ON], self.plausible[:TRIED_ON]
        search = CablesSpace(few, self.base, plausible, len(others), self.budget, self.progress)
        return LearningSpace(search, alone[:TRIED_ON], baseline.cables, self.plausible, others)

    def _along_its_lines(self, result: LearningResult) -> LearningResult:
        """The result of one effect, fitted again where markers move along the line of its model."""
        if result.best is None or result.simpler is not None:
            return result
        if (moving := along_lines(result.best.fit)) is None:
            return result
        alone, baseline = self._fitted(moving)
        tried = [result.best, *result.ranking[1:]]
        try:
            again = self._space(alone, baseline).fitted_to_all(
                LearningResult(self.cycles, baseline), tried
            )
        except UNSIMULATED:
            return result
        return replace(again, tied=result.tied, ranking=result.ranking)

    def _fitted(self, prepared: Sequence[PreparedStudy]) -> tuple[list[SharedFit], SharedFit]:
        """The present model fitted to each cable, and to all."""
        self.progress("fitting the present model")
        alone = [
            fit_shared([p], self.base, self.plausible[i : i + 1]) for i, p in enumerate(prepared)
        ]
        return alone, fit_shared(prepared, self.base, np.vstack([a.q for a in alone]))


@dataclass(frozen=True, eq=False)
class LearningSpace:
    """Model space of learning: results with one effect, and with one more.

    search     on a few of the cables
    alone      the present model fitted to each of these
    prepared, plausible   all cables, and where their refits begin
    others     effects to choose from
    """

    search: CablesSpace
    alone: Sequence[SharedFit]
    prepared: Sequence[PreparedStudy]
    plausible: FloatArray
    others: Sequence[type[Effect]]

    def extended(self, result: LearningResult) -> list[EffectFit]:
        """The effects of a result and one more, fitted to the few cables, the best first."""
        best = result.best
        if best is None:
            return self.search.next(self.alone, self.others, None)
        if not self.search.budget.allows(SECOND, f"effects with {best.effect.name}"):
            return []
        self.search.progress(f"looking for what {best.effect.name} leaves")
        rest = [e for e in self.others if e not in best.effects]
        return self.search.next(self._each_with(best), rest, result.ranking[0])

    def _each_with(self, best: EffectFit) -> list[SharedFit]:
        """The cables of the search, each fitted alone with effects that were found."""
        base = self.search.base
        with_it = space_with(base, (*base.effects, *best.effects))
        assert tuple(with_it.names[i] for i in best.fit.common) == best.names
        full = np.tile(with_it.mean, (len(self.prepared), 1))
        full[:, : best.fit.own], full[:, best.fit.common] = best.fit.q, best.fit.theta
        cables = enumerate(self.search.prepared)
        return [fit_shared([p], with_it, full[i : i + 1]) for i, p in cables]

    def kept(self, result: LearningResult, tried: Sequence[EffectFit]) -> list[LearningResult]:
        """The result with the best of these, fitted to all cables; none if that is chance.

        One with which not all of them can be simulated is not the cause.
        Where the last effect explains as much without the one before it, it is the only one.
        """
        if not tried or tried[0].p_value >= SIGNIFICANCE:
            return []
        try:
            found = self.fitted_to_all(result, tried)
        except UNSIMULATED:
            self.search.progress(f"not all cables can be simulated with {tried[0].name}")
            return self.kept(result, tried[1:])
        if result.best is None:
            return [found]
        single = self.search.last_alone(self.alone, tried[0])
        if single is None:
            return [found]
        none = LearningResult(result.cycles, result.baseline)
        with suppress(*UNSIMULATED):  # not all cables can be with it alone
            # what is as good as it with the first is as good without
            found = replace(self.fitted_to_all(none, [single]), tied=found.tied)
        return [found]

    def fitted_to_all(self, before: LearningResult, tried: Sequence[EffectFit]) -> LearningResult:
        """The result with the best of these, fitted to all cables."""
        search = self.search
        simpler = before.baseline if before.best is None else before.best.fit
        search.progress(f"fitting {tried[0].name} to {counted(len(self.prepared), 'cable')}")
        tied = tuple(t.effect.name for t in tried[1:] if is_tied(t, tried[0]))
        best = on_all(self.prepared, search.base, self.plausible, simpler, tried[0], search.budget)
        values, std = best.fit.by_cable
        falls = (simpler.chi2_by_cable - best.fit.chi2_by_cable) / best.fit.inflation
        last = best.firsts[-1]
        evidence = tuple(
            CycleEvidence(cycle.name, float(fall), float(value), float(of_it))
            for cycle, fall, value, of_it in zip(
                before.cycles, falls, values[:, last], std[:, last], strict=True
            )
        )
        return LearningResult(
            before.cycles,
            before.baseline,
            tuple(tried),
            best,
            tied,
            tuple(Spread.of(values[:, i], std[:, i]) for i in best.firsts),
            evidence,
            None if before.best is None else before,
        )


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
