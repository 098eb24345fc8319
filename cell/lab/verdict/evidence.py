"""The quantities that the checks need of a model, each computed once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from cell.cable.effects.base import Effect
from cell.lab.data.noise_model import NoiseModel
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.thresholds import Rules
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel
from cell.lab.strength.estimate import ParameterEstimate, estimate
from cell.lab.verdict.own_checks import p_values
from cell.lab.verdict.smooth_part import SmoothPart, smooth_part


@dataclass(frozen=True, eq=False)
class Evidence:
    """A fitted model, the baseline, and the study they are held against.

    final  the model that may explain the study; the baseline itself if nothing was added
    tied   of each effect that was added, those that explain as much in its place
    """

    fits: FitCache
    base: FittedModel
    final: FittedModel
    rules: Rules
    tied: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def prepared(self) -> PreparedStudy:
        """The study."""
        return self.fits.prepared

    @property
    def noise_model(self) -> NoiseModel:
        """Noise of the measurement."""
        return self.prepared.noise_model

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
        """The smooth part of what the baseline leaves on the held-out trials."""
        return smooth_part(self.prepared, self.base.fit)

    @cached_property
    def over_noise(self) -> float:
        """Larger of the fitted and the held-out error, over the measurement's noise."""
        return above_noise(self.fits, self.final)

    @cached_property
    def estimate(self) -> ParameterEstimate:
        """The parameters from all trials; the covariance allows for effects that it may lack."""
        return estimate(self.prepared, self.final.fit, self.fits.library.values())

    @cached_property
    def own_p_values(self) -> dict[str, float] | None:
        """Of a user's own checks by name; None where a trial cannot be simulated."""
        limit = self.rules.residual_significance
        return p_values(self.prepared, self.final.fit, self.rules.own, limit)

    @property
    def below_stated(self) -> bool:
        """Whether the model errs by much less than the measurement is said to."""
        noise_model = self.noise_model
        return noise_model.stated and self.over_noise < self.rules.below_stated


def above_noise(fits: FitCache, candidate: FittedModel) -> float:
    """Larger of a candidate's fitted and held-out error over the measurement's noise."""
    prepared, held = fits.prepared, candidate.heldout
    over = candidate.fit.rms_m / prepared.noise_m("fit")
    return over if held is None else max(over, held.rms_m / prepared.noise_m("validate"))
