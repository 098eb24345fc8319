"""Sets of effects fitted to one study, each set once; the baseline first."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.gauss_newton import UNSIMULATED
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import ERROR_RATIO, PreparedStudy, arcs_are_uncertain
from cell.lab.data.rules import Rules
from cell.lab.data.work import Progress, Work
from cell.lab.fit.corrections import (
    corrected,
    gain_is_uncertain,
    moved_m,
    moves_parameters,
    with_conditional_noise,
)
from cell.lab.fit.fitting import Fit, fit_model, pinned, space_with, start_from
from cell.lab.fit.heldout import heldout_log_lr
from cell.lab.fit.score_test import ScreenedEffect, screen
from cell.lab.fit.systematic_error import GripperLogError, gripper_log_error
from cell.lab.search.baseline import SearchSetup, fit_baseline
from cell.lab.search.extension import Extension, Refits, cold_start, continued
from cell.lab.search.fitted_model import (
    POLISH,
    REFIT,
    FittedModel,
    Gain,
    added_effect,
    corrected_gain,
    error_over_noise,
    model_of_fit,
    p_value_of_fall,
    penalty_of,
    removed_share,
    residual_summary,
)
from cell.lab.search.stepwise import levels

#: Difference of ln likelihood from which two fits of the same effects are different minima.
LIKELIER = 0.1
#: p-value of the screen above which a smooth effect is not refitted, if the model explains the
#: study. Measured on 61 studies: of 326 such refits none had p below 0.02.
BY_CHANCE = 0.1


@dataclass(eq=False)
class _Memory:
    """Models fitted so far beyond the baseline, and their screens."""

    models: dict[frozenset[str], FittedModel]
    second: Fit | None = None
    prior: FittedModel | None = None
    screens: dict[frozenset[str], list[ScreenedEffect]] = field(default_factory=dict)
    heldout_log_lr: dict[tuple[frozenset[str], str], float] = field(default_factory=dict)
    polished: set[frozenset[str]] = field(default_factory=set)
    reduced: set[tuple[frozenset[str], frozenset[str]]] = field(default_factory=set)


@dataclass(frozen=True, eq=False)
class FitCache:
    """Models fitted to one study, each set of effects once.

    prepared  the study with the noise and without the mesh error estimated given the baseline
    base      the baseline: the model with no effects beyond those of the setup's space
    tempered  the baseline's fit with residuals scaled down, where the baseline cannot fit
    """

    setup: SearchSetup
    prepared: PreparedStudy
    base: FittedModel
    tempered: Fit | None
    _memory: _Memory

    @staticmethod
    def of(setup: SearchSetup) -> FitCache:
        """Fit the baseline of a study, and the reference model again.

        raises  UnsimulatedError, WorkStoppedError
        """
        by_adding = partial(_fit_by_adding, setup) if setup.unknown_effects else None
        baseline = fit_baseline(setup, by_adding)
        prepared = baseline.prepared
        base = model_of_fit(prepared, setup.space.effects, baseline.fit)
        models = {base.names: base}
        if setup.reference is not None:
            with contextlib.suppress(*UNSIMULATED):
                refitted = continued(prepared, setup.reference, POLISH)
                models[refitted.names] = refitted
        return FitCache(
            setup, prepared, base, baseline.tempered, _Memory(models, second=baseline.second)
        )

    @property
    def space(self) -> ParameterSpace:
        """Parameters of the baseline."""
        return self.setup.space

    @property
    def library(self) -> Mapping[str, type[Effect]]:
        """Effects that may be added, by name."""
        return self.setup.library

    @property
    def progress(self) -> Progress:
        """Callback that receives the progress of the fits."""
        return self.setup.progress

    @property
    def prior_q(self) -> FloatArray | None:
        """Coordinates of an earlier individual's model."""
        return self.setup.prior_q

    @property
    def rules(self) -> Rules:
        """Limits for accepting an effect."""
        return self.setup.rules

    def with_rules(self, rules: Rules) -> FitCache:
        """The same fits, with other limits for their effects."""
        return replace(self, setup=replace(self.setup, rules=rules))

    @property
    def tried(self) -> int:
        """Number of effects that may be added to the baseline."""
        return sum(name not in self.base.names for name in self.library)

    @property
    def work(self) -> Work:
        """Budget of simulations of the study; the caller may stop it."""
        return self.setup.prepared.work

    def explained_by(self, model: FittedModel) -> bool:
        """Whether a model's residual may be noise and the mesh's error."""
        return model.fit.rms_m <= ERROR_RATIO * self.prepared.expected_m("fit")

    def is_below_stated(self, model: FittedModel) -> bool:
        """Whether a model's error is less than a share of the error that the study states."""
        error = error_over_noise(self.prepared, model)
        return self.prepared.noise_model.stated and error < self.rules.below_stated

    @property
    def second(self) -> Fit | None:
        """The baseline's fit from a second start, if one was tried."""
        return self._memory.second

    def second_start(self) -> Fit | None:
        """The baseline's fit from a second start; None where the first is good enough.

        The second start is the tempered fit; of two fits already compared it is the worse one.
        """
        if self._memory.second is None and self.tempered is not None and not self.work.spent:
            with contextlib.suppress(*UNSIMULATED):
                self._memory.second = fit_model(
                    self.prepared, self.base.fit.space, self.tempered.q, options=POLISH
                )
        return self._memory.second

    def prior_candidate(self) -> FittedModel:
        """The earlier individual's model as it is; the baseline if there is none."""
        if self.prior_q is None:
            return self.base
        if self._memory.prior is None:
            space = pinned(self.space, self.prior_q)
            fit = fit_model(self.prepared, space, self.prior_q, options=REFIT)
            self._memory.prior = model_of_fit(self.prepared, self.space.effects, fit)
        return self._memory.prior

    def known(self) -> tuple[FittedModel, ...]:
        """Every model so far."""
        return tuple(self._memory.models.values())

    def added(self, model: FittedModel) -> list[type[Effect]]:
        """Effects of a model that the baseline lacks."""
        return [e for e in model.effects if e not in self.space.effects]

    def gain(self, small: FittedModel, large: FittedModel) -> Gain:
        """Gain of `large` over `small`, which lacks one of its effects."""
        effect, (fall, heldout_gain) = added_effect(small, large), self.corrected_gain(small, large)
        return Gain(
            delta_chi2=small.fit.objective - large.fit.objective,
            p_value=p_value_of_fall(effect, fall),
            delta_bic=fall - penalty_of(self.prepared, [effect]),
            heldout=heldout_gain,
        )

    def corrected_gain(self, small: FittedModel, large: FittedModel) -> tuple[float, float]:
        """Fall of the objective and held-out ln likelihood ratio, as `corrected_gain`."""
        return corrected_gain(self.prepared, small, large, self.gripper_log_error())

    def removed_share(self, before: FittedModel, after: FittedModel) -> float:
        """Share, 0 … 1, of a model's error beyond noise that another removes, over all trials."""
        summaries = (residual_summary(self.prepared, model) for model in (before, after))
        return removed_share(self.prepared.noise_model.noise.std_m, *summaries)

    def gripper_log_error(self) -> GripperLogError:
        """Possible error of the gripper log, linearised at the baseline."""
        return gripper_log_error(self.prepared, self.base.fit)

    def screened(self, base: FittedModel) -> list[ScreenedEffect]:
        """Score tests of the complete library against a model, likeliest first.

        Empty if the work was stopped before the model was screened.
        """
        screens = self._memory.screens
        if base.names not in screens:
            if self.work.concluding:
                return []
            others = [e for n, e in self.library.items() if n not in base.names]
            screens[base.names] = screen(self.prepared, base.fit, others)
        return screens[base.names]

    def shortlist(self, base: FittedModel, best: int) -> list[type[Effect]]:
        """The `best` effects of the screen, and those that it may misjudge.

        These are non-smooth effects, the reference model's, and the user's.  If the model explains
        the study, the screen predicts the gain of a refit well: unlikely effects are left out.
        """
        ranked = sorted(self.screened(base), key=lambda s: (s.score.p_value, -s.score.statistic))
        explained = self.prepared.noise_is_measured and self.explained_by(base)
        limit = BY_CHANCE if explained else 1.0
        likely = [s.effect for s in ranked if s.score.p_value <= limit][:best]
        reference = self.setup.reference
        reference_names = () if reference is None else reference.names
        added = [
            s.effect
            for s in ranked
            if not s.effect.smooth or s.effect.name in reference_names or s.effect.file is not None
        ]
        return [*likely, *(e for e in added if e not in likely)]

    def fit_extended(self, base: FittedModel, effects: Sequence[type[Effect]]) -> list[FittedModel]:
        """The model with each of the effects added to it, fitted in parallel on all cores.

        An effect with which the cable cannot be simulated from any start is left out.
        """
        memory = self._memory
        unknown = [e for e in effects if frozenset({*base.names, e.name}) not in self.setup.earlier]
        screens: dict[str, list[ScreenedEffect]] = {}
        for screened in (*self.screened(base), *_alternative_screens(self, base, unknown)):
            screens.setdefault(screened.effect.name, []).append(screened)
        offered = (*self.library.values(), *base.effects, *effects)
        return Refits(
            _extension(self, base),
            screens,
            offered,
            self.setup.earlier,
            memory.models,
            memory.polished,
            self.progress,
        ).with_each(effects)

    def heldout_log_lr(self, model: FittedModel, effect: type[Effect]) -> float:
        """Expected held-out ln likelihood ratio of an effect of a model."""
        cached, key = self._memory.heldout_log_lr, (model.names, effect.name)
        if key not in cached:
            cached[key] = heldout_log_lr(self.prepared, model.fit, effect)
        return cached[key]

    def extended(self, model: FittedModel) -> list[FittedModel]:
        """The models with one further effect, for the likeliest effects of the screen."""
        return self.fit_extended(model, self.shortlist(model, self.rules.max_refits))

    def with_effects(self, names: Sequence[str]) -> FittedModel | None:
        """The baseline with these effects; None if that cannot be simulated."""
        model = self.base
        for name in names:
            if name not in self.base.names:
                extended = self.fit_extended(model, [self.library[name]])
                if not extended:
                    return None
                model = extended[0]
        return model

    def reduced(self, model: FittedModel) -> Iterator[FittedModel]:
        """Yield the model without each of its added effects, refitted one after another."""
        return (self.fit_reduced(model, e) for e in self.added(model))

    def fit_reduced(self, model: FittedModel, effect: type[Effect]) -> FittedModel:
        """The model without one effect, refitted from the parameters of the model with it.

        Where that set of effects was fitted before, the likelier of the two fits, so that an effect
        is compared with the best model without it.
        """
        rest = tuple(e for e in model.effects if e is not effect)
        key, memory = frozenset(e.name for e in rest), self._memory
        cached, step = memory.models.get(key), (model.names, key)
        if cached is None or (len(rest) > len(self.space.effects) and step not in memory.reduced):
            memory.reduced.add(step)
            refitted = model_of_fit(self.prepared, rest, self._fit_without(model, rest))
            if cached is None or refitted.evidence > cached.evidence + LIKELIER:
                memory.models[key] = refitted
        return memory.models[key]

    def _fit_without(self, model: FittedModel, rest: tuple[type[Effect], ...]) -> Fit:
        """The model refitted with only the effects in `rest`."""
        space = space_with(model.fit.space, rest)
        q = start_from(model.fit, space)
        try:
            return fit_model(self.prepared, space, q, model.fit.initial_states, options=REFIT)
        except UNSIMULATED:  # without the effect the cable collapses
            q = cold_start(self.prepared, space)
            return fit_model(self.prepared, space, q, options=REFIT)


def noise_reestimated(fits: FitCache, model: FittedModel) -> SearchSetup | None:
    """The setup of a repeated search: noise and mesh error re-estimated given a model.

    The estimates given the baseline, which could not fit, were wrong, and so were the positions of
    markers of uncertain arc length, the gain of the wrench, and the mean errors of rounded values.
    returns  None if already re-estimated, if nothing changes noticeably, or if the model does not
             explain the study
    """
    before = fits.prepared
    if fits.setup.reference is not None or not (fits.explained_by(model) or before.mesh_m):
        return None
    others = [e for name, e in fits.library.items() if name not in model.names]
    prepared = with_conditional_noise(before, model.fit, others)
    refined = corrected(prepared, model.fit)
    noise_differs = prepared.noise_model.differs_from(before.noise_model)
    of_model = arcs_are_uncertain(prepared.study) or gain_is_uncertain(prepared)
    if not (noise_differs or of_model or moves_parameters(prepared, moved_m(prepared, refined))):
        return None
    return replace(
        fits.setup,
        prepared=refined,
        start_q=fits.base.fit.q,
        reference=model,
        earlier={m.names: m for m in fits.known()},
    )


def with_lower_baseline(fits: FitCache, start: FloatArray, least: float) -> FitCache:
    """A cache whose baseline is fitted from another start, if that lowers χ² by `least` or more.

    The new cache has no further models yet; otherwise this cache itself is returned.
    """
    base, memory = fits.base, fits._memory
    with contextlib.suppress(*UNSIMULATED):  # the start may not be simulable
        fit = fit_model(fits.prepared, base.fit.space, start, options=POLISH)
        if fit.objective < base.fit.objective - least:
            lower = model_of_fit(fits.prepared, base.effects, fit)
            lower_memory = _Memory({lower.names: lower}, memory.second, memory.prior)
            return replace(fits, base=lower, _memory=lower_memory)
    return fits


def with_joined(
    fits: FitCache, model: FittedModel, effect: type[Effect], names: Mapping[str, str]
) -> tuple[FitCache, FittedModel]:
    """The model with its added effects replaced by one equivalent effect, and a cache for it.

    Its fit starts at the model's parameters.
    names   of the effect's parameters, by the names in the added effects
    raises  UnsimulatedError
    """
    effects = (*fits.space.effects, effect)
    before, space = model.fit.space, space_with(fits.space, effects)
    natural = space.natural(space.mean)
    for name, value in zip(before.names, before.natural(model.fit.q), strict=True):
        natural[space.names.index(names.get(name, name))] = value
    q = np.clip(space.coordinates(natural), space.low, space.high)
    fit = fit_model(fits.prepared, space, q, model.fit.initial_states, options=POLISH)
    joined = model_of_fit(fits.prepared, effects, fit)
    memory = _Memory({m.names: m for m in (fits.base, joined)})
    setup = replace(fits.setup, library={effect.name: effect})
    return replace(fits, setup=setup, _memory=memory), joined


def _alternative_screens(
    fits: FitCache, base: FittedModel, effects: Sequence[type[Effect]]
) -> list[ScreenedEffect]:
    """Screens of the tempered baseline and of the prior's model.

    A baseline that imitates an effect by its parameters has misleading slopes.
    """
    if base is not fits.base or not effects:
        return []
    screened = [] if fits.tempered is None else screen(fits.prepared, fits.tempered, effects)
    if fits.prior_q is not None:
        screened += screen(fits.prepared, fits.prior_candidate().fit, effects)
    return screened


def _extension(fits: FitCache, base: FittedModel) -> Extension:
    """Starting points of fits with one further effect."""
    origins = [base.fit.q]
    if fits.tempered is not None and base is fits.base:
        origins.append(fits.tempered.q)
    if fits.prior_q is not None:
        # An earlier individual may be far away, as without a load: slopes are inaccurate there.
        origins.append(np.concatenate([fits.prior_q, base.fit.q[len(fits.prior_q) :]]))
    # With a model's own error as noise (partial explanation), no fit is distorted that much.
    measured = base is fits.base and fits.prepared.noise_is_measured
    misfit = measured and not fits.explained_by(base)
    far = fits.prior_q is not None
    return Extension(fits.prepared, base, tuple(origins), far, misfit)


def _fit_by_adding(setup: SearchSetup, prepared: PreparedStudy) -> Fit | None:
    """The baseline's fit from the end of a search that adds the unknown effects one by one.

    None if the cable cannot be simulated on the way.
    """
    unknown = setup.unknown_effects
    known_effects = [e for e in setup.space.effects if e not in unknown]
    space = space_with(setup.space, known_effects)
    baseline_index = [i for i, name in enumerate(setup.space.names) if name in space.names]
    prior_q = None if setup.prior_q is None else setup.prior_q[baseline_index]
    library = {e.name: e for e in unknown}
    with contextlib.suppress(*UNSIMULATED):
        search = FitCache.of(SearchSetup(prepared, space, library, setup.progress, prior_q))

        def extended(model: FittedModel) -> list[FittedModel]:
            remaining = [e for e in unknown if e not in model.effects]
            return search.fit_extended(model, remaining) if remaining else []

        def likeliest(_: FittedModel, options: Sequence[FittedModel]) -> list[FittedModel]:
            return sorted(options, key=lambda c: c.fit.objective)[:1]

        *_, (model,) = levels(search.base, extended, likeliest)
        if len(model.effects) < len(setup.space.effects):
            return None
        q = np.clip(start_from(model.fit, setup.space), setup.space.low, setup.space.high)
        states = model.fit.initial_states
        return fit_model(prepared, setup.space, q, states, options=POLISH)
    return None
