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
from cell.lab.data.prepared import ERRS, PreparedStudy, arcs_are_uncertain
from cell.lab.data.thresholds import Rules
from cell.lab.data.work import Progress, Work
from cell.lab.fit.corrections import (
    corrected,
    gain_is_uncertain,
    moved_m,
    moves_parameters,
    with_noise_given,
)
from cell.lab.fit.fitting import Fit, fit_model, pinned, space_with, taken_from
from cell.lab.fit.heldout import heldout_log_lr
from cell.lab.fit.starts import cold_start
from cell.lab.fit.systematic_error import GripperLogError, gripper_log_error
from cell.lab.search.baseline import Baseline, SearchSetup
from cell.lab.search.extension import Extension, Refits, continued
from cell.lab.search.fitted_model import (
    POLISH,
    REFIT,
    FittedModel,
    Gain,
    added_effect,
    error_over_noise,
    model_of_fit,
    p_value_of_fall,
    penalty_of,
    worth_of,
)
from cell.lab.search.residual_summary import removed_share, residual_summary
from cell.lab.search.screen import ScreenedEffect, screen
from cell.lab.search.stepwise import levels

#: Two fits of the same effects are different minima if one is so much likelier (logarithm).
LIKELIER = 0.1
#: p-value of the screen above which a smooth effect is not refitted given a model that explains
#: the study. Measured on 61 studies: of 326 such refits none had p below 0.02.
BY_CHANCE = 0.1


@dataclass(eq=False)
class _Memory:
    """What has been fitted beyond the baseline."""

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
    tempered  the baseline's fit with residuals divided, where the baseline cannot fit
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
        baseline = Baseline(setup, by_adding).fitted()
        prepared = baseline.prepared
        base = model_of_fit(prepared, setup.space.effects, baseline.fit)
        models = {base.names: base}
        if setup.reference is not None:
            with contextlib.suppress(*UNSIMULATED):
                again = continued(prepared, setup.reference, POLISH)
                models[again.names] = again
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
        """Told what is fitted."""
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
        """The same fits, judged by other limits."""
        return replace(self, setup=replace(self.setup, rules=rules))

    @property
    def tried(self) -> int:
        """Number of effects that may be added to the baseline."""
        return sum(name not in self.base.names for name in self.library)

    @property
    def work(self) -> Work:
        """What is simulated of the study; whoever waits may stop it."""
        return self.setup.prepared.work

    def explained_by(self, model: FittedModel) -> bool:
        """Whether a model leaves so little that the rest may be noise and the mesh's error."""
        return model.fit.rms_m <= ERRS * self.prepared.expected_m("fit")

    def is_below_stated(self, model: FittedModel) -> bool:
        """Whether a model's error is less than a share of the error that the study states."""
        error = error_over_noise(self.prepared, model)
        return self.prepared.noise_model.stated and error < self.rules.below_stated

    @property
    def second(self) -> Fit | None:
        """Where the baseline's fit ended from a second start, if one was tried."""
        return self._memory.second

    def second_start(self) -> Fit | None:
        """Where the baseline's fit ends from a second start; None where the first is good enough.

        The second is the tempered fit; of two that were compared it is the worse.
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
        """What `large` has over `small`, which lacks one of its effects."""
        effect, (worth, held) = added_effect(small, large), self.worth(small, large)
        return Gain(
            delta_chi2=small.fit.objective - large.fit.objective,
            p_value=p_value_of_fall(effect, worth),
            delta_bic=worth - penalty_of(self.prepared, [effect]),
            heldout=held,
        )

    def worth(self, small: FittedModel, large: FittedModel) -> tuple[float, float]:
        """Fall of the objective and held-out ln likelihood ratio, as `worth_of`."""
        return worth_of(self.prepared, small, large, self.gripper_log_error())

    def removed_share(self, before: FittedModel, after: FittedModel) -> float:
        """Share, 0 … 1, of a model's error beyond noise that another removes, over all trials."""
        left = (residual_summary(self.prepared, model) for model in (before, after))
        return removed_share(self.prepared.noise_model.noise.std_m, *left)

    def gripper_log_error(self) -> GripperLogError:
        """What the gripper log may be wrong by, near the baseline."""
        return gripper_log_error(self.prepared, self.base.fit)

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

        Given a model that explains the study a refit gains no more than its screen says.
        """
        ranked = sorted(self.screened(base), key=lambda s: (s.score.p_value, -s.score.statistic))
        explained = self.prepared.noise_is_measured and self.explained_by(base)
        most = BY_CHANCE if explained else 1.0
        likely = [s.effect for s in ranked if s.score.p_value <= most][:best]
        reference = self.setup.reference
        known = () if reference is None else reference.names
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
        unknown = [e for e in effects if frozenset({*base.names, e.name}) not in self.setup.earlier]
        screens: dict[str, list[ScreenedEffect]] = {}
        for one in (*self.screened(base), *_screened_from_other_fits(self, base, unknown)):
            screens.setdefault(one.effect.name, []).append(one)
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
        """ln of how much likelier an effect of a model must make the held-out trials."""
        known, key = self._memory.heldout_log_lr, (model.names, effect.name)
        if key not in known:
            known[key] = heldout_log_lr(self.prepared, model.fit, effect)
        return known[key]

    def extended(self, model: FittedModel) -> list[FittedModel]:
        """The model with one effect more: the likeliest of the screen."""
        return self.fit_extended(model, self.shortlist(model, self.rules.max_refits))

    def with_effects(self, names: Sequence[str]) -> FittedModel | None:
        """The baseline with these effects; None if that cannot be simulated."""
        model = self.base
        for name in names:
            if name not in self.base.names:
                found = self.fit_extended(model, [self.library[name]])
                if not found:
                    return None
                model = found[0]
        return model

    def reduced(self, model: FittedModel) -> Iterator[FittedModel]:
        """Without one of the effects that the baseline lacks, refitted one after another."""
        return (self.fit_reduced(model, e) for e in self.added(model))

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
            found = model_of_fit(self.prepared, rest, self._taken_out(model, rest))
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


def noise_reestimated(fits: FitCache, model: FittedModel) -> SearchSetup | None:
    """The setup of a repeated search: noise and mesh error re-estimated given a model.

    Those given the baseline, which could not fit, were others.  So were the lines of markers of
    uncertain arc length, the wrench of an uncertain gain, and the mean errors of rounded values.
    returns  None if that was done, if nothing changes noticeably, or if the model does not explain
             the study
    """
    before = fits.prepared
    if fits.setup.reference is not None or not (fits.explained_by(model) or before.mesh_m):
        return None
    others = [e for name, e in fits.library.items() if name not in model.names]
    prepared = with_noise_given(before, model.fit, others)
    refined = corrected(prepared, model.fit)
    another = prepared.noise_model.differs_from(before.noise_model)
    of_model = arcs_are_uncertain(prepared.study) or gain_is_uncertain(prepared)
    if not (another or of_model or moves_parameters(prepared, moved_m(prepared, refined))):
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

    It is the baseline then, and nothing is fitted beyond it yet; else this cache itself.
    """
    base, memory = fits.base, fits._memory
    with contextlib.suppress(*UNSIMULATED):  # where it ended nothing is simulated
        fit = fit_model(fits.prepared, base.fit.space, start, options=POLISH)
        if fit.objective < base.fit.objective - least:
            lower = model_of_fit(fits.prepared, base.effects, fit)
            others = _Memory({lower.names: lower}, memory.second, memory.prior)
            return replace(fits, base=lower, _memory=others)
    return fits


def with_joined(
    fits: FitCache, model: FittedModel, effect: type[Effect], names: Mapping[str, str]
) -> tuple[FitCache, FittedModel]:
    """The model with its added effects replaced by one equivalent effect, and a cache for it.

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
    joined = model_of_fit(fits.prepared, effects, fit)
    memory = _Memory({m.names: m for m in (fits.base, joined)})
    setup = replace(fits.setup, library={effect.name: effect})
    return replace(fits, setup=setup, _memory=memory), joined


def _screened_from_other_fits(
    fits: FitCache, base: FittedModel, effects: Sequence[type[Effect]]
) -> list[ScreenedEffect]:
    """The same from the tempered baseline and from what was believed of the cable.

    Where the best baseline has been bent to imitate an effect, its slopes mislead.
    """
    if base is not fits.base or not effects:
        return []
    found = [] if fits.tempered is None else screen(fits.prepared, fits.tempered, effects)
    if fits.prior_q is not None:
        found += screen(fits.prepared, fits.prior_candidate().fit, effects)
    return found


def _extension(fits: FitCache, base: FittedModel) -> Extension:
    """Where fits with one effect more begin."""
    origins = [base.fit.q]
    if fits.tempered is not None and base is fits.base:
        origins.append(fits.tempered.q)
    if fits.prior_q is not None:
        # An earlier individual is far from one with, say, a load: there slopes say little.
        origins.append(np.concatenate([fits.prior_q, base.fit.q[len(fits.prior_q) :]]))
    # Weighed by a model's own error, as a partial explanation is, no cable is bent to imitate.
    measured = base is fits.base and fits.prepared.noise_is_measured
    misfit = measured and not fits.explained_by(base)
    far = fits.prior_q is not None
    return Extension(fits.prepared, base, tuple(origins), far, misfit)


def _fit_by_adding(setup: SearchSetup, prepared: PreparedStudy) -> Fit | None:
    """The baseline's fit from the end of a search that adds the unknown effects one by one.

    None if the cable cannot be simulated so.
    """
    unknown = setup.unknown_effects
    rest = [e for e in setup.space.effects if e not in unknown]
    space = space_with(setup.space, rest)
    known = [i for i, name in enumerate(setup.space.names) if name in space.names]
    prior_q = None if setup.prior_q is None else setup.prior_q[known]
    library = {e.name: e for e in unknown}
    with contextlib.suppress(*UNSIMULATED):
        search = FitCache.of(SearchSetup(prepared, space, library, setup.progress, prior_q))

        def extended(model: FittedModel) -> list[FittedModel]:
            others = [e for e in unknown if e not in model.effects]
            return search.fit_extended(model, others) if others else []

        def likeliest(_: FittedModel, options: Sequence[FittedModel]) -> list[FittedModel]:
            return sorted(options, key=lambda c: c.fit.objective)[:1]

        *_, (model,) = levels(search.base, extended, likeliest)
        if len(model.effects) < len(setup.space.effects):
            return None
        q = np.clip(taken_from(model.fit, setup.space), setup.space.low, setup.space.high)
        states = model.fit.initial_states
        return fit_model(prepared, setup.space, q, states, options=POLISH)
    return None
