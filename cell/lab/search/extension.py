"""A fitted model with one effect more: the likeliest result of fits from several starts.

`Extension` fits one effect, `Refits` several, side by side on all cores.
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
from cell.lab.data.prepared import ERRS, PreparedStudy
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
from cell.lab.fit.sensitivity import shapes_of
from cell.lab.fit.starts import cold_start, each_once, is_new, scaled, typical
from cell.lab.search.fitted_model import (
    POLISH,
    REFIT,
    FittedModel,
    error_text,
    model_of_fit,
    penalty_of,
)
from cell.lab.search.screen import MOST_SHAPES, ScreenedEffect

#: Residuals of a fit that is far from noise are divided by this times the root of its χ².
TEMPER = 3.0
#: Fits of an effect from different starts; friction has several minima.
SMOOTH_TRIES, ROUGH_TRIES = 1, 2
PLACES = 2
#: A refit that explains less than this share of what the screen promises is in a wrong minimum, if
#: there are other shapes to start from.
KEPT = 0.5
#: Passes after which a fit is given up that is still above what it has to be below.
ENOUGH_PASSES = 5
#: Passes of a fit that looks for a place.
SEARCH = Options(tolerance=0.3, max_iterations=10, least_gain=1e-3, updates=3)


@dataclass(frozen=True, eq=False)
class Extension:
    """A model of a study, with starting points of fits with one more effect.

    origins    (p,) coordinates of what the model has already: its own, and others it may come from
    far        whether the model may be far from the cable: then slopes say little of sizes
    misfit     whether the model leaves more than noise: its cable may not be plausible, so that a
               user's own effect is fitted from a uniform cable too
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
            unkept = not placed and fall < KEPT * screens[0].score.statistic
            if origin is base.fit.q and unkept:
                rest = [q for q in starts[: len(screens[0].starts)] if is_new(q, promising)]
                fits += self._fits_from(space, rest, options)
        if self.misfit and effect.file is not None:
            fits += self._fits_from(space, self._own_starts(space, effect), options)
        if not fits:
            return None
        # From a wrong place a force may follow the fitted motions best, and none beyond them.
        tried = fits if placed else [self._lowest(fits, effect, options)]
        best = min(
            (model_of_fit(self.prepared, effects, fit) for fit in tried), key=lambda c: c.chi2
        )
        return self.at_least_nested(best, options)

    def at_least_nested(self, extended_model: FittedModel, options: Options) -> FittedModel:
        """The model with one effect more, or its fit from the model itself if that ends lower.

        With the effect at zero it is the model itself: a fit of both that leaves more than the
        model alone has ended in a wrong place.
        """
        nested = self.base.fit.objective
        if extended_model.fit.objective <= nested or not np.isfinite(nested):
            return extended_model
        effect, space = extended_model.effects[-1], extended_model.fit.space
        off = np.array([p.default if p.amplitude else p.starts[0] for p in effect.parameters])
        fits = self._fits_from(space, [extended(self.base.fit, space, effect, off)], options)
        again = [model_of_fit(self.prepared, extended_model.effects, fit) for fit in fits]
        return min([extended_model, *again], key=lambda c: c.fit.objective)

    def _own_starts(self, space: ParameterSpace, effect: type[Effect]) -> list[FloatArray]:
        """A uniform cable with the effect at the values, and shares of them, that its file gives.

        Given a cable that was bent to imitate an effect no screen says where that effect is.
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
        """Coordinates with the sizes that the screens have found, then with typical ones."""
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
        found, initial_states = [], self.base.fit.initial_states
        for q in starts:
            with contextlib.suppress(*UNSIMULATED):
                alone = self.prepared.on_one_core()
                found.append(
                    fit_model(alone, space, q, initial_states, options=options, from_far=True)
                )
        return found

    def _lowest(self, fits: Sequence[Fit], effect: type[Effect], options: Options) -> Fit:
        """The fit that ends lowest, of fits from several starts.

        One that is on its way is no worse than one that has arrived.  So those are taken on that
        promise to end below all others, low enough for the effect to pay and to explain the study.
        """
        lowest = min(fits, key=lambda f: f.objective)
        if len(fits) == 1 or lowest.objective > options.above[0]:  # given up
            return lowest
        pays = self.base.fit.objective - penalty_of(self.prepared, [effect])
        noise = ERRS**2 * self.prepared.count(fit_trials(self.prepared))
        limit = min(lowest.objective, pays, noise)
        coming = [f for f in fits if f.promised_objective < limit]
        if all(f is lowest for f in coming):
            return lowest
        for fit in sorted(coming, key=lambda f: f.promised_objective):
            lowest = min(lowest, self._taken_on(fit, lowest.objective), key=lambda f: f.objective)
        return lowest

    def _taken_on(self, fit: Fit, lowest: float) -> Fit:
        """A fit taken to convergence, if it soon is the lowest; where that cannot be, as it is."""
        options = replace(POLISH, above=(lowest, ENOUGH_PASSES))
        with contextlib.suppress(*UNSIMULATED):
            alone = self.prepared.on_one_core()
            return fit_model(alone, fit.space, fit.q, fit.initial_states, options=options)
        return fit

    def _places(self, space: ParameterSpace, starts: Sequence[FloatArray]) -> list[FloatArray]:
        """Where tempered fits from all starts lead to, the best of them.

        The place of a force is found from far away only while the residuals are not yet asked to
        be noise.
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
        """The starts (lanes, p) with the least misfit, worth a fit each."""
        alone = self.prepared.on_one_core()
        square = np.sum(residuals(alone, space, fit_trials(alone), starts) ** 2, axis=1)
        order = np.argsort(np.where(np.isfinite(square), square, np.inf), kind="stable")
        return np.asarray(starts[order[:count]])


def _guesses(screens: Sequence[ScreenedEffect]) -> list[FloatArray]:
    """Parameter values of all screens."""
    return [start for screened in screens for start in screened.starts]


def continued(prepared: PreparedStudy, model: FittedModel, options: Options) -> FittedModel:
    """The model fitted from where it is, to the study as it is now.

    raises  UnsimulatedError
    """
    fit, alone = model.fit, prepared.on_one_core()
    again = fit_model(alone, fit.space, fit.q, fit.initial_states, options=options)
    return model_of_fit(prepared, model.effects, again)


#: So many of the first refits, those that promise most, are taken to convergence.
POLISHED = 3
#: A first refit is given up if it is soon far above the best of the first few effects, which are
#: the likeliest by the screen.
FIRST = 2
#: Far above the best is an objective so many times as large, if so much of the fall is missing that
#: the best effect brings.  A refit with a strong effect that misses a hundredth of the fall may be
#: ten times above the best, and yet end as low when it is taken on.
FAR_ABOVE, FAR_FROM_FALL = 10.0, 0.1


@dataclass(frozen=True, eq=False)
class Refits:
    """Refits of a model with one effect more.  A user's own effects are all taken to convergence.

    screens   by effect
    offered   effects that what is fitted may have
    earlier   models of an earlier search, as `models`: fits begin there
    models    by their effects' names: what is known; results are added to it
    polished  those that gain nothing by being taken on; added to, too
    """

    extension: Extension
    screens: Mapping[str, Sequence[ScreenedEffect]]
    offered: Sequence[type[Effect]]
    earlier: Mapping[frozenset[str], FittedModel]
    models: dict[frozenset[str], FittedModel]
    polished: set[frozenset[str]]
    progress: Progress

    def with_each(self, effects: Sequence[type[Effect]]) -> list[FittedModel]:
        """The model with each of the effects that it can be simulated with from some start."""
        prepared, models = self.extension.prepared, self.models
        work = prepared.work
        unknown = [e for e in effects if self._key(e) not in models]
        unknown = [e for e in unknown if work.affords(f"a fit with {self._name(e)}")]
        done = itertools.count(len(effects) - len(unknown) + 1)

        def refitted(job: tuple[type[Effect], Options]) -> FittedModel | None:
            effect, options = job
            if known := self.earlier.get(self._key(effect)):
                at_once = replace(options, above=(options.above[0], 1))
                with contextlib.suppress(*UNSIMULATED):
                    again = continued(prepared, known, at_once)
                    return self.extension.at_least_nested(again, options)
            return self.extension.by(effect, self.screens[effect.name], options)

        def taken_on(model: FittedModel) -> FittedModel:
            with contextlib.suppress(*UNSIMULATED):  # it ended where hardly anything is simulated
                return continued(prepared, model, POLISH)
            return model

        def not_fitted(job: tuple[type[Effect], Options]) -> FittedModel | None:
            work.leave_out(f"a fit with {self._name(job[0])}")
            return None

        def known_now(model: FittedModel) -> None:
            models[model.names] = model
            work.note_fit(model.names, model.fit.rms_m, prepared.expected_m("fit"))

        def was_fitted(job: tuple[type[Effect], Options], model: FittedModel | None) -> None:
            if model is not None:
                known_now(model)
            text = f"refitted with {self._name(job[0])}, {self._error_fall(effects)}"
            self.progress(text, next(done), len(effects))

        def was_taken_on(_: FittedModel, model: FittedModel) -> None:
            known_now(model)
            if model.fit.solution.iterations < POLISH.max_iterations:  # it gained no more
                self.polished.add(model.names)

        text = f"refitting with one effect more, {self._error_fall(effects)}"
        self.progress(text, len(effects) - len(unknown), len(effects))
        functions = (refitted, taken_on)
        with side_by_side(prepared.work, functions, self.offered, len(unknown)) as pool:
            first = [e for e in unknown if e in effects[:FIRST] or e.file is not None]
            pool.map(refitted, [(e, REFIT) for e in first], not_fitted, was_fitted)
            above = (self._far([*effects[:FIRST], *first]), ENOUGH_PASSES)
            hurried = replace(REFIT, above=above)
            # those with most shapes take longest, and so begin first
            rest = sorted((e for e in unknown if e not in first), key=lambda e: -shapes_of(e))
            pool.map(refitted, [(e, hurried) for e in rest], not_fitted, was_fitted)
            found = self._fitted(effects)
            rough = self._to_take_on(found, self._far(effects))
            if rough and not work.spent:
                pool.map(taken_on, rough, lambda model: model, was_taken_on)
        return [models[c.names] for c in found]

    def _error_fall(self, effects: Sequence[type[Effect]]) -> str:
        """How far the error has fallen by now, for who watches."""
        base_m = self.extension.base.fit.rms_m
        least_m = min((c.fit.rms_m for c in self._fitted(effects)), default=base_m)
        return error_text(self.extension.prepared, base_m, min(base_m, least_m))

    def _name(self, effect: type[Effect]) -> str:
        return " and ".join((*sorted(self.extension.base.names), effect.name))

    def _key(self, effect: type[Effect]) -> frozenset[str]:
        return frozenset({*self.extension.base.names, effect.name})

    def _fitted(self, effects: Sequence[type[Effect]]) -> list[FittedModel]:
        """What is known with these effects."""
        return [c for e in effects if (c := self.models.get(self._key(e))) is not None]

    def _far(self, effects: Sequence[type[Effect]]) -> float:
        """Objective from which a refit is far above the best with these effects."""
        fitted = self._fitted(effects)
        if not fitted:
            return np.inf
        best = min(c.fit.objective for c in fitted)
        fall = self.extension.base.fit.objective - best
        return max(FAR_ABOVE * best, best + FAR_FROM_FALL * fall)

    def _to_take_on(self, found: Sequence[FittedModel], far: float) -> list[FittedModel]:
        """The likeliest, unless they are far above the best, and all with a user's own effect."""
        ordered = sorted(found, key=lambda c: -c.promised_evidence)
        return [
            c
            for place, c in enumerate(ordered)
            if (place < POLISHED and self._unpolished(c, far))
            or (c.effects[-1].file is not None and self._unpolished(c, np.inf))
        ]

    def _unpolished(self, model: FittedModel, far: float) -> bool:
        """Whether a model is worth to be taken to convergence, and never was."""
        if model.fit.solution.converged_or_idle or model.names in self.polished:
            return False
        return model.fit.objective <= far
