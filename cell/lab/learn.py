"""What recorded cables say is missing in the line's model: which effect, how much, how sure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc as chi2_sf

from cell.cable.effects.base import Effect
from cell.cable.geometry import Cable
from cell.identify.gauss_newton import Options
from cell.identify.individual import CableRejectedError, IdentifyOptions, identify
from cell.identify.parameters import ParameterSpace
from cell.lab.cycles import RecordedCycle
from cell.lab.fitting import Fit
from cell.lab.prepared import PreparedStudy
from cell.lab.score import holm
from cell.lab.screen import ScreenedEffect, screen, shapes_of
from cell.lab.shared import BIAS_M, SharedFit, Spread, fit_shared, prepared_cycle

FloatArray = NDArray[np.float64]

#: Cables that the library is tried on; and that a model is then fitted to, at most.
TRIED_ON, FITTED_TO = 4, 12
#: Effects of the screen that are refitted, besides those that are not smooth.
BEST = 4
#: Starts of a fit are compared on so many cables, with so many passes.
START_ON, FIRST_PASSES = 1, Options(tolerance=1.0, most_passes=6)
#: Of an effect with more shapes than this a refit begins with several, the likeliest of the cable
#: that shows it best: the middle of what cables show is none of them.
SEVERAL, PLACES = 12, 3
#: Share of what the slope says that a refit begins with.
A_LITTLE = 0.05
#: Fits whose χ² is within this factor of the best are taken to convergence.
NEAR, ALL_PASSES = 2.0, Options(tolerance=0.3, most_passes=30)
#: Family-wise, over the library (Holm).
SIGNIFICANCE = 0.01
#: Effects are one class if their χ², over its inflation, differs by less; as in a diagnosis.
TIE = 9.0
#: A model is complete for the line if it misses by no more than this above the noise, m.
NEGLIGIBLE_M = 5e-6
#: Standard deviations that are still chance.
CHANCE = 3.0
#: Share of what an effect does that `shared.SOLVER` may err by: of two that are the same physics, a
#: late arm and a late camera, the one that was there explained less by 0.4 % of it.
SIMULATED = 0.005

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class EffectFit:
    """Effects fitted to several cables, their parameters shared.

    effects  in the order in which they were added to the model
    fall     of χ² by the last of them, over the residuals' inflation
    p_value  of it, adjusted for the size of the library
    """

    effects: tuple[type[Effect], ...]
    fit: SharedFit
    fall: float
    p_value: float

    @property
    def effect(self) -> type[Effect]:
        """The effect that was added last."""
        return self.effects[-1]

    @property
    def name(self) -> str:
        """Names of the effects."""
        return " + ".join(e.name for e in self.effects)

    @property
    def firsts(self) -> tuple[int, ...]:
        """Where the first fitted parameter of each effect stands among the shared ones."""
        owners = [n.partition(".")[0] for n in self.names]
        return tuple(owners.index(e.name) for e in self.effects)

    @property
    def names(self) -> tuple[str, ...]:
        """Shared parameters, as `effect.parameter`."""
        return tuple(self.fit.space.names[i] for i in self.fit.common)


@dataclass(frozen=True)
class Vote:
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
class Lesson:
    """The result of learning from many cables: the missing effects, or that none is missing.

    cycles    that were learned from, as in `votes`
    baseline  the present model, fitted to them
    ranking   effects that were refitted beside those before, the likeliest first
    best      the likeliest, fitted to all of `cycles`; None = nothing significant is missing
    tied      effects that explain as much as the last of `best`
    spread    of the first parameter of each effect of `best` between cables
    votes     for and against the last effect of `best`
    simpler   the lesson without the last effect; None = there is one effect, or none
    """

    cycles: tuple[RecordedCycle, ...]
    baseline: SharedFit
    ranking: tuple[EffectFit, ...]
    best: EffectFit | None
    tied: tuple[str, ...]
    spread: tuple[Spread, ...]
    votes: tuple[Vote, ...]
    simpler: Lesson | None = None

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
        return float(np.mean([c.noise.std_m for c in self.baseline.cables]))


def learn(
    cycles: Sequence[RecordedCycle],
    cable: Cable,
    options: IdentifyOptions,
    library: Mapping[str, type[Effect]],
    progress: Progress = lambda _: None,
    known: Callable[[Lesson], None] = lambda _: None,
) -> Lesson:
    """Which effects the model of `options` lacks, as all cycles together see it.

    One at first; a second if the first leaves more than the noise.
    known   is told of what is certain before the end: what the present model misses, the first
            effect
    raises  ValueError: no cable can be identified; NoiseUnknownError
    """
    usable, starts = [], []
    for cycle in cycles:
        progress(f"identifying {cycle.name}")
        trial = cycle.held or cycle.study.trials[0]
        try:
            found = identify(trial, cycle.study.arc_length_m, cable, options=options)
        except CableRejectedError:
            continue
        usable.append((cycle, found))
        starts.append(found.model_error_m)
    if not usable:
        raise ValueError("none of these cables could be identified: nothing can be learned")

    # What was measured to tell effects apart comes first, then executions, which are judged by; of
    # these, those that the model misses most tell most.
    def rank(i: int) -> tuple[bool, bool, float]:
        cycle = usable[i][0]
        return cycle.held is not None, cycle.executed is None, -starts[i]

    chosen = [usable[i] for i in sorted(range(len(usable)), key=rank)[:FITTED_TO]]
    prepared = [prepared_cycle(cycle.whole) for cycle, _ in chosen]
    plausible = np.array([found.mean for _, found in chosen])
    base = options.kind.space(cable, chosen[0][0].study.gravity_m_per_s2)
    progress("fitting the present model")
    alone = [fit_shared([p], base, plausible[i : i + 1]) for i, p in enumerate(prepared)]
    few = prepared[:TRIED_ON]
    others = [e for e in library.values() if e not in base.effects]
    baseline = fit_shared(prepared, base, np.vstack([a.q for a in alone]))
    names = tuple(c for c, _ in chosen)
    none = Lesson(names, baseline, (), None, (), (), ())
    known(none)
    if negligible(baseline):
        return none
    search = _Search(tuple(few), base, plausible[:TRIED_ON], len(others), progress)
    tried = search.next(alone[:TRIED_ON], others, None)
    first = _lesson(replace(none, ranking=tuple(tried)), search, prepared, plausible, tried)
    if first.best is None or negligible(first.best.fit) or len(others) < 2:
        return first
    known(first)
    progress(f"looking for what {first.best.effect.name} leaves")
    kind = replace(options.kind, effects=(*options.kind.effects, first.best.effect))
    with_it = kind.space(cable, chosen[0][0].study.gravity_m_per_s2)
    assert with_it.names[len(base.names) :] == first.best.names
    starts_at = np.hstack([first.best.fit.q, np.tile(first.best.fit.theta, (len(prepared), 1))])
    left = [fit_shared([p], with_it, starts_at[i : i + 1]) for i, p in enumerate(few)]
    rest = [e for e in others if e is not first.best.effect]
    second = _lesson(first, search, prepared, plausible, search.next(left, rest, tried[0]))
    if second.best is first.best:
        return first
    single = search.last_alone(alone[:TRIED_ON], second.ranking[0])
    if single is None:
        return second
    # what is as good as it beside the first is as good without
    return replace(_lesson(none, search, prepared, plausible, [single]), tied=second.tied)


def _lesson(
    before: Lesson,
    search: _Search,
    prepared: Sequence[PreparedStudy],
    plausible: FloatArray,
    tried: Sequence[EffectFit],
) -> Lesson:
    """The lesson with the best of these; as before, if it is no more than chance."""
    simpler = before.baseline if before.best is None else before.best.fit
    if not tried or tried[0].p_value >= SIGNIFICANCE:
        return before
    search.progress(f"fitting {tried[0].name} to {len(prepared)} cables")
    tied = tuple(t.effect.name for t in tried[1:] if _tied(t, tried[0]))
    best = _on_all(prepared, search.base, plausible, simpler, tried[0])
    values, std = best.fit.by_cable
    falls = (simpler.chi2_by_cable - best.fit.chi2_by_cable) / best.fit.inflation
    last = best.firsts[-1]
    votes = tuple(
        Vote(cycle.name, float(fall), float(value), float(of_it))
        for cycle, fall, value, of_it in zip(
            before.cycles, falls, values[:, last], std[:, last], strict=True
        )
    )
    return Lesson(
        before.cycles,
        before.baseline,
        tuple(tried),
        best,
        tied,
        tuple(Spread.of(values[:, i], std[:, i]) for i in best.firsts),
        votes,
        None if before.best is None else before,
    )


def library_first(ranked: Sequence[EffectFit]) -> list[EffectFit]:
    """The likeliest first; a law of a file gives way to an effect of the library that explains as
    much: its free exponents and places always explain a little more.
    """
    named = [t for t in ranked[:1] if t.effect.file is not None]
    same = [t for t in ranked[1:] if named and t.effect.file is None and _tied(t, ranked[0])]
    return sorted(ranked, key=lambda t: t is not same[0]) if same else list(ranked)


def _tied(other: EffectFit, best: EffectFit) -> bool:
    """Whether an effect explains as much, or would: its fit was left short of its end.

    As much is less than what noise or the simulation's own error can make of it.
    """
    left = other.fit.solution.promised if other.fit.chi2 < NEAR * best.fit.chi2 else 0.0
    as_much = max(TIE, SIMULATED**2 * best.fall)
    return best.fall - other.fall - left / best.fit.inflation < as_much


def negligible(fit: SharedFit) -> bool:
    """Whether a model misses no more than the noise, for the line's purpose.

    How far along it a cable's end is seen is allowed for in each cable alone, and hides there how
    far all of them are: that must be no more than chance, too.
    """
    noise_m = float(np.mean([c.noise.std_m for c in fit.cables]))
    if fit.rms_m**2 - noise_m**2 >= NEGLIGIBLE_M**2:
        return False
    beyond_m = fit.end_seen_beyond_m
    return abs(float(beyond_m.mean())) < CHANCE * BIAS_M / float(np.sqrt(len(beyond_m)))


@dataclass(frozen=True, eq=False)
class _Search:
    """Looks for the next effect on a few cables.

    base       parameters of one cable without the shared effects
    plausible  (cables, own) where refits begin: each cable as its hold shows it, frames weighed by
               what the model misses.  A fit that takes its misfit for information bends EI(s) until
               it imitates an effect, to where some of it is no longer seen: no way leads back.
    library    number of effects that could be named
    """

    prepared: tuple[PreparedStudy, ...]
    base: ParameterSpace
    plausible: FloatArray
    library: int
    progress: Progress

    def next(
        self,
        alone: Sequence[SharedFit],
        others: Sequence[type[Effect]],
        simpler: EffectFit | None,
    ) -> list[EffectFit]:
        """The likeliest of the other effects, fitted to all cables at once, the best first.

        alone    the simpler model fitted to each cable alone, its effects among the own parameters
        simpler  effects before it, fitted to these cables; None = none
        """
        self.progress("screening the library")
        screens = [screen(p, _as_fit(a), others) for p, a in zip(self.prepared, alone, strict=True)]
        score: dict[str, float] = {}
        for screened in screens:
            for s in screened:
                score[s.effect.name] = score.get(s.effect.name, 0.0) + s.score.statistic
        effects = {s.effect.name: s.effect for s in screens[0]}
        ranked = sorted(effects, key=lambda n: -score[n])
        names = ranked[:BEST] + [n for n in ranked[BEST:] if not effects[n].smooth]
        fits = []
        for name in names:
            self.progress(f"refitting with {name}")
            of_it = [s for found in screens for s in found if s.effect.name == name]
            fit = self._best_start(simpler, effects[name], of_it)
            if fit is not None:
                fits.append((effects[name], fit))
        if not fits:
            return []
        best = min((fit for _, fit in fits), key=lambda f: f.chi2)
        fits = [
            (e, self._to_its_end(fit, best) if fit.chi2 < NEAR * best.chi2 else fit)
            for e, fit in fits
        ]
        before = sum(a.chi2 for a in alone) if simpler is None else simpler.fit.chi2
        earlier = () if simpler is None else simpler.effects
        fewer = 0 if simpler is None else len(simpler.fit.theta)
        inflation = min(fits, key=lambda f: f[1].chi2)[1].inflation
        falls = [(before - fit.chi2) / inflation for _, fit in fits]
        p = [
            float(chi2_sf(len(fit.theta) - fewer, max(fall, 0.0)))
            for fall, (_, fit) in zip(falls, fits, strict=True)
        ]
        adjusted = holm(p + [1.0] * (self.library - len(p)))[: len(p)]
        tried = [
            EffectFit((*earlier, effect), fit, float(fall), float(value))
            for (effect, fit), fall, value in zip(fits, falls, adjusted, strict=True)
        ]
        return library_first(sorted(tried, key=lambda t: -t.fall))

    def last_alone(self, alone: Sequence[SharedFit], pair: EffectFit) -> EffectFit | None:
        """The last of two effects without the first, if it explains as much as both.

        The first was the best that there was of what began as small; beside it the second has come
        to where no way led from none of it.
        """
        self.progress(f"trying {pair.effect.name} without {pair.effects[0].name}")
        values = _natural(pair.fit)[len(pair.effects[0].parameters) :]
        effects = (pair.effect,)
        try:
            fit = fit_shared(
                self.prepared, self.base, pair.fit.q, effects, values, options=ALL_PASSES
            )
        except ValueError:
            return None
        fall = (sum(a.chi2 for a in alone) - fit.chi2) / fit.inflation
        p_value = min(1.0, self.library * float(chi2_sf(len(fit.theta), max(fall, 0.0))))
        single = EffectFit(effects, fit, float(fall), p_value)
        more = (fit.chi2 - pair.fit.chi2) / pair.fit.inflation
        return single if more < max(TIE, SIMULATED**2 * fall) else None

    def _to_its_end(self, fit: SharedFit, best: SharedFit) -> SharedFit:
        """The fit converged: what is compared must not differ by where it was left.

        best  of another effect: what explains as much may do so with the same cables
        """
        effects, found = fit.space.effects[len(self.base.effects) :], [fit]
        for q in [] if fit.solution.converged else [fit.q, *([] if fit is best else [best.q])]:
            found.append(
                fit_shared(
                    self.prepared, self.base, q, effects, _natural(found[-1]), options=ALL_PASSES
                )
            )
        return min(found, key=lambda f: f.chi2)

    def _best_start(
        self, simpler: EffectFit | None, effect: type[Effect], screened: Sequence[ScreenedEffect]
    ) -> SharedFit | None:
        """The effect fitted to all cables, from the start that leads furthest on a few."""
        effects = (effect,) if simpler is None else (*simpler.effects, effect)
        known = np.zeros(0) if simpler is None else _natural(simpler.fit)
        # The slope says how much of it there is, but the cables were fitted without it: from a
        # little of it all parameters move together.
        off = np.array([p.default if p.amplitude else np.nan for p in effect.parameters])
        most = [np.median(np.array([s.starts[0] for s in screened]), axis=0)]
        if shapes_of(effect) > SEVERAL:
            clearest = max(screened, key=lambda s: s.score.statistic)
            most = [*clearest.starts[:PLACES]]
        places = [np.where(np.isnan(off), m, off + A_LITTLE * (m - off)) for m in most]
        if not effect.smooth:
            places += [
                np.array([p.starts[min(k, len(p.starts) - 1)] for p in effect.parameters])
                for k in range(3)
            ]
        starts = [np.concatenate([known, values]) for values in places]
        few, q = slice(0, START_ON), self.plausible
        found: list[SharedFit] = []
        for values in starts if len(starts) > 1 else ():
            try:
                found.append(
                    fit_shared(
                        self.prepared[few], self.base, q[few], effects, values, options=FIRST_PASSES
                    )
                )
            except ValueError:
                continue
        begin, values = q.copy(), starts[0]
        if found:
            best = min(found, key=lambda f: f.chi2)
            begin[few], values = best.q, _natural(best)
        try:
            return fit_shared(self.prepared, self.base, begin, effects, values)
        except ValueError:
            return None


def _on_all(
    prepared: Sequence[PreparedStudy],
    base: ParameterSpace,
    plausible: FloatArray,
    simpler: SharedFit,
    best: EffectFit,
) -> EffectFit:
    q = plausible.copy()
    q[: len(best.fit.q)] = best.fit.q
    fit = fit_shared(prepared, base, q, best.effects, _natural(best.fit), options=ALL_PASSES)
    fall = (simpler.chi2 - fit.chi2) / fit.inflation
    return replace(best, fit=fit, fall=float(fall))


def _natural(fit: SharedFit) -> FloatArray:
    """Natural values of all parameters of the shared effects, those not fitted included."""
    q = fit.space.mean.copy()
    q[fit.common] = fit.theta
    return np.asarray(fit.space.natural(q)[fit.own :])


def _as_fit(alone: SharedFit) -> Fit:
    """The fit of a single cable as the screen takes it."""
    return Fit(
        space=alone.space,
        q=alone.q[0],
        begun={},
        solution=alone.solution,
        chi2=float(alone.chi2_by_cable[0]),
        objective=alone.chi2,
        rms_m=alone.rms_m,
    )
