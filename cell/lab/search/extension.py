"""A fitted model with one effect more: the likeliest result of fits from several starts."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.gauss_newton import UNSIMULATED, Options
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import ERRS, PreparedStudy
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
from cell.lab.search.fitted_model import POLISH, FittedModel, model_of_fit, penalty_of
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
    """A model of a study, and where fits with one effect more begin.

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
        starts = []
        for value in [*values, *typical(effect)]:
            q = extended(self.base.fit, space, effect, value)
            for i, name in enumerate(self.base.fit.space.names):
                q[space.names.index(name)] = origin[i]
            starts.append(q)
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


def by_effect(found: Sequence[ScreenedEffect]) -> Mapping[str, list[ScreenedEffect]]:
    """Screens by the effect's name, in order."""
    screens: dict[str, list[ScreenedEffect]] = {}
    for screened in found:
        screens.setdefault(screened.effect.name, []).append(screened)
    return screens
