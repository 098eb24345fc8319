"""Sets of effects fitted to one study, each set once."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.gauss_newton import UNSIMULATED
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import ERRS, PreparedStudy
from cell.lab.data.progress import Progress, no_progress
from cell.lab.data.whitening import arcs_are_uncertain
from cell.lab.data.work import Work
from cell.lab.fit.corrected import corrected, moved_m
from cell.lab.fit.fitting import Fit, fit_model, pinned, space_with
from cell.lab.fit.gain import gain_is_uncertain
from cell.lab.fit.hand_error import HandError, hand_error
from cell.lab.fit.heldout import heldout_log_lr
from cell.lab.fit.mesh import matters
from cell.lab.fit.remainder import with_noise_beside
from cell.lab.fit.starts import cold_start, taken_from
from cell.lab.search.baseline import Baseline, BaselineFit
from cell.lab.search.extension import Extension, by_effect, continued
from cell.lab.search.fitted_model import POLISH, REFIT, FittedModel, Gain, gained, weighed
from cell.lab.search.refits import Refits
from cell.lab.search.screen import ScreenedEffect, screen
from cell.lab.search.stepwise import levels

#: Two fits of the same effects are different minima if one is so much likelier (logarithm).
LIKELIER = 0.1
#: p-value of the screen above which a smooth effect is not refitted beside a model that explains
#: the study. Measured on 61 studies: of 326 such refits none had p below 0.02.
BY_CHANCE = 0.1


@dataclass(eq=False)
class _FittedModels:
    """What has been fitted so far."""

    baseline: BaselineFit | None = None
    second: Fit | None = None
    prior: FittedModel | None = None
    models: dict[frozenset[str], FittedModel] = field(default_factory=dict)
    screens: dict[frozenset[str], list[ScreenedEffect]] = field(default_factory=dict)
    heldout_log_lr: dict[tuple[frozenset[str], str], float] = field(default_factory=dict)
    polished: set[frozenset[str]] = field(default_factory=set)
    reduced: set[tuple[frozenset[str], frozenset[str]]] = field(default_factory=set)


@dataclass(frozen=True, eq=False)
class FitCache:
    """Remembers every set of effects that it has fitted to one study.

    given     the study as it was made ready
    prior_q   an earlier individual's coordinates: an effect may be all that sets this one apart
    begin     where the baseline's fit begins; None = it is looked for
    sought    effects of `space` of which nothing is known: they are looked for as if the model
              lacked them where a fit from their typical size leaves more than the noise
    found     a model beside which noise and the mesh's error are known already
    earlier   models of the search that ended there, by their effects: where fits begin
    """

    given: PreparedStudy
    space: ParameterSpace
    library: Mapping[str, type[Effect]]
    progress: Progress = no_progress
    prior_q: FloatArray | None = None
    begin: FloatArray | None = None
    sought: tuple[type[Effect], ...] = ()
    found: FittedModel | None = None
    earlier: Mapping[frozenset[str], FittedModel] = field(default_factory=dict)
    _memory: _FittedModels = field(default_factory=_FittedModels)

    @property
    def work(self) -> Work:
        """What is simulated of the study; whoever waits may stop it."""
        return self.given.work

    @property
    def prepared(self) -> PreparedStudy:
        """The study with the noise that shows beside the baseline, and without its mesh's error.

        The baseline is fitted when it is first asked for.
        """
        return self._baseline_fit().prepared

    def _baseline_fit(self) -> BaselineFit:
        memory = self._memory
        if memory.baseline is None:
            known = {e.name for e in self.space.effects}
            others = [e for name, e in self.library.items() if name not in known]
            added = partial(_found_by_adding, self) if self.sought else None
            memory.baseline = Baseline(
                self.space,
                others,
                self.begin,
                self.prior_q is not None,
                added,
                self.found is not None,
                self.progress,
            ).fitted_to(self.given)
            memory.second = memory.baseline.second
        return memory.baseline

    def baseline(self) -> FittedModel:
        """The model with no effects beyond those that `space` brings along."""
        key, models = frozenset(e.name for e in self.space.effects), self._memory.models
        if key not in models:
            found = self._baseline_fit()
            models[key] = weighed(found.prepared, self.space.effects, found.fit)
            self._fit_found_again()
        return models[key]

    def _fit_found_again(self) -> None:
        """The model that was found, fitted to the study as it shows beside it."""
        if self.found is not None:
            with contextlib.suppress(*UNSIMULATED):
                found = continued(self.prepared, self.found, POLISH)
                self._memory.models[found.names] = found

    def explained_by(self, model: FittedModel) -> bool:
        """Whether a model leaves so little that the rest may be noise and the mesh's error."""
        return model.fit.rms_m <= ERRS * self.prepared.expected_m("fit")

    @property
    def second(self) -> Fit | None:
        """Where the baseline's fit ended from a second start, if one was tried."""
        return self._memory.second

    def second_start(self) -> Fit | None:
        """Where the baseline's fit ends from a second start; None where the first is good enough.

        The second is the tempered fit; of two that were compared it is the worse.
        """
        base, tempered = self.baseline(), self._tempered
        if self._memory.second is None and tempered is not None and not self.work.spent:
            with contextlib.suppress(*UNSIMULATED):
                self._memory.second = fit_model(
                    self.prepared, base.fit.space, tempered.q, options=POLISH
                )
        return self._memory.second

    @property
    def _tempered(self) -> Fit | None:
        """The baseline's fit with residuals divided, where it cannot fit."""
        return None if self._memory.baseline is None else self._memory.baseline.tempered

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

    def added(self, model: FittedModel) -> list[type[Effect]]:
        """Effects of a model that the baseline lacks."""
        return [e for e in model.effects if e not in self.space.effects]

    def gain(self, small: FittedModel, large: FittedModel) -> Gain:
        """What `large` has over `small`, which lacks one of its effects."""
        return gained(self.prepared, small, large, self.hand())

    def hand(self) -> HandError:
        """What the log of the hand may be wrong by, near the baseline."""
        return hand_error(self.prepared, self.baseline().fit)

    def screened(self, base: FittedModel) -> list[ScreenedEffect]:
        """Score tests of the whole library against a model, likeliest first.

        None of a model that was not screened before the work was stopped.
        """
        screens = self._memory.screens
        if base.names not in screens:
            if self.work.concluding:
                return []
            others = [e for n, e in self.library.items() if n not in base.names]
            screens[base.names] = screen(self.prepared, base.fit, others)
        return screens[base.names]

    def shortlist(self, base: FittedModel, best: int) -> list[type[Effect]]:
        """The `best` of the screen, and what it may misjudge: the rough, the found, and the user's.

        Beside a model that explains the study a refit gains no more than its screen says.
        """
        ranked = sorted(self.screened(base), key=lambda s: (s.score.p_value, -s.score.statistic))
        explained = self.prepared.noise_is_measured and self.explained_by(base)
        most = BY_CHANCE if explained else 1.0
        likely = [s.effect for s in ranked if s.score.p_value <= most][:best]
        known = () if self.found is None else self.found.names
        more = [
            s.effect
            for s in ranked
            if not s.effect.smooth or s.effect.name in known or s.effect.file is not None
        ]
        return [*likely, *(e for e in more if e not in likely)]

    def fit_extended(self, base: FittedModel, effects: Sequence[type[Effect]]) -> list[FittedModel]:
        """The model with each of the effects added to it, side by side on all cores.

        An effect with which the cable cannot be simulated from any start is left out.
        """
        memory = self._memory
        unknown = [e for e in effects if frozenset({*base.names, e.name}) not in self.earlier]
        screens = by_effect([*self.screened(base), *_screened_from_other_fits(self, base, unknown)])
        offered = (*self.library.values(), *base.effects, *effects)
        return Refits(
            _extension(self, base),
            screens,
            offered,
            self.earlier,
            memory.models,
            memory.polished,
            self.progress,
        ).with_each(effects)

    def heldout_log_lr(self, model: FittedModel, effect: type[Effect]) -> float:
        """ln of how much likelier an effect of a model must make the held-out trials."""
        known, key = self._memory.heldout_log_lr, (model.names, effect.name)
        if key not in known:
            known[key] = heldout_log_lr(self.prepared, model.fit, effect)
        return known[key]

    def fit_reduced(self, model: FittedModel, effect: type[Effect]) -> FittedModel:
        """The model with one effect taken out, refitted from where it was with it.

        Where that set of effects was fitted before, the likelier fit of the two: an effect
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
        q = taken_from(model.fit, space)
        try:
            return fit_model(self.prepared, space, q, model.fit.initial_states, options=REFIT)
        except UNSIMULATED:  # a cable that only the effect kept from collapsing
            q = cold_start(self.prepared, space)
            return fit_model(self.prepared, space, q, options=REFIT)


def settled_beside(fits: FitCache, found: FittedModel) -> FitCache | None:
    """A cache of the study with the noise and mesh error beside a found model, nothing fitted yet.

    Those beside the baseline, which could not fit, were others.  So were the lines of markers of
    uncertain arc length, the wrench of an uncertain gain, and the mean errors of rounded values.
    returns  None if that was done, if nothing changes noticeably, or if no model explains the study
    """
    before = fits.prepared
    if fits.found is not None or not (fits.explained_by(found) or before.mesh_m):
        return None
    others = [e for name, e in fits.library.items() if name not in found.names]
    prepared = with_noise_beside(before, found.fit, others)
    settled = corrected(prepared, found.fit)
    another = prepared.noise_model.differs_from(before.noise_model)
    of_model = arcs_are_uncertain(prepared.study) or gain_is_uncertain(prepared)
    if not (another or of_model or matters(prepared, moved_m(prepared, settled))):
        return None
    begin, earlier = fits.baseline().fit.q, {m.names: m for m in fits.known()}
    return replace(
        fits, given=settled, begin=begin, found=found, earlier=earlier, _memory=_FittedModels()
    )


def rebased(fits: FitCache, start: FloatArray, least: float) -> FitCache:
    """A cache with the baseline fitted from another start too, if χ² ends so much lower.

    It is the baseline then, and nothing is fitted beside it yet; else this cache itself.
    """
    base, memory = fits.baseline(), fits._memory
    with contextlib.suppress(*UNSIMULATED):  # where it ended nothing is simulated
        fit = fit_model(fits.prepared, base.fit.space, start, options=POLISH)
        if fit.objective < base.fit.objective - least:
            known = {base.names: weighed(fits.prepared, base.effects, fit)}
            others = _FittedModels(memory.baseline, memory.second, memory.prior, models=known)
            return replace(fits, _memory=others)
    return fits


def another_search(fits: FitCache, library: Mapping[str, type[Effect]]) -> FitCache:
    """A cache of the same study with other effects to try, nothing fitted yet."""
    return replace(fits, library=library, _memory=_FittedModels())


def with_joined(
    fits: FitCache, model: FittedModel, effect: type[Effect], names: Mapping[str, str]
) -> tuple[FitCache, FittedModel]:
    """The model with one effect that does what all its added effects do, and a cache for it.

    It is fitted from where the model is.
    names   of the effect's parameters, by those of the effects added
    raises  UnsimulatedError
    """
    effects = (*fits.space.effects, effect)
    before, space = model.fit.space, space_with(fits.space, effects)
    natural = space.natural(space.mean)
    for name, value in zip(before.names, before.natural(model.fit.q), strict=True):
        natural[space.names.index(names.get(name, name))] = value
    q = np.clip(space.coordinates(natural), space.low, space.high)
    fit = fit_model(fits.prepared, space, q, model.fit.initial_states, options=POLISH)
    joined, base = weighed(fits.prepared, effects, fit), fits.baseline()
    memory = _FittedModels(fits._memory.baseline, models={base.names: base, joined.names: joined})
    return replace(fits, library={effect.name: effect}, _memory=memory), joined


def _screened_from_other_fits(
    fits: FitCache, base: FittedModel, effects: Sequence[type[Effect]]
) -> list[ScreenedEffect]:
    """The same from the tempered baseline and from what was believed of the cable.

    Where the best baseline has been bent to imitate an effect, its slopes mislead.
    """
    if base is not fits.baseline() or not effects:
        return []
    found = [] if fits._tempered is None else screen(fits.prepared, fits._tempered, effects)
    if fits.prior_q is not None:
        found += screen(fits.prepared, fits.prior_candidate().fit, effects)
    return found


def _extension(fits: FitCache, base: FittedModel) -> Extension:
    """Where fits with one effect more begin."""
    origins = [base.fit.q]
    if fits._tempered is not None and base is fits.baseline():
        origins.append(fits._tempered.q)
    if fits.prior_q is not None:
        # An earlier individual is far from one with, say, a load: there slopes say little.
        origins.append(np.concatenate([fits.prior_q, base.fit.q[len(fits.prior_q) :]]))
    # Weighed by a model's own error, as a partial explanation is, no cable is bent to imitate.
    measured = base is fits.baseline() and fits.prepared.noise_is_measured
    misfit = measured and not fits.explained_by(base)
    far = fits.prior_q is not None
    return Extension(fits.prepared, base, tuple(origins), far, misfit)


def _found_by_adding(fits: FitCache, prepared: PreparedStudy) -> Fit | None:
    """The baseline's fit from where a search comes that adds the effects sought, one by one.

    None if the cable cannot be simulated so.
    """
    rest = [e for e in fits.space.effects if e not in fits.sought]
    space, library = space_with(fits.space, rest), {e.name: e for e in fits.sought}
    known = [i for i, name in enumerate(fits.space.names) if name in space.names]
    prior_q = None if fits.prior_q is None else fits.prior_q[known]
    search = FitCache(prepared, space, library, fits.progress, prior_q)

    def extended(model: FittedModel) -> list[FittedModel]:
        left = [e for e in fits.sought if e not in model.effects]
        return search.fit_extended(model, left) if left else []

    def likeliest(_: FittedModel, options: Sequence[FittedModel]) -> list[FittedModel]:
        return sorted(options, key=lambda c: c.fit.objective)[:1]

    with contextlib.suppress(*UNSIMULATED):
        *_, (found,) = levels(search.baseline(), extended, likeliest)
        if len(found.effects) < len(fits.space.effects):
            return None
        q = taken_from(found.fit, fits.space)
        inside = np.clip(q, fits.space.low, fits.space.high)
        states = found.fit.initial_states
        return fit_model(prepared, fits.space, inside, states, options=POLISH)
    return None
