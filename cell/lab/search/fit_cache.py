"""Sets of effects fitted to one study, each set once."""

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
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.progress import Progress, no_progress
from cell.lab.data.side_by_side import side_by_side
from cell.lab.fit.fitting import Fit, fit_model, fit_trials, pinned, space_with
from cell.lab.fit.hand_error import HandError, hand_error
from cell.lab.fit.heldout import heldout_log_lr
from cell.lab.fit.mesh import as_its_mesh_shows
from cell.lab.fit.sensitivity import shapes_of
from cell.lab.fit.starts import cold_start
from cell.lab.search.baseline import Baseline, BaselineFit
from cell.lab.search.extension import Extension, by_effect, polished
from cell.lab.search.fitted_model import POLISH, REFIT, FittedModel, Gain, gained, weighed
from cell.lab.search.screen import ScreenedEffect, screen
from cell.study.data import Trial

FloatArray = NDArray[np.float64]

#: Two fits of the same effects are different minima if one is so much likelier (logarithm).
LIKELIER = 0.1
#: So many of the first refits are taken to convergence.
POLISHED = 3
#: A first refit is given up if after some passes its objective is so many times that of the best of
#: the first few effects, the likeliest by the screen.
FAR_ABOVE, ENOUGH_PASSES, FIRST = 10.0, 5, 2


@dataclass(frozen=True)
class _Refit:
    """An effect with which a model is to be fitted."""

    effect: type[Effect]
    options: Options = REFIT


@dataclass(eq=False)
class _Memory:
    """What has been fitted so far."""

    baseline: BaselineFit | None = None
    second: Fit | None = None
    prior: FittedModel | None = None
    hand: HandError | None = None
    models: dict[frozenset[str], FittedModel] = field(default_factory=dict)
    screens: dict[frozenset[str], list[ScreenedEffect]] = field(default_factory=dict)
    heldout_log_lr: dict[tuple[frozenset[str], str], float] = field(default_factory=dict)
    polished: set[frozenset[str]] = field(default_factory=set)
    reduced: set[tuple[frozenset[str], frozenset[str]]] = field(default_factory=set)


@dataclass(eq=False)
class FitCache:
    """Remembers every set of effects that it has fitted to one study.

    prior_q   an earlier individual's coordinates: an effect may be all that sets this one apart
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
    _memory: _Memory = field(default_factory=_Memory)

    def baseline(self) -> FittedModel:
        """The model with no effects beyond those that `space` brings along.

        The study has the noise that shows beside it from then on, and its mesh's error no more.
        """
        key = frozenset(e.name for e in self.space.effects)
        if key not in self._memory.models:
            found = self._how_baseline_is_fitted().fitted_to(self.prepared)
            self.prepared = found.prepared
            self._memory.baseline, self._memory.second = found, found.second
            self._memory.models[key] = weighed(self.prepared, self.space.effects, found.fit)
        return self._memory.models[key]

    def _how_baseline_is_fitted(self) -> Baseline:
        known = frozenset(e.name for e in self.space.effects)
        return Baseline(
            self.space,
            [e for name, e in self.library.items() if name not in known],
            self.begin,
            self.prior_q is not None,
            self._found_by_adding if self.sought else None,
            self._settled,
            self.progress,
        )

    def _found_by_adding(self, prepared: PreparedStudy) -> Fit | None:
        """The baseline's fit from where a diagnosis comes that adds the `sought` effects.

        None if the cable cannot be simulated so.
        """
        rest = [e for e in self.space.effects if e not in self.sought]
        space, library = space_with(self.space, rest), {e.name: e for e in self.sought}
        known = [i for i, name in enumerate(self.space.names) if name in space.names]
        prior_q = None if self.prior_q is None else self.prior_q[known]
        search = FitCache(prepared, space, library, self.progress, prior_q)
        with contextlib.suppress(*UNSIMULATED):
            found = search.baseline()
            while left := [e for e in self.sought if e not in found.effects]:
                found = min(search.fit_extended(found, left), key=lambda c: c.fit.objective)
            q = _taken_from(found.fit, self.space)
            inside = np.clip(q, self.space.low, self.space.high)
            states = found.fit.initial_states
            return fit_model(prepared, self.space, inside, states, options=POLISH)
        return None

    def settle_mesh(self, found: FittedModel) -> bool:
        """Take the mesh's error by a model that was found out of the study, and forget all fits.

        The baseline's own, which imitated what was missing, was another.  Noise stays as it is.
        returns  whether that was to be done: once, and where the baseline's has been taken out
        """
        if self._settled or not self.prepared.mesh_m:
            return False
        self._before_settled = copy.copy(self)
        self.prepared, self._settled = as_its_mesh_shows(self.prepared, found.fit), True
        self._memory = _Memory()
        return True

    def recall(self) -> bool:
        """Know again what was known before `settle_mesh`, if nothing has been fitted since.

        returns  whether a baseline is known
        """
        if not self.baseline_is_fitted() and self._before_settled is not None:
            vars(self).update(vars(self._before_settled))
        return self.baseline_is_fitted()

    @property
    def second(self) -> Fit | None:
        """Where the baseline's fit ended from a second start, if one was tried."""
        return self._memory.second

    def second_start(self) -> Fit | None:
        """Where the baseline's fit ends from a second start; None where the first is good enough.

        The second is the tempered fit; of two that were compared it is the worse.
        """
        base, tempered = self.baseline(), self._tempered
        if self._memory.second is None and tempered is not None:
            with contextlib.suppress(*UNSIMULATED):
                self._memory.second = fit_model(
                    self.prepared, base.fit.space, tempered.q, options=POLISH
                )
        return self._memory.second

    @property
    def _tempered(self) -> Fit | None:
        """The baseline's fit with residuals divided, where it cannot fit."""
        return None if self._memory.baseline is None else self._memory.baseline.tempered

    def rebase(self, start: FloatArray, least: float) -> bool:
        """Fit the baseline from another start too; True if χ² ends lower by at least so much.

        It is the baseline then, and what was fitted beside the former one is forgotten.
        """
        base, memory = self.baseline(), self._memory
        with contextlib.suppress(*UNSIMULATED):  # where it ended nothing is simulated
            fit = fit_model(self.prepared, base.fit.space, start, options=POLISH)
            if fit.objective < base.fit.objective - least:
                known = {base.names: weighed(self.prepared, base.effects, fit)}
                self._memory = _Memory(memory.baseline, memory.second, memory.prior, models=known)
                return True
        return False

    def prior_candidate(self) -> FittedModel:
        """The earlier individual's model as it is; the baseline if there is none."""
        if self.prior_q is None:
            return self.baseline()
        if self._memory.prior is None:
            space = pinned(self.space, self.prior_q)
            fit = fit_model(self.prepared, space, self.prior_q, options=REFIT)
            self._memory.prior = weighed(self.prepared, self.space.effects, fit)
        return self._memory.prior

    def baseline_is_fitted(self) -> bool:
        """Whether the baseline has been fitted."""
        return frozenset(e.name for e in self.space.effects) in self._memory.models

    def known(self) -> tuple[FittedModel, ...]:
        """Every model so far."""
        return tuple(self._memory.models.values())

    def fitted_trials(self) -> tuple[Trial, ...]:
        """Trials that the models are fitted to."""
        return fit_trials(self.prepared)

    def added(self, model: FittedModel) -> list[type[Effect]]:
        """Effects of a model that the baseline lacks."""
        return [e for e in model.effects if e not in self.space.effects]

    def gain(self, small: FittedModel, large: FittedModel) -> Gain:
        """What `large` has over `small`, which lacks one of its effects."""
        return gained(self.prepared, small, large, self.hand())

    def hand(self) -> HandError:
        """What the log of the hand may be wrong by, near the baseline."""
        if self._memory.hand is None:
            self._memory.hand = hand_error(self.prepared, self.baseline().fit)
        return self._memory.hand

    def screened(self, base: FittedModel) -> list[ScreenedEffect]:
        """Score tests of the whole library against a model, likeliest first."""
        screens = self._memory.screens
        if base.names not in screens:
            others = [e for n, e in self.library.items() if n not in base.names]
            screens[base.names] = screen(self.prepared, base.fit, others)
        return screens[base.names]

    def shortlist(self, base: FittedModel, best: int) -> list[type[Effect]]:
        """The `best` of the screen, and what it may misjudge: all effects that are not smooth."""
        ranked = sorted(self.screened(base), key=lambda s: (s.score.p_value, -s.score.statistic))
        rough = [s.effect for s in ranked[best:] if not s.effect.smooth]
        return [s.effect for s in ranked[:best]] + rough

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

    def _extension(self, base: FittedModel) -> Extension:
        """Where fits with one effect more begin."""
        origins = [base.fit.q]
        if self._tempered is not None and base is self.baseline():
            origins.append(self._tempered.q)
        if self.prior_q is not None:
            # An earlier individual is far from one with, say, a load: there slopes say little.
            origins.append(np.concatenate([self.prior_q, base.fit.q[len(self.prior_q) :]]))
        return Extension(self.prepared, base, tuple(origins), far=self.prior_q is not None)

    def fit_extended(self, base: FittedModel, effects: Sequence[type[Effect]]) -> list[FittedModel]:
        """The model with each of the effects added to it, side by side on all cores.

        An effect with which the cable cannot be simulated from any start is left out.
        """
        screens = by_effect([*self.screened(base), *self._screened_elsewhere(base, effects)])
        extension, models = self._extension(base), self._memory.models
        keys = {e: frozenset({*base.names, e.name}) for e in effects}
        unknown = [e for e in effects if keys[e] not in models]
        done = itertools.count(len(effects) - len(unknown) + 1)

        def refitted(job: _Refit) -> FittedModel | None:
            return extension.by(job.effect, screens[job.effect.name], job.options)

        def taken_on(model: FittedModel) -> FittedModel:
            return polished(self.prepared, model)

        def was_fitted(job: _Refit, model: FittedModel | None) -> None:
            if model is not None:
                models[model.names] = model
            self.progress(f"refitted with {job.effect.name}", next(done), len(effects))

        def was_taken_on(_: FittedModel, model: FittedModel) -> None:
            models[model.names] = model
            if model.fit.solution.passes < POLISH.most_passes:  # it gained no more
                self._memory.polished.add(model.names)

        def least(of: Sequence[type[Effect]]) -> float:
            found = [c for e in of if (c := models.get(keys[e])) is not None]
            return min((c.fit.objective for c in found), default=np.inf)

        self.progress("refitting with one effect more", 0, len(effects))
        offered = (*self.library.values(), *base.effects, *effects)
        work, functions = self.prepared.work, (refitted, taken_on)
        with side_by_side(work, functions, offered, len(unknown)) as beside:
            first = [_Refit(e) for e in unknown if e in effects[:FIRST]]
            beside.map(refitted, first, was_fitted)
            hurried = replace(REFIT, above=(FAR_ABOVE * least(effects[:FIRST]), ENOUGH_PASSES))
            # those with most shapes take longest, and so begin first
            rest = [_Refit(e, hurried) for e in unknown if e not in effects[:FIRST]]
            beside.map(refitted, sorted(rest, key=lambda j: -shapes_of(j.effect)), was_fitted)
            found = [c for e in effects if (c := models.get(keys[e])) is not None]
            far = FAR_ABOVE * least(effects)
            likely = sorted(found, key=lambda c: -c.evidence)[:POLISHED]
            beside.map(taken_on, [c for c in likely if self._unpolished(c, far)], was_taken_on)
        return [models[c.names] for c in found]

    def _unpolished(self, model: FittedModel, far: float) -> bool:
        """Whether a model is worth to be taken to convergence, and never was."""
        if model.fit.solution.settled or model.names in self._memory.polished:
            return False
        return model.fit.objective <= far

    def heldout_log_lr(self, model: FittedModel, effect: type[Effect]) -> float:
        """ln of how much likelier an effect of a model must make the held-out trials."""
        known, key = self._memory.heldout_log_lr, (model.names, effect.name)
        if key not in known:
            known[key] = heldout_log_lr(self.prepared, model.fit, effect)
        return known[key]

    def fit_reduced(self, model: FittedModel, effect: type[Effect]) -> FittedModel:
        """The model with one effect taken out, refitted from where it was with it.

        Where that set of effects is known from elsewhere, the likelier fit of the two: an effect
        explains only what the same model without it does not, wherever its search began.
        """
        rest = tuple(e for e in model.effects if e is not effect)
        key, memory = frozenset(e.name for e in rest), self._memory
        known, way = memory.models.get(key), (model.names, key)
        if known is None or (len(rest) > len(self.space.effects) and way not in memory.reduced):
            memory.reduced.add(way)
            found = weighed(self.prepared, rest, self._taken_out(model, rest))
            if known is None or found.evidence > known.evidence + LIKELIER:
                memory.models[key] = found
        return memory.models[key]

    def _taken_out(self, model: FittedModel, rest: tuple[type[Effect], ...]) -> Fit:
        """A model's fit with only these of its effects."""
        space = space_with(model.fit.space, rest)
        q = _taken_from(model.fit, space)
        try:
            return fit_model(self.prepared, space, q, model.fit.initial_states, options=REFIT)
        except UNSIMULATED:  # a cable that only the effect kept from collapsing
            q = cold_start(self.prepared, space)
            return fit_model(self.prepared, space, q, options=REFIT)


def _taken_from(fit: Fit, space: ParameterSpace) -> FloatArray:
    """(p,) coordinates in a space whose parameters a fit has."""
    q = space.mean.copy()
    for i, name in enumerate(space.names):
        q[i] = fit.q[fit.space.names.index(name)]
    return q
