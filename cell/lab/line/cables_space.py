"""Model space of many cables: sets of effects, fitted to each cable alone, then to all jointly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtrc as chi2_sf

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.files.words import counted
from cell.identify.gauss_newton import UNSIMULATED, Options
from cell.identify.parameters import ParameterSpace
from cell.lab.data.cycles import RecordedCycle
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.rules import SIGNIFICANCE
from cell.lab.fit.fitting import Fit, start_from
from cell.lab.fit.score_test import ScreenedEffect, screen
from cell.lab.fit.sensitivity import shapes_of
from cell.lab.fit.shared import (
    PASSES,
    SharedFit,
    Spread,
    along_lines,
    fit_shared,
    simulated_s,
)
from cell.lab.line.effect_fit import (
    ALL_PASSES,
    NEAR,
    SIMULATED,
    TIE,
    CycleEvidence,
    EffectFit,
    LearningBudget,
    LearningResult,
    is_tied,
    library_first,
)
from cell.lab.search.baseline import SearchSetup
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel
from cell.lab.search.stepwise import holm_among

#: Number of cables that effects are first fitted to.
TRIED_ON = 4
#: Number of cables, and fit options, to compare starts of a fit.
START_ON, FIRST_PASSES = 1, replace(PASSES, tolerance=1.0, max_iterations=6)
#: A refit of an effect with more shapes than this starts from several places, the likeliest ones of
#: the cable with the largest score: an average of the cables' places fits none of them.
SEVERAL, PLACES = 12, 3
#: Share of the amplitude predicted by the slope at which a refit starts.
A_LITTLE = 0.05
#: Two cables' own solutions are equal if all parameters are within this many standard deviations.
ALIKE = 3.0


def values_of(fit: Fit, effects: Sequence[type[Effect]]) -> FloatArray:
    """Natural values of all parameters of these effects in a fit."""
    values = fit.space.natural(fit.q)
    names = [f"{e.name}.{p.name}" for e in effects for p in e.parameters]
    return np.array([values[fit.space.names.index(name)] for name in names])


def distinct(
    candidates: Sequence[FittedModel], effects: Sequence[type[Effect]]
) -> list[FittedModel]:
    """Solutions of single cables, best objective first, without those with equal effect parameters.

    A candidate's covariance is widened by its residual.
    """
    result: list[tuple[FittedModel, FloatArray, FloatArray]] = []
    for candidate in sorted(candidates, key=lambda c: c.fit.objective):
        fit = candidate.fit
        names = [n for n in fit.space.names if n.startswith(tuple(f"{e.name}." for e in effects))]
        index = [fit.space.names.index(n) for n in names]
        q, variance = fit.q[index], fit.widening * np.diag(fit.covariance)[index]
        differences = [(q - a) ** 2 > ALIKE**2 * (variance + b) for _, a, b in result]
        if all(np.any(far) for far in differences):
            result.append((candidate, q, variance))
    return [candidate for candidate, *_ in result]


#: Number of effects of the screen that are refitted, in addition to the non-smooth ones.
BEST = 4
#: A fit whose χ² exceeds the best by this factor after this many iterations is abandoned; an effect
#: whose own fits to each cable leave that much is not fitted jointly.
FAR_ABOVE, ENOUGH_PASSES = 4.0, 4
#: A joint fit is continued while its linear model predicts a fall of χ² by this share, and that is
#: reached: an unfinished fit would exaggerate the differences between cables.
UNFINISHED = 0.1
#: Shares of the budget after which no own solution, refit, continued fit or second effect begins.
OWN, REFITS, ENDS, SECOND = 0.4, 0.5, 0.6, 0.6

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class CablesSpace:
    """Model space of learning: effects fitted to cables in addition to those of their model.

    cycles     the recorded cycles of the cables
    prepared   the same, prepared; effects are first fitted to the first `TRIED_ON`
    base       parameters of one cable without the shared effects
    plausible  (cables, own) starts of refits: each cable identified from its hold, with the model's
               error as noise.  A fit that treats its misfit as information distorts EI(s) to
               imitate an effect, and refits from there do not recover.
    others     effects to choose from
    """

    cycles: tuple[RecordedCycle, ...]
    prepared: tuple[PreparedStudy, ...]
    base: ParameterSpace
    plausible: FloatArray
    others: Sequence[type[Effect]]
    budget: LearningBudget
    progress: Progress

    @property
    def few(self) -> tuple[PreparedStudy, ...]:
        """The cables that effects are first fitted to."""
        return self.prepared[:TRIED_ON]

    @cached_property
    def alone(self) -> list[SharedFit]:
        """Fits of the present model to each cable alone."""
        self.progress("fitting the present model")
        starts = zip(self.prepared, self.plausible, strict=True)
        return [fit_shared([cable], self.base, q[None]) for cable, q in starts]

    @cached_property
    def without_effects(self) -> LearningResult:
        """Result without effects: the present model fitted to all cables."""
        q = np.vstack([alone.q for alone in self.alone])
        return LearningResult(self.cycles, fit_shared(self.prepared, self.base, q))

    def extended(self, result: LearningResult) -> list[EffectFit]:
        """The effects of a result and one more, fitted to the few cables, the best first."""
        best = result.best
        if best is None:
            return self._one_effect_more(self.alone[:TRIED_ON], self.others, None)
        if not self.budget.allows(SECOND, f"effects with {best.effect.name}"):
            return []
        self.progress(f"looking for what {best.effect.name} leaves")
        remaining, fit = [e for e in self.others if e not in best.effects], best.fit
        each = [
            fit_shared([p], fit.space, fit.coordinates(i)[None]) for i, p in enumerate(self.few)
        ]
        return self._one_effect_more(each, remaining, result.ranking[0])

    def select(self, result: LearningResult, tried: Sequence[EffectFit]) -> list[LearningResult]:
        """The result with the best of these, fitted to all cables; empty if not significant.

        Effects with which a cable cannot be simulated are excluded.  If the last effect explains as
        much without the previous one, that is dropped.
        """
        if not tried or tried[0].p_value >= SIGNIFICANCE:
            return []
        try:
            selected = self.fitted_to_all(result, tried)
        except UNSIMULATED:
            self.progress(f"not all cables can be simulated with {tried[0].name}")
            return self.select(result, tried[1:])
        single = None if result.best is None else self.last_alone(tried[0])
        if single is not None:
            with suppress(*UNSIMULATED):  # a cable may not be simulable with it alone
                # ties with the first effect also hold without it
                alone = self.fitted_to_all(self.without_effects, [single])
                selected = replace(alone, tied=selected.tied)
        return [selected]

    def along_its_lines(self, result: LearningResult) -> LearningResult:
        """The result of one effect, refitted with markers shifted along its model's centreline."""
        if result.best is None or result.simpler is not None:
            return result
        if (moving := along_lines(result.best.fit)) is None:
            return result
        space = replace(self, prepared=tuple(moving))
        tried = [result.best, *result.ranking[1:]]
        try:
            refitted = space.fitted_to_all(space.without_effects, tried)
        except UNSIMULATED:
            return result
        return replace(refitted, tied=result.tied, ranking=result.ranking)

    def fitted_to_all(self, before: LearningResult, tried: Sequence[EffectFit]) -> LearningResult:
        """The result with the best of these, fitted to all cables.  Raises UnsimulatedError."""
        simpler = before.baseline if before.best is None else before.best.fit
        self.progress(f"fitting {tried[0].name} to {counted(len(self.prepared), 'cable')}")
        best = self.on_all(simpler, tried[0])
        values, std = best.fit.by_cable
        falls = (simpler.chi2_by_cable - best.fit.chi2_by_cable) / best.fit.inflation
        last = best.firsts[-1]
        numbers = zip(falls, values[:, last], std[:, last], strict=True)
        return replace(
            before,
            ranking=tuple(tried),
            best=best,
            tied=tuple(t.effect.name for t in tried[1:] if is_tied(t, tried[0])),
            spread=tuple(Spread.of(values[:, i], std[:, i]) for i in best.firsts),
            cycle_evidence=tuple(
                CycleEvidence(cycle.name, *map(float, of_it))
                for cycle, of_it in zip(before.cycles, numbers, strict=True)
            ),
            simpler=None if before.best is None else before,
        )

    def on_all(self, simpler: SharedFit, best: EffectFit) -> EffectFit:
        """Effects refitted to all cables, starting from their fit to a few.

        The other cables start from their holds' identification or, if one cannot be simulated there
        with the effects, from their fit of the simpler model.

        raises  UnsimulatedError: a cable cannot be simulated from there either
        """
        prepared, budget = self.prepared, self.budget
        each_s = sum(map(simulated_s, prepared)) * (1 + best.fit.own + len(best.names))
        text = f"the fit of {best.name} to {counted(len(prepared), 'cable')}"
        options = budget.passes(each_s, ALL_PASSES, text)

        def fitted(begin: FloatArray) -> SharedFit:
            q = begin.copy()
            q[: len(best.fit.q)] = best.fit.q
            return self._fit(prepared, q, best.effects, best.fit.shared_values, options)

        try:
            fit = fitted(self.plausible)
        except UNSIMULATED:
            fit = fitted(simpler.q[:, : self.plausible.shape[1]])
        while fit.solution.promised > UNFINISHED * fit.chi2:  # a long curved valley
            if not budget.allows(ENDS, f"the end of the fit of {best.name} to all cables"):
                break
            continued = self._fit(prepared, fit.q, best.effects, fit.shared_values, options)
            if continued.chi2 > (1.0 - UNFINISHED) * fit.chi2:
                break
            fit = continued
        return replace(best, fit=fit, fall=float((simpler.chi2 - fit.chi2) / fit.inflation))

    def _fit(
        self,
        prepared: Sequence[PreparedStudy],
        q: FloatArray,
        effects: Sequence[type[Effect]],
        values: FloatArray,
        options: Options,
    ) -> SharedFit:
        return fit_shared(prepared, self.base, q, effects, values, options=options)

    def _one_effect_more(
        self,
        alone: Sequence[SharedFit],
        others: Sequence[type[Effect]],
        simpler: EffectFit | None,
    ) -> list[EffectFit]:
        """The likeliest of the other effects, fitted to the few cables jointly, the best first.

        alone    the simpler model fitted to each cable alone, its effects among the own parameters
        simpler  previous effects, fitted to these cables; None = none
        """
        self.progress("screening the library")
        screens = [screen(p, as_fit(a), others) for p, a in zip(self.few, alone, strict=True)]
        ranked = ranked_by_screens(screens)
        chosen = ranked[:BEST] + [e for e in ranked[BEST:] if not e.smooth]
        own = self._own_solutions(alone, chosen, simpler)
        fits: list[tuple[type[Effect], SharedFit]] = []
        for effect in chosen:
            best_chi2 = min((fit.chi2 for _, fit in fits), default=np.inf)
            alone_chi2 = [o[effect.name].fit.objective for o in own if effect.name in o]
            if len(alone_chi2) == len(own) and sum(alone_chi2) > FAR_ABOVE * best_chi2:
                continue  # its fits to single cables leave far more than another's joint fit
            if fits and not self.budget.allows(REFITS, f"a fit with {effect.name}"):
                continue
            self.progress(f"refitting with {effect.name}")
            of_it = [s for screened in screens for s in screened if s.effect is effect]
            fit = self._refitted(simpler, effect, of_it, [o.get(effect.name) for o in own])
            if fit is not None:
                fits.append((effect, fit))
        if not fits:
            return []
        best = min((fit for _, fit in fits), key=lambda f: f.chi2)
        fits = [
            (e, self._converged(fit, best) if fit.chi2 < NEAR * best.chi2 else fit)
            for e, fit in fits
        ]
        before = sum(a.chi2 for a in alone) if simpler is None else simpler.fit.chi2
        return self._ranked(fits, before, simpler)

    def _ranked(
        self,
        fits: Sequence[tuple[type[Effect], SharedFit]],
        before: float,
        simpler: EffectFit | None,
    ) -> list[EffectFit]:
        """Fits by their fall of χ², the largest first, with its p-value."""
        earlier = () if simpler is None else simpler.effects
        fewer = 0 if simpler is None else len(simpler.fit.theta)
        inflation = min(fits, key=lambda f: f[1].chi2)[1].inflation
        falls = [(before - fit.chi2) / inflation for _, fit in fits]
        p = [
            float(chi2_sf(len(fit.theta) - fewer, max(fall, 0.0)))
            for fall, (_, fit) in zip(falls, fits, strict=True)
        ]
        adjusted = holm_among(p, len(self.others))
        tried = [
            EffectFit((*earlier, effect), fit, float(fall), float(value))
            for (effect, fit), fall, value in zip(fits, falls, adjusted, strict=True)
        ]
        return library_first(sorted(tried, key=lambda t: -t.fall))

    def _own_solutions(
        self,
        alone: Sequence[SharedFit],
        effects: Sequence[type[Effect]],
        simpler: EffectFit | None,
    ) -> list[dict[str, FittedModel]]:
        """Per cable the fits of a single-cable search with each effect of several shapes.

        Only that search finds the place of a distant effect; a joint fit converges from the place
        of one cable that determines it well.
        """
        shaped = [e for e in effects if shapes_of(e) > 1]
        solutions: list[dict[str, FittedModel]] = []
        for number, (prepared, fit) in enumerate(zip(self.few, alone, strict=True)):
            text = f"own solutions of {prepared.study.name}"
            if not shaped or (number and not self.budget.allows(OWN, text)):
                solutions.append({})
                continue
            self.progress(f"refitting {prepared.study.name} alone")
            begin = None if simpler is None else fit.q[0]
            library = {e.name: e for e in shaped}
            fits = FitCache.of(SearchSetup(prepared, fit.space, library, start_q=begin))
            try:
                candidates = fits.fit_extended(fits.base, shaped)
            except UNSIMULATED:  # not simulable with these
                candidates = []
            solutions.append({c.effects[-1].name: c for c in candidates})
        return solutions

    def last_alone(self, pair: EffectFit) -> EffectFit | None:
        """The last of two effects without the first, if it explains as much as both.

        The first was the best of the effects that a fit from zero could reach; given it, the second
        may have reached a minimum that was not reachable from zero.
        """
        self.progress(f"trying {pair.effect.name} without {pair.effects[0].name}")
        values = pair.fit.shared_values[len(pair.effects[0].parameters) :]
        try:
            fit = self._fit(self.few, pair.fit.q, (pair.effect,), values, ALL_PASSES)
        except UNSIMULATED:
            return None
        fall = (sum(a.chi2 for a in self.alone[:TRIED_ON]) - fit.chi2) / fit.inflation
        p_value = min(1.0, len(self.others) * float(chi2_sf(len(fit.theta), max(fall, 0.0))))
        excess = (fit.chi2 - pair.fit.chi2) / pair.fit.inflation
        tied = excess < max(TIE, SIMULATED**2 * fall)
        return EffectFit((pair.effect,), fit, float(fall), p_value) if tied else None

    def _converged(self, fit: SharedFit, best: SharedFit) -> SharedFit:
        """The fit continued to convergence, so that fits are comparable.

        best  fit of another effect: its cables are a further start
        """
        effects, fits = fit.space.effects[len(self.base.effects) :], [fit]
        for q in [] if fit.solution.converged else [fit.q, *([] if fit is best else [best.q])]:
            if not self.budget.allows(ENDS, f"the end of the fit of {effects[-1].name}"):
                break
            with suppress(*UNSIMULATED):  # the other's cables with this effect's values
                values = fits[-1].shared_values
                fits.append(self._fit(self.few, q, effects, values, ALL_PASSES))
        return min(fits, key=lambda f: f.chi2)

    def _refitted(
        self,
        simpler: EffectFit | None,
        effect: type[Effect],
        screened: Sequence[ScreenedEffect],
        own: Sequence[FittedModel | None],
    ) -> SharedFit | None:
        """The best joint fit of an effect: from all cables' screens, and from own solutions."""
        effects = (effect,) if simpler is None else (*simpler.effects, effect)
        fits: list[SharedFit] = []

        def fitted(q: FloatArray, values: FloatArray) -> None:
            least = min((f.chi2 for f in fits), default=np.inf)
            options = replace(PASSES, above=(FAR_ABOVE * least, ENOUGH_PASSES))
            with suppress(*UNSIMULATED):
                fits.append(self._fit(self.few, q, effects, values, options))

        solved = [c for c in own if c is not None]
        begin = self.plausible[:TRIED_ON].copy()
        for i, candidate in enumerate(own):
            if candidate is not None:
                begin[i] = start_from(candidate.fit, self.base)
        for candidate in distinct(solved, effects):
            if not fits or self.budget.allows(REFITS, f"other starts of {effect.name}"):
                fitted(begin, values_of(candidate.fit, effects))
        if not fits or self.budget.allows(REFITS, f"other starts of {effect.name}"):
            fitted(*self._common_start(simpler, effect, screened))
        return min(fits, key=lambda f: f.chi2, default=None)

    def _common_start(
        self,
        simpler: EffectFit | None,
        effect: type[Effect],
        screened: Sequence[ScreenedEffect],
    ) -> tuple[FloatArray, FloatArray]:
        """Start of a joint fit: the cables' coordinates and the effects' values, by few cables."""
        effects = (effect,) if simpler is None else (*simpler.effects, effect)
        earlier = np.zeros(0) if simpler is None else simpler.fit.shared_values
        # The slope predicts its size, but the cables were fitted without it: from a small size all
        # parameters converge jointly.
        zero = np.array([p.default if p.amplitude else np.nan for p in effect.parameters])
        most = [np.median(np.array([s.starts[0] for s in screened]), axis=0)]
        if shapes_of(effect) > SEVERAL:
            clearest = max(screened, key=lambda s: s.score.statistic)
            most = [*clearest.starts[:PLACES]]
        places = [np.where(np.isnan(zero), m, zero + A_LITTLE * (m - zero)) for m in most]
        if not effect.smooth:
            places += [
                np.array([p.starts[min(k, len(p.starts) - 1)] for p in effect.parameters])
                for k in range(3)
            ]
        starts = [np.concatenate([earlier, values]) for values in places]
        begin, values = self.plausible[:TRIED_ON].copy(), starts[0]
        first = slice(0, START_ON)
        fits: list[SharedFit] = []
        for start in starts if len(starts) > 1 else ():
            with suppress(*UNSIMULATED):
                fits.append(self._fit(self.few[first], begin[first], effects, start, FIRST_PASSES))
        if fits:
            best = min(fits, key=lambda f: f.chi2)
            begin[first], values = best.q, best.shared_values
        return begin, values


def ranked_by_screens(screens: Sequence[Sequence[ScreenedEffect]]) -> list[type[Effect]]:
    """Effects by the sum of their scores over all cables, the largest first."""
    score: dict[str, float] = {}
    effects: dict[str, type[Effect]] = {}
    for s in (s for screened in screens for s in screened):
        score[s.effect.name] = score.get(s.effect.name, 0.0) + s.score.statistic
        effects.setdefault(s.effect.name, s.effect)
    return [effects[n] for n in sorted(effects, key=lambda n: -score[n])]


def as_fit(alone: SharedFit) -> Fit:
    """The fit of a single cable as a `Fit`, the type that the screen needs."""
    return Fit(
        space=alone.space,
        q=alone.q[0],
        initial_states={},
        solution=alone.solution,
        chi2=float(alone.chi2_by_cable[0]),
        objective=alone.chi2,
        rms_m=alone.rms_m,
        markers_rms_m=alone.rms_m,
    )
