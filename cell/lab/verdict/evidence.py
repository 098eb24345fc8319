"""Evidence of the checks: the test quantities of a model, each computed once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.lab.data.check import OwnCheck, Residual
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.rules import Rules
from cell.lab.fit.fitting import Fit, fit_trials
from cell.lab.fit.score_test import holm
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel, error_over_noise
from cell.lab.strength.estimate import ParameterEstimate, estimate
from cell.lab.verdict.smooth_part import (
    AllTrialsResidual,
    SmoothPart,
    all_trials_residual,
    smooth_part,
)
from cell.study.independence import Independence

#: Drawing ends when this many draws exceed the measured value: p is then known to a third …
EXCEEDING = 10
#: … or when the smallest p that the draws can give is this share of the limit.
FINEST = 0.5


def p_values(
    prepared: PreparedStudy, fit: Fit, checks: Sequence[OwnCheck], limit: float
) -> dict[str, float] | None:
    """Holm-corrected p-values of users' checks by name; None if a trial cannot be simulated.

    A draw is white noise plus errors of mesh and gripper log, projected off the parameters.

    limit   p-value below which a check fails
    raises  InputError: a statistic fails
    source  posterior predictive checks: Gelman, Meng & Stern 1996, Statistica Sinica 6, 733; the
            number of draws: Besag & Clifford 1991, Biometrika 78, 301
    """
    residual = all_trials_residual(prepared, fit)
    if residual is None:
        return None
    max_draws = round(len(checks) / (FINEST * limit))
    p_each = [_p_value(residual, check, max_draws) for check in checks]
    return dict(zip((c.name for c in checks), holm(p_each), strict=True))


def _p_value(residual: AllTrialsResidual, check: OwnCheck, max_draws: int) -> float:
    measured = check.of(_residuals(residual, residual.components[0]))
    exceeding = 0
    for number, drawn in enumerate(_draws(residual, max_draws), 1):
        exceeding += check.of(_residuals(residual, drawn)) >= measured
        if exceeding == EXCEEDING:
            return exceeding / number
    return (exceeding + 1.0) / (max_draws + 1.0)


def _draws(residual: AllTrialsResidual, count: int) -> Iterator[FloatArray]:
    """Yield (rows,) residuals of a complete model, with a fixed random seed."""
    rng = np.random.default_rng(20261125)
    linear, errors = residual.all_trials.linear, residual.components[1 : 1 + residual.errors]
    valid = np.concatenate([w.observed.transpose(1, 2, 0).ravel() for w in residual.whiteners])
    valid = np.append(valid, np.zeros(residual.components.shape[1] - len(valid), dtype=bool))
    for _ in range(count):
        noise = np.where(valid, rng.standard_normal(len(valid)), 0.0)
        yield linear.remove(noise[None])[0] + rng.standard_normal(residual.errors) @ errors


def _residuals(residual: AllTrialsResidual, rows: FloatArray) -> list[Residual]:
    """Rows as the residuals that a check receives, by trial; scaled to rms 1."""
    prepared = residual.all_trials.prepared
    parts = residual.all_trials.systematic_error.by_trial(rows)
    valid = [np.moveaxis(w.observed, 0, -1) for w in residual.whiteners]
    white = [
        np.where(s, part.reshape(s.shape), np.nan) for part, s in zip(parts, valid, strict=True)
    ]
    size = float(np.sqrt(np.nanmean(np.concatenate([w.ravel() for w in white]) ** 2)))
    arcs = prepared.study.arc_length_m
    unjoined = {t.name: t for t in prepared.unjoined.trials}
    trials = zip(fit_trials(prepared), white, strict=True)
    return [
        Residual(unjoined[t.name], arcs, prepared.of_markers(t, np.moveaxis(w, -1, 0)) / size)
        for t, w in trials
    ]


@dataclass(frozen=True, eq=False)
class Evidence:
    """A fitted model and the study that it is tested against.

    final  the model that may explain the study; the baseline itself if nothing was added
    tied   for each added effect, those that explain as much in its place
    """

    fits: FitCache
    final: FittedModel
    tied: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def rules(self) -> Rules:
        """Limits of the checks."""
        return self.fits.rules

    @property
    def prepared(self) -> PreparedStudy:
        """The study."""
        return self.fits.prepared

    @property
    def base(self) -> FittedModel:
        """The model without added effects."""
        return self.fits.base

    @property
    def is_base(self) -> bool:
        """Whether no effect was added."""
        return self.final is self.base

    @property
    def added(self) -> list[type[Effect]]:
        """Effects of the model that the baseline lacks."""
        return self.fits.added(self.final)

    @cached_property
    def smooth_before(self) -> SmoothPart | None:
        """The smooth part of the baseline's residual on the held-out trials."""
        return smooth_part(self.prepared, self.base.fit)

    @cached_property
    def over_noise(self) -> float:
        """Larger of the fitted and the held-out error, over the measurement's noise."""
        return error_over_noise(self.prepared, self.final)

    @cached_property
    def estimate(self) -> ParameterEstimate:
        """The parameters from all trials; the covariance allows for omitted effects."""
        return estimate(self.prepared, self.final.fit, self.fits.library.values())

    @cached_property
    def own_p_values(self) -> dict[str, float] | None:
        """p-values of a user's own checks by name; None if a trial cannot be simulated."""
        limit = self.rules.residual_significance
        return p_values(self.prepared, self.final.fit, self.rules.own, limit)

    @cached_property
    def independence(self) -> Independence:
        """The independent recordings and motions of the study."""
        return Independence.of(self.prepared.study)
