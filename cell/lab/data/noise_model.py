"""The noise of the markers: which level and which correlation are used, and where that is decided.

The noise of a coordinate is Gaussian with an AR(1) correlation between neighbouring frames, and a
white share where values are rounded (`cell.identify.noise.Noise`).  `noise_model_of` estimates
level and correlation from the frames at rest by restricted maximum likelihood, with a confidence
set of both (`noise_likelihood`).  Given a fitted model, `noise_model_of_all_frames` chooses within
that set by rest and motion together; `cell.lab.fit.remainder` first takes out of the motion what
parameters and effects could explain.  Where a study states its level, that is kept, and
`noise_model_of_residuals` bounds the correlation by that of the residuals.  Markers and trials have
levels of their own where the frames at rest show it (`noise_levels`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.identify.innovations import frames_since
from cell.identify.noise import Noise, still_frames
from cell.lab.data.noise_likelihood import (
    ALLOWED,
    AR1_GRID,
    CHI2_95,
    DEGREE,
    DRIFT_DEGREE,
    MAX_AR1,
    NoiseBlock,
    Remainder,
    RestFrames,
    alike,
    dof_of,
    resolution_m,
)
from cell.study.data import Study, Trial

#: Fewer still frames than this say nothing about noise.
MIN_STILL_FRAMES = 6
#: A level is known if the rest would not allow an error as large as the noise in addition.
KNOWN_WITHIN = 2.0


class NoiseUnknownError(ValueError):
    """The study neither states its noise nor has frames in which nothing moves."""


@dataclass(frozen=True, eq=False)
class Level:
    """Noise of a trial's markers over that of the study.

    of_markers  (markers,)
    dof         degrees of freedom behind their mean square: of the trial's still frames, if it has
                any
    """

    of_markers: FloatArray
    dof: float


@dataclass(frozen=True)
class NoiseModel:
    """The noise of the markers, and the uncertainty of its level.

    dof       degrees of freedom behind the level; `inf` if the study states it
    autocorrelated  whether still frames have shown its AR(1) correlation
    correlated_channels  channels with one error, as of markers on a fitted shape: so many values
              tell as much as one
    rest      what still frames tell of level and correlation; None where the level is stated
    range_m   95 % interval of the level by the rest alone, m; None where that is not asked
    hidden    values are rounded so much that still frames do not show their error
    slow      degrees of freedom behind the level of its slow part; None: as of a known
              correlation
    levels    noise of each trial's markers over `noise`, where still frames show that they differ
    """

    noise: Noise
    dof: float
    autocorrelated: bool = True
    correlated_channels: float = 1.0
    rest: RestFrames | None = field(default=None, compare=False, repr=False)
    range_m: tuple[float, float] | None = None
    slow: float | None = None
    hidden: bool = False
    levels: Mapping[str, Level] = field(default_factory=dict, compare=False, repr=False)

    @property
    def stated(self) -> bool:
        """Whether the study states the level."""
        return bool(np.isinf(self.dof))

    @property
    def allowed_over_level(self) -> float | None:
        """Largest mean square that the rest allows, over the likeliest; None if it is stated."""
        return None if self.range_m is None else (self.range_m[1] / self.noise.std_m) ** 2

    @property
    def frames_needed(self) -> int:
        """Still frames of a trial after which the level would be known, as many trials as here."""
        allowed = self.allowed_over_level
        if self.rest is None or allowed is None:
            return 0
        known, wanted = (np.log(r) + 1.0 / r - 1.0 for r in (allowed, KNOWN_WITHIN))
        return int(10 * np.ceil(0.1 * self.rest.frames * max(known / wanted, 1.0)))

    def differs_from(self, other: NoiseModel) -> bool:
        """Whether this noise makes another's level unlikely (95 %), by a likelihood ratio."""
        ratio = (other.noise.std_m / self.noise.std_m) ** 2
        return not self.stated and bool(self.dof * (ratio - 1.0 - np.log(ratio)) > CHI2_95)

    @property
    def for_whitening(self) -> Noise:
        """Noise of independent markers that tell as much."""
        if self.correlated_channels == 1.0:
            return self.noise
        return replace(
            self.noise, std_m=self.noise.std_m * float(np.sqrt(self.correlated_channels))
        )

    @property
    def effective_fraction(self) -> float:
        """Independent values per value, when averaging."""
        return self.noise.effective_fraction

    @property
    def slow_dof(self) -> float:
        """Degrees of freedom behind the level of its slow part, which the correlation decides.

        That level is the innovations' variance over (1 − ρ)²; the variance of ρ is (1 − ρ²) / n.
        """
        return self.slow or self.dof / self._slower

    def dof_in(self, trials: Sequence[Trial], *, slow: bool = False) -> float:
        """Degrees of freedom behind the level in trials: theirs alone, where levels differ.

        slow  of its slow part
        """
        if not self.levels:
            return self.slow_dof if slow else self.dof
        dof = sum(self.levels[t.name].dof for t in trials)
        return dof / self._slower if slow else dof

    @property
    def _slower(self) -> float:
        return 1.0 + 2.0 / self.effective_fraction


def noise_model_of_residuals(noise_model: NoiseModel, errors: Sequence[FloatArray]) -> NoiseModel:
    """A stated noise with the correlations that a fitted model's residuals have.

    A study that states its error has it from elsewhere: from shapes fitted to pictures, say, which
    err along the whole cable at once and for several frames, and its few still frames say little of
    that.  What the model misses is slow and along the whole cable too, so that the residual is no
    less correlated than the error: its AR(1) correlation bounds the error's.

    errors  per trial (times, channels), m, nan where not seen
    source  (tr K)² / tr K² of the channels' correlations K, less what chance makes of it
    """
    filled = [np.where(np.isfinite(e), e, 0.0) for e in errors]
    power = sum(float(np.sum(e * e)) for e in filled)
    if not noise_model.stated or power == 0.0:
        return noise_model
    pairs = [np.isfinite(e[1:]) & np.isfinite(e[:-1]) for e in errors]
    products = sum(float(np.sum((e[1:] * e[:-1])[p])) for e, p in zip(filled, pairs, strict=True))
    count, neighbours = (sum(int(x.sum()) for x in y) for y in (map(np.isfinite, errors), pairs))
    ar1 = float(np.clip(products / max(neighbours, 1) * count / power, 0.0, MAX_AR1))
    if noise_model.autocorrelated:
        ar1 = min(ar1, noise_model.noise.ar1)
    channels = np.sum([e.T @ e for e in filled], axis=0)
    there = int(np.count_nonzero(np.diag(channels)))
    frames = count / there * (1.0 - ar1**2) / (1.0 + ar1**2)
    alike = float(np.sum(channels**2)) / power**2 - 1.0 / frames
    correlated = float(np.clip(there * alike, 1.0, there))
    return replace(
        noise_model, noise=replace(noise_model.noise, ar1=ar1), correlated_channels=correlated
    )


def noise_model_of(study: Study) -> NoiseModel:
    """Noise of a study, from the frames before anything moves, all markers together.

    Restricted maximum likelihood of level and AR(1) correlation; each coordinate of each trial has
    its own mean, and its own slope or parabola where the cable is still settling (chosen by BIC).
    A level stated in the study is kept and only its correlation estimated.

    raises  NoiseUnknownError: no still frames and no stated level
    """
    markers = slice(0, len(study.arc_length_m))
    blocks = [block for trial in study.trials for block in still_blocks(trial, markers)]
    series = [
        values
        for trial in study.trials
        for values in trial.markers.xy_m[:, markers].reshape(len(trial.markers.t_s), -1).T
    ]
    most = DRIFT_DEGREE if any(t.drifts for t in study.trials) else DEGREE
    found = noise_model_of_blocks(blocks, series, study.noise_std_m, most)
    if found is None:
        raise NoiseUnknownError(
            f"study {study.name}: no trial has {MIN_STILL_FRAMES} frames before the gripper "
            "moves, so the camera's noise is unknown; give noise_std_m in study.yaml, "
            f"or record at least {MIN_STILL_FRAMES} frames at rest first"
        )
    return found


def noise_model_of_blocks(
    blocks: Sequence[NoiseBlock],
    series: Sequence[FloatArray],
    stated: float | None,
    most: int = DEGREE,
) -> NoiseModel | None:
    """Noise from what is still of series, and their rounding; None if nothing is, and none stated.

    Its level is as stated, if it is.
    most  degree of the polynomials that are taken out
    """
    if not blocks:
        return None if stated is None else NoiseModel(Noise(stated), np.inf, autocorrelated=False)
    rest = RestFrames.of(blocks, resolution_m(series), most)
    found, dof = rest.likeliest()
    if stated is None:
        return NoiseModel(found, dof, rest=rest)
    return NoiseModel(Noise(stated, found.ar1), np.inf)


def still_blocks(trial: Trial, markers: slice) -> list[NoiseBlock]:
    """Of every coordinate the longest run of frames in which it is seen, equal runs together.

    So that a lost frame costs what came before or after it, and not the marker.
    """
    still = still_frames(trial.markers.t_s, trial.grip, trial.rests_until_s)
    series_m = trial.markers.xy_m[still, markers]
    series_m = series_m.reshape(len(series_m), 2 * series_m.shape[1])
    seen: NDArray[np.bool_] = np.isfinite(series_m)
    since = frames_since(seen)
    runs: dict[bytes, tuple[NDArray[np.intp], list[int]]] = {}
    for series in range(series_m.shape[1]):
        rows = _longest_run(seen[:, series], since[:, series])
        if len(rows) >= MIN_STILL_FRAMES:
            runs.setdefault(rows.tobytes(), (rows, []))[1].append(series)
    return [
        NoiseBlock(series_m[np.ix_(rows, np.array(alike))], tuple(alike))
        for rows, alike in runs.values()
    ]


def _longest_run(seen: NDArray[np.bool_], since: NDArray[np.int_]) -> NDArray[np.intp]:
    """Rows of the longest run of own frames in which a series is seen."""
    rows = np.flatnonzero(seen)
    runs = np.split(rows, np.flatnonzero(since[rows[1:]] > 1) + 1)
    return max(runs, key=len)


def noise_model_of_all_frames(noise_model: NoiseModel, remainder: Remainder) -> NoiseModel:
    """The noise of highest likelihood over rest and remainder, within what the rest allows.

    Few still frames leave level and correlation uncertain, and a noise that is wrongly taken for
    known makes misfits of it.  In motion there are more values, but a misfit may be in them: so
    they choose within what the rest allows, and what goes beyond that is no noise.
    source  Berger and Boos 1994, J. Am. Stat. Assoc. 89, 1012: nuisances within a confidence set
    """
    if noise_model.rest is None:
        return noise_model
    noises = noise_model.rest.noises
    rest = noise_model.rest.allowed
    least, largest = rest.within(ALLOWED)
    moving_m2, log_det = remainder.sums(noises, least <= largest)
    square, dof = rest.square_m2 + moving_m2, rest.weight + remainder.dof
    wanted = square / max(dof, 1.0)
    level = np.clip(wanted, least, np.maximum(largest, least))
    cost = dof * np.log(level) + square / level + rest.fixed + log_det
    cost = np.where(least <= largest, cost, np.inf)
    best = int(np.argmin(cost))
    ar1, white = noises[best]
    noise = Noise(float(np.sqrt(level[best])), ar1, white=white)
    if not least[best] <= wanted[best] <= largest[best]:
        dof = noise_model.dof
    slow = None
    if len(noises) > len(AR1_GRID):
        fractions = np.array([Noise(1.0, *n[:1], white=n[1]).effective_fraction for n in noises])
        slow = dof_of(np.log(level / fractions), cost, dof)
    told = replace(noise_model, range_m=rest.range_m, hidden=rest.hidden)
    if alike(noise, noise_model.noise):
        return told
    return replace(told, noise=noise, dof=dof, slow=slow)
