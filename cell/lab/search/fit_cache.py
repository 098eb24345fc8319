"""Fits sets of effects to a study, each set once, and weighs them against each other."""

from __future__ import annotations

import contextlib
import copy
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from cell.cable.effects.base import Effect
from cell.identify.gauss_newton import UNSIMULATED, Options
from cell.identify.parameters import ParameterSpace
from cell.lab.data.noise_floor import floor_of_all_frames
from cell.lab.data.prepared import ERRS, PreparedStudy
from cell.lab.data.progress import Progress, no_progress
from cell.lab.data.results import Errors
from cell.lab.data.side_by_side import side_by_side
from cell.lab.fit.fitting import (
    Fit,
    Heldout,
    errors_m,
    extended,
    fit_model,
    fit_trials,
    heldout,
    heldout_log_lr,
    pinned,
    residuals,
    space_with,
)
from cell.lab.fit.mesh import as_its_mesh_shows
from cell.lab.fit.remainder import remainder
from cell.lab.fit.sensitivity import chances_of, is_shape, shapes_of
from cell.lab.fit.slopes import with_slopes
from cell.lab.fit.starts import MOST_GUESSES, cold_start, each_once, is_new, scaled, typical
from cell.lab.search.screen import MOST_SHAPES, ScreenedEffect, screen
from cell.lab.statistics.score import boundary_p_value, delta_bic
from cell.study.data import Trial

FloatArray = NDArray[np.float64]

#: Above this χ² per value the baseline cannot fit, and a tempered fit is a better place to start.
MISFIT = 1.5
TEMPER = 3.0
#: Fits of an effect from different starts; friction has several minima.
SMOOTH_TRIES, ROUGH_TRIES = 1, 2
PLACES = 2
#: Two fits of the same effects are different minima if one is so much likelier (logarithm).
LIKELIER = 0.1
#: A refit that explains less than this share of what the screen promises is in a wrong minimum, if
#: there are other shapes to start from.
KEPT = 0.5
#: Passes of a first refit; the best few are then taken to convergence.
REFIT = Options(tolerance=0.3, most_passes=12, least_gain=1e-3, updates=3)
POLISH = Options(tolerance=0.1, most_passes=40, least_gain=1e-3, updates=3)
POLISHED = 3
#: A first refit is given up if after some passes its objective is so many times that of the best of
#: the first few effects, the likeliest by the screen.
FAR_ABOVE, ENOUGH_PASSES, FIRST = 10.0, 5, 2
#: A place is sought with residuals tempered by this much more.
SEARCH = Options(tolerance=0.3, most_passes=10, least_gain=1e-3, updates=3)


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A set of effects, fitted and weighed.

    evidence  ln of the fit trials' likelihood less BIC's penalty, plus that of the held-out trials
    """

    effects: tuple[type[Effect], ...]
    fit: Fit
    heldout: Heldout | None
    evidence: float

    @property
    def names(self) -> frozenset[str]:
        """Names of the effects."""
        return frozenset(e.name for e in self.effects)

    @property
    def errors(self) -> Errors:
        """Fitted and held-out error."""
        return Errors(self.fit.rms_m, self.heldout.rms_m if self.heldout else float("nan"))

    @property
    def chi2(self) -> float:
        """−2 ln likelihood of all trials, without penalty."""
        return self.fit.objective - 2.0 * (self.heldout.log_likelihood if self.heldout else 0.0)


@dataclass(frozen=True)
class Gain:
    """Gain by one more effect: fall of χ² on the fit trials, its p-value and BIC; held out."""

    delta_chi2: float
    p_value: float
    delta_bic: float
    heldout: float


@dataclass(frozen=True)
class _Refit:
    """An effect with which a candidate is to be fitted."""

    effect: type[Effect]
    options: Options = REFIT


@dataclass(eq=False)
class FitCache:
    """Remembers every set of effects that it has fitted to one study.

    believed  an earlier individual's coordinates: an effect may be all that sets this one apart
    begin     where the baseline's fit begins; None = it is looked for
    sought    effects of `space` of which nothing is known: they are looked for as if the model
              lacked them where a fit from their typical size leaves more than the noise
    """

    prepared: PreparedStudy
    space: ParameterSpace
    library: Mapping[str, type[Effect]]
    progress: Progress = no_progress
    prior_q: FloatArray | None = None
    begin: FloatArray | None = None
    sought: tuple[type[Effect], ...] = ()
    _settled: bool = False
    _before_settled: FitCache | None = None
    _known: dict[frozenset[str], FittedModel] = field(default_factory=dict)
    _screens: dict[frozenset[str], list[ScreenedEffect]] = field(default_factory=dict)
    _tempered: Fit | None = None
    _second_start: Fit | None = None
    _prior_candidate: FittedModel | None = None
    _heldout_log_lr: dict[tuple[frozenset[str], str], float] = field(default_factory=dict)
    _were_polished: set[frozenset[str]] = field(default_factory=set)
    _ways_down: set[tuple[frozenset[str], frozenset[str]]] = field(default_factory=set)

    def baseline(self) -> FittedModel:
        """The model with no effects beyond those that `space` brings along."""
        key = frozenset(e.name for e in self.space.effects)
        if key not in self._known:
            names = ", ".join(e.name for e in self.space.effects) or "no effects"
            self.progress(f"looking where to begin with {names}", 0, 3)
            start = self._beginning()
            self.progress(f"fitting the model with {names}", 1, 3)
            fit = fit_model(self.prepared, self.space, start, options=POLISH)
            judged = self.prepared.judged_by(errors_m(self.prepared, fit))
            if judged is not self.prepared:
                fit = fit_model(judged, self.space, start, options=POLISH)
                self.prepared = judged
            fit = self._beside_noise_and_mesh(fit)
            self.progress(f"weighing the model with {names}", 2, 3)
            count = self.prepared.count(fit_trials(self.prepared))
            errs = fit.rms_m > ERRS * self.prepared.expected.std_m
            if fit.chi2 > MISFIT * count or (self.sought and errs):
                best = self._from_other_starts(fit, start, count)
                if self.sought and best is not fit:  # another model, beside which noise is told
                    best = self._beside_noise_and_mesh(best)
                fit = best
            self.prepared, fit = with_slopes(self.prepared, fit)
            self._known[key] = self._weigh(self.space.effects, fit)
        return self._known[key]

    def _beside_noise_and_mesh(self, fit: Fit) -> Fit:
        """The fit with the noise that all frames tell beside it, within what the rest allows.

        And without its mesh's error, if it explains the study: one that does not has another.
        As it was where it cannot be simulated once more.
        """
        if self._settled:
            return fit
        before = self.prepared
        self._know_noise(fit)
        if fit.rms_m <= ERRS * self.prepared.expected.std_m:
            self.prepared = as_its_mesh_shows(self.prepared, fit)
        try:
            return fit_model(self.prepared, self.space, fit.q, fit.initial_states, options=POLISH)
        except UNSIMULATED:
            self.prepared = before
            return fit

    def settle_mesh(self, found: FittedModel) -> bool:
        """Take the mesh's error by a model that was found out of the study, and forget all fits.

        The baseline's own, which imitated what was missing, was another.  Noise stays as it is.
        returns  whether that was to be done: once, and where the baseline's has been taken out
        """
        if self._settled or not self.prepared.mesh_m:
            return False
        self._before_settled = copy.copy(self)
        self.prepared, self._settled = as_its_mesh_shows(self.prepared, found.fit), True
        self._tempered = self._second_start = self._prior_candidate = None
        self._known, self._screens, self._heldout_log_lr = {}, {}, {}
        self._were_polished, self._ways_down = set(), set()
        return True

    def recall(self) -> bool:
        """Know again what was known before `settle_mesh`, if nothing has been fitted since.

        returns  whether a baseline is known
        """
        if not self.baseline_is_fitted() and self._before_settled is not None:
            vars(self).update(vars(self._before_settled))
        return self.baseline_is_fitted()

    def _know_noise(self, fit: Fit) -> None:
        noise_model = self.prepared.noise_model
        if noise_model.rest is None or not self.prepared.noise_is_measured:
            return
        known = frozenset(e.name for e in self.space.effects)
        others = [e for name, e in self.library.items() if name not in known]
        noise_model = floor_of_all_frames(noise_model, remainder(self.prepared, fit, others))
        self.prepared = self.prepared.with_floor(noise_model)

    def _from_other_starts(self, fit: Fit, start: FloatArray, count: int) -> Fit:
        """The best fit of a baseline that cannot fit from its first start; the next is kept, too.

        A model that lacks something puts it into EI(s); the prior keeps a tempered fit plausible.
        """
        fits = [fit]
        residual_scale = TEMPER * float(np.sqrt(fit.chi2 / count))
        if (added := self._found_by_adding()) is not None:
            fits = sorted([fit, added], key=lambda f: f.objective)
        tempered = fit_model(
            self.prepared, self.space, start, residual_scale=residual_scale, options=REFIT
        )
        self._tempered = tempered
        if not fits[0].solution.converged:
            with contextlib.suppress(*UNSIMULATED):  # where it ended nothing is simulated
                fits.append(fit_model(self.prepared, self.space, tempered.q, options=POLISH))
        best, *others = sorted(fits, key=lambda f: f.objective)
        self._second_start = others[0] if others else None
        return best

    def _beginning(self) -> FloatArray:
        """Where the baseline's first fit begins."""
        if self.begin is not None:
            return self.begin
        start = cold_start(self.prepared, self.space)
        return start if self.prior_q is not None else self._of_likeliest_shape(self._scanned(start))

    def _found_by_adding(self) -> Fit | None:
        """The baseline's fit from where a diagnosis comes that adds the `sought` effects.

        None if it has none, or the cable cannot be simulated so.
        """
        if not self.sought:
            return None
        rest = [e for e in self.space.effects if e not in self.sought]
        space, library = space_with(self.space, rest), {e.name: e for e in self.sought}
        known = [i for i, name in enumerate(self.space.names) if name in space.names]
        prior_q = None if self.prior_q is None else self.prior_q[known]
        search = FitCache(self.prepared, space, library, self.progress, prior_q)
        with contextlib.suppress(*UNSIMULATED):
            found = search.baseline()
            while left := [e for e in self.sought if e not in found.effects]:
                found = min(search.fit_extended(found, left), key=lambda c: c.fit.objective)
            q = self.space.mean.copy()
            for i, name in enumerate(self.space.names):
                q[i] = found.fit.q[found.fit.space.names.index(name)]
            inside = np.clip(q, self.space.low, self.space.high)
            return fit_model(
                self.prepared, self.space, inside, found.fit.initial_states, options=POLISH
            )
        return None

    @property
    def second(self) -> Fit | None:
        """Where the baseline's fit ended from a second start, if one was tried."""
        return self._second_start

    def second_start(self) -> Fit | None:
        """Where the baseline's fit ends from a second start; None where the first is good enough.

        The second is the tempered fit; of two that were compared it is the worse.
        """
        base = self.baseline()
        if self._second_start is None and self._tempered is not None:
            with contextlib.suppress(*UNSIMULATED):
                start = self._tempered.q
                self._second_start = fit_model(self.prepared, base.fit.space, start, options=POLISH)
        return self._second_start

    def rebase(self, start: FloatArray, least: float) -> bool:
        """Fit the baseline from another start too; True if χ² ends lower by at least so much.

        It is the baseline then, and what was fitted beside the former one is forgotten.
        """
        base = self.baseline()
        with contextlib.suppress(*UNSIMULATED):  # where it ended nothing is simulated
            fit = fit_model(self.prepared, base.fit.space, start, options=POLISH)
            if fit.objective < base.fit.objective - least:
                self._known = {base.names: self._weigh(base.effects, fit)}
                self._screens, self._heldout_log_lr = {}, {}
                self._were_polished, self._ways_down = set(), set()
                return True
        return False

    def _scanned(self, start: FloatArray) -> FloatArray:
        """A start with effects that a fit finds from near only as the screen without them says."""
        narrow = [e for e in self.space.effects if any(p.scan for p in e.parameters)]
        if not narrow:
            return start
        rest = space_with(self.space, [e for e in self.space.effects if e not in narrow])
        q = start[[self.space.names.index(name) for name in rest.names]]
        natural = self.space.natural(start)
        with contextlib.suppress(*UNSIMULATED):
            fit = fit_model(self.prepared, rest, q, options=REFIT)
            for found in screen(self.prepared, fit, narrow):
                for p, value in zip(found.effect.parameters, found.starts[0], strict=True):
                    if (name := f"{found.effect.name}.{p.name}") in self.space.names:
                        natural[self.space.names.index(name)] = value
        inside = np.clip(self.space.coordinates(natural), self.space.low, self.space.high)
        return np.asarray(inside)

    def _of_likeliest_shape(self, start: FloatArray) -> FloatArray:
        """Where first refits end from a start, and from it with effects of other shapes."""
        starts = [start]
        for effect in self.space.effects:
            index = {
                p: self.space.names.index(name)
                for p in effect.parameters
                if (name := f"{effect.name}.{p.name}") in self.space.names
            }
            shapes = itertools.product(*(p.starts if is_shape(p) else p.starts[:1] for p in index))
            for values in list(shapes)[1:MOST_GUESSES]:
                natural = self.space.natural(start)
                natural[list(index.values())] = values
                inside = np.clip(self.space.coordinates(natural), self.space.low, self.space.high)
                starts.append(inside)
        if len(starts) == 1:
            return start
        fits = []
        for q in starts:
            with contextlib.suppress(*UNSIMULATED):
                fits.append(fit_model(self.prepared, self.space, q, options=REFIT))
        return min(fits, key=lambda f: f.objective).q if fits else start

    def prior_candidate(self) -> FittedModel:
        """The earlier individual's model as it is; the baseline if there is none."""
        if self.prior_q is None:
            return self.baseline()
        if self._prior_candidate is None:
            space = pinned(self.space, self.prior_q)
            fit = fit_model(self.prepared, space, self.prior_q, options=REFIT)
            self._prior_candidate = self._weigh(self.space.effects, fit)
        return self._prior_candidate

    @property
    def _alone(self) -> PreparedStudy:
        """The study for a fit that runs beside others: on one core."""
        return self.prepared.on_one_core()

    def baseline_is_fitted(self) -> bool:
        """Whether the baseline has been fitted."""
        return frozenset(e.name for e in self.space.effects) in self._known

    def known(self) -> tuple[FittedModel, ...]:
        """Every candidate so far."""
        return tuple(self._known.values())

    def screened(self, base: FittedModel) -> list[ScreenedEffect]:
        """Score tests of the whole library against a candidate, likeliest first."""
        if base.names not in self._screens:
            others = [e for n, e in self.library.items() if n not in base.names]
            self._screens[base.names] = screen(self.prepared, base.fit, others)
        return self._screens[base.names]

    def shortlist(self, base: FittedModel, best: int) -> list[type[Effect]]:
        """The `best` of the screen, and what it may misjudge: all effects that are not smooth."""
        ranked = sorted(self.screened(base), key=lambda s: (s.score.p_value, -s.score.statistic))
        rough = [s.effect for s in ranked[best:] if not s.effect.smooth]
        return [s.effect for s in ranked[:best]] + rough

    def fitted_trials(self) -> tuple[Trial, ...]:
        """Trials that the models are fitted to."""
        return fit_trials(self.prepared)

    def _screened_elsewhere(
        self, base: FittedModel, effects: Sequence[type[Effect]]
    ) -> list[ScreenedEffect]:
        """The same from the tempered baseline and from what was believed of the cable.

        Where the best baseline has been bent to imitate an effect, its slopes mislead.
        """
        if base is not self.baseline():
            return []
        found = [] if self._tempered is None else screen(self.prepared, self._tempered, effects)
        if self.prior_q is not None:
            found += screen(self.prepared, self.prior_candidate().fit, effects)
        return found

    def fit_extended(self, base: FittedModel, effects: Sequence[type[Effect]]) -> list[FittedModel]:
        """The candidate with each of the effects added to it, side by side on all cores.

        An effect with which the cable cannot be simulated from any start is left out.
        """
        screens: dict[str, list[ScreenedEffect]] = {}
        for screened in (*self.screened(base), *self._screened_elsewhere(base, effects)):
            screens.setdefault(screened.effect.name, []).append(screened)

        def refitted(job: _Refit) -> FittedModel | None:
            return self._extended(base, job.effect, screens[job.effect.name], job.options)

        keys = {e: frozenset({*base.names, e.name}) for e in effects}
        unknown = [e for e in effects if keys[e] not in self._known]
        done = itertools.count(len(effects) - len(unknown) + 1)

        def fitted(job: _Refit, candidate: FittedModel | None) -> None:
            if candidate is not None:
                self._known[candidate.names] = candidate
            self.progress(f"refitted with {job.effect.name}", next(done), len(effects))

        def polished(_: FittedModel, candidate: FittedModel) -> None:
            self._known[candidate.names] = candidate
            if candidate.fit.solution.passes < POLISH.most_passes:  # it gained no more
                self._were_polished.add(candidate.names)

        self.progress("refitting with one effect more", 0, len(effects))
        functions, offered = (
            (refitted, self._polished),
            (*self.library.values(), *base.effects, *effects),
        )
        with side_by_side(self.prepared.work, functions, offered, len(unknown)) as beside:
            first = [_Refit(e) for e in unknown if e in effects[:FIRST]]
            beside.map(refitted, first, fitted)
            found = [c for e in effects[:FIRST] if (c := self._known.get(keys[e])) is not None]
            best = min((c.fit.objective for c in found), default=np.inf)
            hurried = replace(REFIT, above=(FAR_ABOVE * best, ENOUGH_PASSES))
            # those with most shapes take longest, and so begin first
            rest = [_Refit(e, hurried) for e in unknown if e not in effects[:FIRST]]
            rest.sort(key=lambda job: -shapes_of(job.effect))
            beside.map(refitted, rest, fitted)
            found = [c for e in effects if (c := self._known.get(keys[e])) is not None]
            far = FAR_ABOVE * min((c.fit.objective for c in found), default=np.inf)
            likely = sorted(found, key=lambda c: -c.evidence)[:POLISHED]
            beside.map(self._polished, [c for c in likely if self._unpolished(c, far)], polished)
        return [self._known[c.names] for c in found]

    def _unpolished(self, candidate: FittedModel, far: float) -> bool:
        """Whether a candidate is worth to be taken to convergence, and never was."""
        if candidate.fit.solution.settled or candidate.names in self._were_polished:
            return False
        return candidate.fit.objective <= far

    def _polished(self, candidate: FittedModel) -> FittedModel:
        """The candidate taken to convergence, or as near as it comes.

        One that ended where the cable can hardly be simulated stays there.
        """
        with contextlib.suppress(*UNSIMULATED):
            fit = fit_model(
                self._alone,
                candidate.fit.space,
                candidate.fit.q,
                candidate.fit.initial_states,
                options=POLISH,
            )
            return self._weigh(candidate.effects, fit)
        return candidate

    def heldout_log_lr(self, candidate: FittedModel, effect: type[Effect]) -> float:
        """ln of how much likelier an effect of a candidate must make the held-out trials."""
        key = (candidate.names, effect.name)
        if key not in self._heldout_log_lr:
            self._heldout_log_lr[key] = heldout_log_lr(self.prepared, candidate.fit, effect)
        return self._heldout_log_lr[key]

    def fit_reduced(self, candidate: FittedModel, effect: type[Effect]) -> FittedModel:
        """The candidate with one effect taken out, refitted from where it was with it.

        Where that set of effects is known from elsewhere, the likelier fit of the two: an effect
        explains only what the same model without it does not, wherever its search began.
        """
        rest = tuple(e for e in candidate.effects if e is not effect)
        key = frozenset(e.name for e in rest)
        known, way = self._known.get(key), (candidate.names, key)
        if known is None or (len(rest) > len(self.space.effects) and way not in self._ways_down):
            self._ways_down.add(way)
            found = self._weigh(rest, self._taken_out(candidate, rest))
            if known is None or found.evidence > known.evidence + LIKELIER:
                self._known[key] = found
        return self._known[key]

    def _taken_out(self, candidate: FittedModel, rest: tuple[type[Effect], ...]) -> Fit:
        """A candidate's fit with only these of its effects."""
        space = space_with(candidate.fit.space, rest)
        q = space.mean.copy()
        for i, name in enumerate(space.names):
            q[i] = candidate.fit.q[candidate.fit.space.names.index(name)]
        try:
            return fit_model(self.prepared, space, q, candidate.fit.initial_states, options=REFIT)
        except UNSIMULATED:  # a cable that only the effect kept from collapsing
            q = cold_start(self.prepared, space)
            return fit_model(self.prepared, space, q, options=REFIT)

    def gain(self, small: FittedModel, large: FittedModel) -> Gain:
        """What `large` has over `small`, which lacks one of its effects."""
        effect = next(e for e in large.effects if e.name not in small.names)
        amplitudes = [p for p in effect.parameters if p.amplitude]
        bounded = int(len(amplitudes) == 1 and amplitudes[0].low >= amplitudes[0].default)
        fall = small.fit.objective - large.fit.objective
        count = self.prepared.count(fit_trials(self.prepared))
        held = 0.0
        if small.heldout and large.heldout:
            held = large.heldout.log_likelihood - small.heldout.log_likelihood
        return Gain(
            delta_chi2=fall,
            p_value=boundary_p_value(fall, len(amplitudes), bounded, chances_of(effect)),
            delta_bic=delta_bic(
                fall,
                sum(p.fitted for p in effect.parameters),
                count,
                self.prepared.noise_model.effective_fraction,
            ),
            heldout=held,
        )

    def _extended(
        self,
        base: FittedModel,
        effect: type[Effect],
        screens: Sequence[ScreenedEffect],
        options: Options,
    ) -> FittedModel | None:
        """The candidate with an effect added, from the starts that each screen has found.

        The first screen is of the candidate itself.
        """
        effects = (*base.effects, effect)
        space = space_with(base.fit.space, effects)
        origins = [base.fit.q]
        if self._tempered is not None and base is self.baseline():
            origins.append(self._tempered.q)
        if self.prior_q is not None:
            origins.append(np.concatenate([self.prior_q, base.fit.q[len(self.prior_q) :]]))
        fits: list[Fit] = []
        guesses = [start for screened in screens for start in screened.starts]
        # An earlier individual is far from one with, say, a load: there slopes say little.
        values = list(guesses) if self.prior_q is None else scaled(effect, guesses)
        placed = shapes_of(effect) > MOST_SHAPES
        for origin in origins[-1:] if placed else origins:
            starts = []
            for value in [*values, *typical(effect)]:
                q = extended(base.fit, space, effect, value)
                for i, name in enumerate(base.fit.space.names):
                    q[space.names.index(name)] = origin[i]
                starts.append(q)
            if placed:
                promising = self._sought(base, space, starts[: len(guesses)])
            else:
                tries = SMOOTH_TRIES if effect.smooth else ROUGH_TRIES
                promising = list(self._promising(space, np.array(starts), tries))
                if shapes_of(effect) > 1:
                    likeliest = np.cumsum([0, *(len(s.starts) for s in screens)])[:-1]
                    promising += [
                        q for q in map(starts.__getitem__, likeliest) if is_new(q, promising)
                    ]
            fits += self._fits_from(space, each_once(promising), base.fit.initial_states, options)
            fall = base.fit.objective - min((f.objective for f in fits), default=np.inf)
            unkept = not placed and fall < KEPT * screens[0].score.statistic
            if origin is base.fit.q and unkept:
                rest = [q for q in starts[: len(screens[0].starts)] if is_new(q, promising)]
                fits += self._fits_from(space, rest, base.fit.initial_states, options)
        if not fits:
            return None
        # Of a force at a place, what follows the fitted motions best may do anything beyond them.
        tried = fits if placed else [min(fits, key=lambda f: f.objective)]
        return max((self._weigh(effects, fit) for fit in tried), key=lambda c: c.evidence)

    def _fits_from(
        self,
        space: ParameterSpace,
        starts: Sequence[FloatArray],
        initial_states: dict[str, FloatArray],
        options: Options,
    ) -> list[Fit]:
        """Fits from starts at which the cable can be simulated."""
        found = []
        for q in starts:
            with contextlib.suppress(*UNSIMULATED):
                found.append(
                    fit_model(self._alone, space, q, initial_states, options=options, from_far=True)
                )
        return found

    def _sought(
        self, base: FittedModel, space: ParameterSpace, starts: Sequence[FloatArray]
    ) -> list[FloatArray]:
        """Where tempered fits from all starts lead to, the best of them.

        The place of a force is found from far away only while the residuals are not yet asked to
        be noise.
        """
        count = self.prepared.count(fit_trials(self.prepared))
        residual_scale = TEMPER * max(1.0, float(np.sqrt(base.fit.chi2 / count)))
        fits = []
        for q in starts:
            try:
                fit = fit_model(
                    self._alone,
                    space,
                    q,
                    residual_scale=residual_scale,
                    options=SEARCH,
                    from_far=True,
                )
                fits.append(fit)
            except UNSIMULATED:
                continue
        return [f.q for f in sorted(fits, key=lambda f: f.objective)[:PLACES]]

    def _promising(self, space: ParameterSpace, starts: FloatArray, count: int) -> FloatArray:
        """The starts (lanes, p) with the least misfit, worth a fit each."""
        trials = fit_trials(self.prepared)
        square = np.sum(residuals(self._alone, space, trials, starts) ** 2, axis=1)
        order = np.argsort(np.where(np.isfinite(square), square, np.inf), kind="stable")
        return np.asarray(starts[order[:count]])

    def _weigh(self, effects: tuple[type[Effect], ...], fit: Fit) -> FittedModel:
        held = heldout(self._alone, fit)
        count = self.prepared.count(fit_trials(self.prepared))
        extra = sum(p.fitted for e in effects for p in e.parameters)
        penalty = -delta_bic(0.0, extra, count, self.prepared.noise_model.effective_fraction)
        evidence = -0.5 * (fit.objective + penalty) + (held.log_likelihood if held else 0.0)
        return FittedModel(effects, fit, held, evidence)
