"""A fitted model with one effect more: the likeliest result of fits from several starts.

`Extension` fits one effect, `Refits` several, in parallel on all cores.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.gauss_newton import UNSIMULATED, Options
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import ERROR_RATIO, PreparedStudy
from cell.lab.data.work import Progress, side_by_side
from cell.lab.fit.fitting import (
    Fit,
    extended,
    fit_model,
    fit_trials,
    residuals,
    space_with,
    with_values,
)
from cell.lab.fit.score_test import MOST_SHAPES, ScreenedEffect
from cell.lab.fit.sensitivity import shapes_of
from cell.lab.search.fitted_model import (
    POLISH,
    REFIT,
    FittedModel,
    error_text,
    model_of_fit,
    penalty_of,
)

#: Number of uniform cables for a cold start, and their range of ln EI about the prior's.
COLD_STARTS, COLD_RANGE = 48, 3.0
#: Most typical sizes of an effect.
MOST_GUESSES = 9
#: Scale factors of the amplitudes that the screen predicts.
SHARES = (2.0, 0.5, 0.25, 0.1)


def cold_start(prepared: PreparedStudy, space: ParameterSpace) -> FloatArray:
    """Coordinates of the uniform cable that fits best, or the prior's mean if that fits better."""
    trials = fit_trials(prepared)
    level = float(np.exp(space.mean[: space.knots].mean()))
    levels = level * np.exp(np.linspace(-COLD_RANGE, COLD_RANGE, COLD_STARTS))
    q = np.vstack([space.mean, *(space.start(float(v)) for v in levels)])
    white = residuals(prepared, space, trials, q)
    square = np.where(np.isfinite(white).all(axis=1), np.sum(white**2, axis=1), np.inf)
    offset = q - space.mean
    square += np.einsum("ij,jk,ik->i", offset, space.precision, offset)
    return np.asarray(q[int(np.argmin(square))])


def scaled(effect: type[Effect], guesses: Sequence[FloatArray]) -> list[FloatArray]:
    """The guesses, then with scaled amplitudes: guesses are linear, so wrong far from zero."""
    default, low, high = np.array([(p.default, p.low, p.high) for p in effect.parameters]).T
    strong = np.array([p.amplitude for p in effect.parameters])
    scaled = [
        np.clip(np.where(strong, default + share * (g - default), g), low, high)
        for share in SHARES
        for g in guesses
    ]
    return [*guesses, *scaled]


def each_once(starts: Sequence[FloatArray]) -> list[FloatArray]:
    """The starts, none of them twice."""
    return [q for i, q in enumerate(starts) if is_new(q, starts[:i])]


def is_new(q: FloatArray, others: Sequence[FloatArray]) -> bool:
    """Whether a start differs from all others."""
    return not any(np.array_equal(q, other) for other in others)


def typical(effect: type[Effect]) -> list[FloatArray]:
    """All combinations of the effect's starts, the most typical first."""
    choices = itertools.product(*(p.starts for p in effect.parameters))
    return [np.array(c) for c in itertools.islice(choices, MOST_GUESSES)]


#: A tempered fit divides the residuals by this times the root of χ² per value.
TEMPER = 3.0
#: Fits of an effect from different starts; friction has several minima.
SMOOTH_TRIES, ROUGH_TRIES = 1, 2
PLACES = 2
#: A refit that explains less than this share of the screen's prediction is in a wrong minimum, if
#: there are other shapes to start from.
LEAST_SHARE = 0.5
#: Iterations after which a fit is abandoned that is still above its required objective.
ENOUGH_PASSES = 5
#: Options of a fit that searches the place of a force.
SEARCH = Options(tolerance=0.3, max_iterations=10, least_gain=1e-3, updates=3)


@dataclass(frozen=True, eq=False)
class Extension:
    """A model of a study, with starting points of fits with one more effect.

    origins    (p,) start coordinates of the model's own parameters: as fitted, and alternatives
    far        whether the model may be far from the cable: then slopes predict sizes badly
    misfit     whether the residual exceeds noise: its cable may not be plausible, so that a user's
               own effect is fitted from a uniform cable too
    """

    prepared: PreparedStudy
    base: FittedModel
    origins: tuple[FloatArray, ...]
    far: bool = False
    misfit: bool = False

    def by(
        self, effect: type[Effect], screens: Sequence[ScreenedEffect], options: Options
    ) -> FittedModel | None:
        """The model with an effect added; None if it cannot be simulated from any start.

        screens  of the effect; the first is of the model itself
        """
        base = self.base
        effects = (*base.effects, effect)
        space = space_with(base.fit.space, effects)
        placed = shapes_of(effect) > MOST_SHAPES
        fits: list[Fit] = []
        for origin in self.origins[-1:] if placed else self.origins:
            starts = self._starts(space, effect, screens, origin)
            promising = self._promising(space, effect, screens, starts)
            fits += self._fits_from(space, each_once(promising), options)
            fall = base.fit.objective - min((f.objective for f in fits), default=np.inf)
            too_small = not placed and fall < LEAST_SHARE * screens[0].score.statistic
            if origin is base.fit.q and too_small:
                untried = [q for q in starts[: len(screens[0].starts)] if is_new(q, promising)]
                fits += self._fits_from(space, untried, options)
        if self.misfit and effect.file is not None:
            fits += self._fits_from(space, self._own_starts(space, effect), options)
        if not fits:
            return None
        # A force at a wrong place may fit best, but not predict: all places are compared by χ².
        candidates = fits if placed else [self._lowest(fits, effect, options)]
        best = min(
            (model_of_fit(self.prepared, effects, fit) for fit in candidates), key=lambda c: c.chi2
        )
        return self.at_least_nested(best, options)

    def at_least_nested(self, extended_model: FittedModel, options: Options) -> FittedModel:
        """The model with one effect more, refitted from the nested model if it ended above that.

        With the effect at zero it is the nested model: a fit with a larger objective has ended in a
        wrong minimum.
        """
        nested = self.base.fit.objective
        if extended_model.fit.objective <= nested or not np.isfinite(nested):
            return extended_model
        effect, space = extended_model.effects[-1], extended_model.fit.space
        off = np.array([p.default if p.amplitude else p.starts[0] for p in effect.parameters])
        fits = self._fits_from(space, [extended(self.base.fit, space, effect, off)], options)
        refitted = [model_of_fit(self.prepared, extended_model.effects, fit) for fit in fits]
        return min([extended_model, *refitted], key=lambda c: c.fit.objective)

    def _own_starts(self, space: ParameterSpace, effect: type[Effect]) -> list[FloatArray]:
        """A uniform cable with the effect at its typical values, and at fractions of them.

        If the cable's parameters imitate an effect, no screen finds that effect.
        """
        cable = cold_start(self.prepared.on_one_core(), space)
        values = scaled(effect, typical(effect))
        starts = [with_values(space, cable, effect, value) for value in values]
        return list(self._least_misfit(space, np.array(each_once(starts)), PLACES))

    def _starts(
        self,
        space: ParameterSpace,
        effect: type[Effect],
        screens: Sequence[ScreenedEffect],
        origin: FloatArray,
    ) -> list[FloatArray]:
        """Coordinates with the sizes from the screens, then with typical ones."""
        guesses = _guesses(screens)
        values = scaled(effect, guesses) if self.far else guesses
        starts = [
            extended(self.base.fit, space, effect, value) for value in [*values, *typical(effect)]
        ]
        of_base = [space.names.index(name) for name in self.base.fit.space.names]
        for q in starts:
            q[of_base] = origin
        return starts

    def _promising(
        self,
        space: ParameterSpace,
        effect: type[Effect],
        screens: Sequence[ScreenedEffect],
        starts: list[FloatArray],
    ) -> list[FloatArray]:
        """Starts that are worth a fit."""
        if shapes_of(effect) > MOST_SHAPES:
            return self._places(space, starts[: len(_guesses(screens))])
        tries = SMOOTH_TRIES if effect.smooth else ROUGH_TRIES
        promising = list(self._least_misfit(space, np.array(starts), tries))
        if shapes_of(effect) > 1:
            likeliest = np.cumsum([0, *(len(s.starts) for s in screens)])[:-1]
            promising += [q for q in map(starts.__getitem__, likeliest) if is_new(q, promising)]
        return promising

    def _fits_from(
        self, space: ParameterSpace, starts: Sequence[FloatArray], options: Options
    ) -> list[Fit]:
        """Fits from starts at which the cable can be simulated."""
        fits, initial_states = [], self.base.fit.initial_states
        for q in starts:
            with contextlib.suppress(*UNSIMULATED):
                alone = self.prepared.on_one_core()
                fits.append(
                    fit_model(alone, space, q, initial_states, options=options, from_far=True)
                )
        return fits

    def _lowest(self, fits: Sequence[Fit], effect: type[Effect], options: Options) -> Fit:
        """The fit with the lowest objective, of fits from several starts.

        Unfinished fits are continued if their predicted objective is below all others, below BIC's
        limit for the effect, and low enough to explain the study.
        """
        lowest = min(fits, key=lambda f: f.objective)
        if len(fits) == 1 or lowest.objective > options.above[0]:  # abandoned
            return lowest
        bic_limit = self.base.fit.objective - penalty_of(self.prepared, [effect])
        noise = ERROR_RATIO**2 * self.prepared.count(fit_trials(self.prepared))
        limit = min(lowest.objective, bic_limit, noise)
        promising = [f for f in fits if f.predicted_objective < limit]
        if all(f is lowest for f in promising):
            return lowest
        for fit in sorted(promising, key=lambda f: f.predicted_objective):
            lowest = min(lowest, self._continued(fit, lowest.objective), key=lambda f: f.objective)
        return lowest

    def _continued(self, fit: Fit, lowest: float) -> Fit:
        """The fit continued to convergence if it becomes the lowest; itself if that fails."""
        options = replace(POLISH, above=(lowest, ENOUGH_PASSES))
        with contextlib.suppress(*UNSIMULATED):
            alone = self.prepared.on_one_core()
            return fit_model(alone, fit.space, fit.q, fit.initial_states, options=options)
        return fit

    def _places(self, space: ParameterSpace, starts: Sequence[FloatArray]) -> list[FloatArray]:
        """Results of tempered fits from all starts, the best of them.

        A fit converges to the place of a distant force only while the residuals are tempered.
        """
        alone = self.prepared.on_one_core()
        count = alone.count(fit_trials(alone))
        scale = TEMPER * max(1.0, float(np.sqrt(self.base.fit.chi2 / count)))
        fits = []
        for q in starts:
            with contextlib.suppress(*UNSIMULATED):
                fits.append(
                    fit_model(alone, space, q, residual_scale=scale, options=SEARCH, from_far=True)
                )
        return [f.q for f in sorted(fits, key=lambda f: f.objective)[:PLACES]]

    def _least_misfit(self, space: ParameterSpace, starts: FloatArray, count: int) -> FloatArray:
        """The `count` starts of (lanes, p) with the least misfit."""
        alone = self.prepared.on_one_core()
        square = np.sum(residuals(alone, space, fit_trials(alone), starts) ** 2, axis=1)
        order = np.argsort(np.where(np.isfinite(square), square, np.inf), kind="stable")
        return np.asarray(starts[order[:count]])


def _guesses(screens: Sequence[ScreenedEffect]) -> list[FloatArray]:
    """Parameter values of all screens."""
    return [start for screened in screens for start in screened.starts]


def continued(prepared: PreparedStudy, model: FittedModel, options: Options) -> FittedModel:
    """The model refitted to a prepared study, from its own parameters.

    raises  UnsimulatedError
    """
    fit, alone = model.fit, prepared.on_one_core()
    refitted = fit_model(alone, fit.space, fit.q, fit.initial_states, options=options)
    return model_of_fit(prepared, model.effects, refitted)


#: Number of first refits, the most promising ones, that are continued to convergence.
POLISHED = 3
#: A first refit is abandoned if it is soon far above the best of the first few effects, which are
#: the likeliest by the screen.
FIRST = 2
#: An objective is far above the best if it is this many times larger, and misses this share of the
#: fall that the best effect brings.  A strong effect that misses a hundredth of the fall may be ten
#: times above the best, and yet end as low when it is continued.
FAR_ABOVE, FAR_FROM_FALL = 10.0, 0.1


@dataclass(frozen=True, eq=False)
class Refits:
    """Refits of a model with one effect more.  A user's own effects all converge.

    screens   by effect
    offered   effects that the fitted models may have
    earlier   models of an earlier search, as `models`: start points of fits
    models    models so far by their effects' names; results are added
    polished  models that gain nothing by further iterations; results are added
    """

    extension: Extension
    screens: Mapping[str, Sequence[ScreenedEffect]]
    offered: Sequence[type[Effect]]
    earlier: Mapping[frozenset[str], FittedModel]
    models: dict[frozenset[str], FittedModel]
    polished: set[frozenset[str]]
    progress: Progress

    def with_each(self, effects: Sequence[type[Effect]]) -> list[FittedModel]:
        """The model with each effect added, without effects that cannot be simulated."""
        prepared, models = self.extension.prepared, self.models
        work = prepared.work
        unknown = [e for e in effects if self._key(e) not in models]
        unknown = [e for e in unknown if work.affords(f"a fit with {self._name(e)}")]
        done = itertools.count(len(effects) - len(unknown) + 1)

        def refitted(job: tuple[type[Effect], Options]) -> FittedModel | None:
            effect, options = job
            if earlier := self.earlier.get(self._key(effect)):
                one_iteration = replace(options, above=(options.above[0], 1))
                with contextlib.suppress(*UNSIMULATED):
                    model = continued(prepared, earlier, one_iteration)
                    return self.extension.at_least_nested(model, options)
            return self.extension.by(effect, self.screens[effect.name], options)

        def continue_fit(model: FittedModel) -> FittedModel:
            with contextlib.suppress(*UNSIMULATED):  # its end may not be simulable
                return continued(prepared, model, POLISH)
            return model

        def not_fitted(job: tuple[type[Effect], Options]) -> FittedModel | None:
            work.leave_out(f"a fit with {self._name(job[0])}")
            return None

        def store(model: FittedModel) -> None:
            models[model.names] = model
            work.note_fit(model.names, model.fit.rms_m, prepared.expected_m("fit"))

        def on_fitted(job: tuple[type[Effect], Options], model: FittedModel | None) -> None:
            if model is not None:
                store(model)
            self.progress(self._refit_text(job[0], model, effects), next(done), len(effects))

        def on_continued(_: FittedModel, model: FittedModel) -> None:
            store(model)
            if model.fit.solution.iterations < POLISH.max_iterations:  # converged
                self.polished.add(model.names)

        text = f"refitting with one effect more; {self._best_text(effects)}"
        self.progress(text, len(effects) - len(unknown), len(effects))
        functions = (refitted, continue_fit)
        with side_by_side(prepared.work, functions, self.offered, len(unknown)) as pool:
            first = [e for e in unknown if e in effects[:FIRST] or e.file is not None]
            pool.map(refitted, [(e, REFIT) for e in first], not_fitted, on_fitted)
            above = (self._far([*effects[:FIRST], *first]), ENOUGH_PASSES)
            limited = replace(REFIT, above=above)
            # effects with most shapes take longest: they start first
            remaining = sorted((e for e in unknown if e not in first), key=lambda e: -shapes_of(e))
            pool.map(refitted, [(e, limited) for e in remaining], not_fitted, on_fitted)
            first_fits = self._fitted(effects)
            to_continue = self._to_continue(first_fits, self._far(effects))
            if to_continue and not work.spent:
                pool.map(continue_fit, to_continue, lambda model: model, on_continued)
        return [models[c.names] for c in first_fits]

    def _refit_text(
        self, effect: type[Effect], model: FittedModel | None, effects: Sequence[type[Effect]]
    ) -> str:
        """Text of a refit's own error, and of the best model so far, for the progress display."""
        text = f"refitted with {self._name(effect)}, "
        if model is None:
            return f"{text}no result; {self._best_text(effects)}"
        prepared, base_m = self.extension.prepared, self.extension.base.fit.rms_m
        error = error_text(prepared, base_m, model.fit.rms_m)
        return f"{text}{error}; {self._best_text(effects)}"

    def _best_text(self, effects: Sequence[type[Effect]]) -> str:
        """Text of the least error so far, and the effects of that model."""
        models = (self.extension.base, *self._fitted(effects))
        best = min(models, key=lambda c: c.fit.rms_m)
        names = " and ".join(e.name for e in best.effects) or "no effect added"
        return f"best so far with {names}, {error_text(self.extension.prepared, best.fit.rms_m)}"

    def _name(self, effect: type[Effect]) -> str:
        return " and ".join((*sorted(self.extension.base.names), effect.name))

    def _key(self, effect: type[Effect]) -> frozenset[str]:
        return frozenset({*self.extension.base.names, effect.name})

    def _fitted(self, effects: Sequence[type[Effect]]) -> list[FittedModel]:
        """The models so far with one of these effects added."""
        return [c for e in effects if (c := self.models.get(self._key(e))) is not None]

    def _far(self, effects: Sequence[type[Effect]]) -> float:
        """Objective above which a refit is far above the best with these effects."""
        fitted = self._fitted(effects)
        if not fitted:
            return np.inf
        best = min(c.fit.objective for c in fitted)
        fall = self.extension.base.fit.objective - best
        return max(FAR_ABOVE * best, best + FAR_FROM_FALL * fall)

    def _to_continue(self, models: Sequence[FittedModel], far: float) -> list[FittedModel]:
        """The likeliest models not far above the best, and all with a user's own effect."""
        ordered = sorted(models, key=lambda c: -c.predicted_evidence)
        return [
            c
            for place, c in enumerate(ordered)
            if (place < POLISHED and self._unpolished(c, far))
            or (c.effects[-1].file is not None and self._unpolished(c, np.inf))
        ]

    def _unpolished(self, model: FittedModel, far: float) -> bool:
        """Whether a model is worth continuing to convergence, and has not been."""
        if model.fit.solution.converged_or_idle or model.names in self.polished:
            return False
        return model.fit.objective <= far
