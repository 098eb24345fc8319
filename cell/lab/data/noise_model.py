"""The noise model of the markers: its level and correlation, and where they are estimated.

The error of a coordinate is Gaussian AR(1) noise, with a white share where values are rounded
(`cell.identify.noise.Noise`; likelihoods: `noise_likelihood`).  `noise_model_of` estimates level
and correlation from the frames at rest, and `with_levels` levels of single markers and trials where
they differ.  Given a fitted model, `noise_model_of_all_frames` maximises the likelihood of rest and
motion within the confidence set from rest; `with_conditional_noise` of `cell.lab.fit.corrections`
calls it, for the baseline and again for the selected model.  A stated level is not re-estimated,
and the correlation is then at most that of a model's residuals (`noise_model_of_residuals`, called
by `with_noise_from`).  The field `noise` of `PreparedStudy` is the result, with which residuals are
whitened, unless the error of an earlier cable's model is larger (`misfit` of `search.setup`).
`cell run` estimates the noise of a single cable by `cell.identify.noise`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc as chi2_sf

from cell.cable.arrays import FloatArray
from cell.identify.innovations import frames_since
from cell.identify.noise import Noise, still_frames
from cell.lab.data.noise_likelihood import (
    AR1_GRID,
    CHI2_95,
    CHI2_999,
    DEGREE,
    DRIFT_DEGREE,
    MAX_AR1,
    ProjectedResidual,
    RestFrames,
    StillBlock,
    dof_of,
    nearly_equal,
    resolution_m,
)
from cell.study.data import Study, Trial

#: Fewest still frames for an estimate of noise.
MIN_STILL_FRAMES = 6
#: A level is known if the upper bound of its mean square is below this multiple of the estimate.
KNOWN_WITHIN = 2.0
#: p-value below which levels differ.  Few still frames with outliers reach 1e-3 in 1 of 100
#: studies; markers of which some have twice the noise of others reach 1e-13.
DIFFERENT_LEVELS = 1e-4
#: If rounding exceeds this many standard deviations, markers get no level of their own: noise at
#: rest then depends on the distance to the next rounding step.
LEVELS_ROUNDED = 1.0
#: Largest factor of a level from the median: repeated values are not new measurements.
LARGEST_FACTOR = 5.0


class NoiseUnknownError(ValueError):
    """The study neither states its noise nor has frames in which nothing moves."""


@dataclass(frozen=True, eq=False)
class Level:
    """Noise levels of a trial's markers, relative to the study's level.

    of_markers  (markers,)
    dof         degrees of freedom of their mean square: of the trial's still frames, if it has any
    """

    of_markers: FloatArray
    dof: float


@dataclass(frozen=True)
class NoiseModel:
    """The noise of the markers, and the uncertainty of its level.

    dof       degrees of freedom of the level; `inf` if the study states it
    autocorrelated  whether its AR(1) correlation is estimated from still frames
    correlated_channels  number of channels with a common error, as of markers on a fitted shape:
              this many values have the information of one
    rest      likelihood of the frames at rest; None if the level is stated
    range_m   95 % interval of the level from rest alone, m; None before motion is used
    hidden    rounding hides the noise of still frames
    slow      degrees of freedom of the level of its slow part; None: as of a known correlation
    levels    by trial, if still frames show that markers or trials differ
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
        """Upper bound of the mean square from rest, over the estimate; None if stated."""
        return None if self.range_m is None else (self.range_m[1] / self.noise.std_m) ** 2

    @property
    def frames_needed(self) -> int:
        """Still frames per trial needed to know the level, for the same number of trials."""
        allowed = self.allowed_over_level
        if self.rest is None or allowed is None:
            return 0
        present, wanted = (np.log(r) + 1.0 / r - 1.0 for r in (allowed, KNOWN_WITHIN))
        return int(10 * np.ceil(0.1 * self.rest.frames * max(present / wanted, 1.0)))

    def differs_from(self, other: NoiseModel) -> bool:
        """Whether this noise makes another's level unlikely (95 %), by a likelihood ratio."""
        ratio = (other.noise.std_m / self.noise.std_m) ** 2
        return not self.stated and bool(self.dof * (ratio - 1.0 - np.log(ratio)) > CHI2_95)

    @property
    def for_whitening(self) -> Noise:
        """Equivalent noise of independent markers with the same information."""
        if self.correlated_channels == 1.0:
            return self.noise
        return replace(
            self.noise, std_m=self.noise.std_m * float(np.sqrt(self.correlated_channels))
        )

    def rms_m(self, trials: Sequence[Trial], markers: int) -> float:
        """Root mean square of the noise in trials, over their first columns: the markers; m."""
        counts = {t.name: np.isfinite(t.markers.xy_m[:, :markers]).sum(axis=(0, 2)) for t in trials}
        if not self.levels or not any(c.any() for c in counts.values()):
            return self.noise.std_m
        square = sum(float(self.levels[name].of_markers ** 2 @ c) for name, c in counts.items())
        return self.noise.std_m * float(
            np.sqrt(square / sum(int(c.sum()) for c in counts.values()))
        )

    @property
    def slow_dof(self) -> float:
        """Degrees of freedom of the level of its slow part, which depends on the correlation.

        That level is the innovations' variance over (1 − ρ)²; the variance of ρ is (1 − ρ²) / n.
        """
        return self.slow or self.dof / self.values_per_slow_dof

    def dof_in(self, trials: Sequence[Trial], *, slow: bool = False) -> float:
        """Degrees of freedom of the level, or of its slow part's, in trials: theirs alone, where
        levels differ.
        """
        if not self.levels:
            return self.slow_dof if slow else self.dof
        dof = sum(self.levels[t.name].dof for t in trials)
        return dof / self.values_per_slow_dof if slow else dof

    @property
    def values_per_slow_dof(self) -> float:
        """Values with the information on the slow part's level that one has on the total level."""
        return 1.0 + 2.0 / self.noise.effective_fraction


def noise_model_of(study: Study) -> NoiseModel:
    """Noise of a study, from the frames before anything moves, all markers together.

    Restricted maximum likelihood of level and AR(1) correlation; each coordinate of each trial has
    its own mean, and its own slope or parabola where the cable is still settling (chosen by BIC).
    A level stated in the study is used, and only its correlation estimated.

    raises  NoiseUnknownError: no still frames and no stated level
    """
    markers = slice(0, len(study.arc_length_m))
    blocks = [block for trial in study.trials for block in still_blocks(trial, markers)]
    max_degree = DRIFT_DEGREE if any(t.drifts for t in study.trials) else DEGREE
    model = noise_model_of_blocks(blocks, _series(study), study.noise_std_m, max_degree)
    if model is None:
        raise NoiseUnknownError(
            f"study {study.name}: no trial has {MIN_STILL_FRAMES} frames before the gripper "
            "moves, so the camera's noise is unknown; give noise_std_m in study.yaml, "
            f"or record at least {MIN_STILL_FRAMES} frames at rest first"
        )
    return model


def noise_model_of_blocks(
    blocks: Sequence[StillBlock],
    series: Sequence[FloatArray],
    stated: float | None,
    max_degree: int = DEGREE,
) -> NoiseModel | None:
    """Noise from still blocks of series; None if there are no blocks and no stated level.

    series      (frames,) each, to estimate the step of rounding
    stated      level, which is then not estimated
    max_degree  of the polynomials that are subtracted
    """
    if not blocks:
        return None if stated is None else NoiseModel(Noise(stated), np.inf, autocorrelated=False)
    rest = RestFrames.of(blocks, resolution_m(series), max_degree)
    noise, dof = rest.likeliest()
    if stated is None:
        return NoiseModel(noise, dof, rest=rest)
    return NoiseModel(Noise(stated, noise.ar1), np.inf)


def still_blocks(trial: Trial, markers: slice) -> list[StillBlock]:
    """Longest gap-free runs of still frames, by coordinate; equal runs share a block.

    After a missing frame, the longer part of a marker's series is used.
    """
    still = still_frames(trial.markers.t_s, trial.grip, trial.rests_until_s)
    series_m = trial.markers.xy_m[still, markers]
    series_m = series_m.reshape(len(series_m), 2 * series_m.shape[1])
    present: NDArray[np.bool_] = np.isfinite(series_m)
    since = frames_since(present)
    runs: dict[bytes, tuple[NDArray[np.intp], list[int]]] = {}
    for series in range(series_m.shape[1]):
        rows = np.flatnonzero(present[:, series])
        gaps = np.flatnonzero(since[rows[1:], series] > 1) + 1
        longest = max(np.split(rows, gaps), key=len)
        if len(longest) >= MIN_STILL_FRAMES:
            runs.setdefault(longest.tobytes(), (longest, []))[1].append(series)
    return [
        StillBlock(series_m[np.ix_(rows, np.array(series))], tuple(series))
        for rows, series in runs.values()
    ]


def _series(study: Study) -> list[FloatArray]:
    """(frames,) coordinates of all markers of all trials."""
    markers = len(study.arc_length_m)
    series = (t.markers.xy_m[:, :markers].reshape(len(t.markers.t_s), -1).T for t in study.trials)
    return [values for of_trial in series for values in of_trial]


def noise_model_of_all_frames(noise_model: NoiseModel, residual: ProjectedResidual) -> NoiseModel:
    """The noise of highest likelihood over rest and motion, within the confidence set from rest.

    Few still frames determine level and correlation badly, and a wrong noise looks like a misfit.
    Motion has more values, but may contain a misfit: so it is used only within the confidence set,
    and any excess over that is not noise.
    source  Berger and Boos 1994, J. Am. Stat. Assoc. 89, 1012: nuisances within a confidence set
    """
    if noise_model.rest is None:
        return noise_model
    noises, rest = noise_model.rest.noises, noise_model.rest.confidence_set
    least, largest = rest.within(CHI2_999)
    moving_m2, log_det = residual.sums(noises, least <= largest)
    square, dof = rest.square_m2 + moving_m2, (0.0 if rest.hidden else rest.dof) + residual.dof
    unbounded = square / max(dof, 1.0)
    level = np.clip(unbounded, least, np.maximum(largest, least))
    cost = dof * np.log(level) + square / level + rest.fixed + log_det
    cost = np.where(least <= largest, cost, np.inf)
    best = int(np.argmin(cost))
    ar1, white = noises[best]
    noise = Noise(float(np.sqrt(level[best])), ar1, white=white)
    if not least[best] <= unbounded[best] <= largest[best]:
        dof = noise_model.dof
    slow = None
    if len(noises) > len(AR1_GRID):
        fractions = np.array([Noise(1.0, a, white=w).effective_fraction for a, w in noises])
        slow = dof_of(np.log(level / fractions), cost, dof)
    model = replace(noise_model, range_m=rest.range_m, hidden=rest.hidden)
    if nearly_equal(noise, noise_model.noise):
        return model
    return replace(model, noise=noise, dof=dof, slow=slow)


def noise_model_of_residuals(noise_model: NoiseModel, errors: Sequence[FloatArray]) -> NoiseModel:
    """A stated noise with the correlations of a fitted model's residuals.

    A stated error may be correlated along the cable and over several frames, as of shapes fitted to
    images.  A misfit is correlated too, so that the residual is no less correlated than the error:
    its AR(1) correlation is an upper bound of the error's.

    errors  per trial (times, channels), m, nan if missing
    source  (tr K)² / tr K² of the channels' correlations K, less the expected chance part
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
    gram = np.sum([e.T @ e for e in filled], axis=0)
    channels = int(np.count_nonzero(np.diag(gram)))
    frames = count / channels * (1.0 - ar1**2) / (1.0 + ar1**2)
    correlation = float(np.sum(gram**2)) / power**2 - 1.0 / frames
    correlated = float(np.clip(channels * correlation, 1.0, channels))
    return replace(
        noise_model, noise=replace(noise_model.noise, ar1=ar1), correlated_channels=correlated
    )


def with_levels(study: Study, noise_model: NoiseModel) -> NoiseModel:
    """The noise of a study, with the level of each marker of each trial, if they differ.

    Unchanged if the study states the noise, or if rounding distorts the noise of still frames.
    source  Levene 1960; Brown & Forsythe 1974, J. Am. Stat. Assoc. 69, 364
    """
    rest = noise_model.rest
    if noise_model.stated or rest is None:
        return noise_model
    if rest.resolution_m > LEVELS_ROUNDED * noise_model.noise.std_m:
        return noise_model
    markers = slice(0, len(study.arc_length_m))
    blocks = [still_blocks(t, markers) for t in study.trials]
    groups = _GroupLevels.of(blocks, rest, noise_model.noise.ar1)
    if groups is None or groups.p_value >= DIFFERENT_LEVELS:
        return noise_model
    levels, variance = groups.pooled(len(study.trials), len(study.arc_length_m))
    counts = [np.isfinite(t.markers.xy_m[:, markers]).sum(axis=(0, 2)) for t in study.trials]
    levels = np.asarray(levels / np.sqrt(np.average(levels**2, weights=np.array(counts))))
    # degrees of freedom of the mean square over markers
    share = levels**2 / np.sum(levels**2, axis=1, keepdims=True)
    dof = 2.0 / np.sum(share**2 * variance, axis=1)
    scaled = [
        replace(b, z_m=b.z_m / level[np.asarray(b.series) // 2])
        for of_trial, level in zip(blocks, levels, strict=True)
        for b in of_trial
    ]
    model = noise_model_of_blocks(scaled, _series(study), None, max(DEGREE, rest.degree))
    assert model is not None  # there are blocks
    each = zip(study.trials, levels, dof, strict=True)
    return replace(model, levels={t.name: Level(level, float(n)) for t, level, n in each})


def with_level_in(
    noise_model: NoiseModel, updated: NoiseModel, trials: Sequence[Trial]
) -> NoiseModel:
    """An updated noise model whose new level applies to some trials only; the others keep theirs.

    noise_model  before the update, with levels
    """
    factor = updated.noise.std_m / noise_model.noise.std_m
    names = {t.name for t in trials}
    levels = {
        name: Level(factor * level.of_markers, level.dof) if name in names else level
        for name, level in noise_model.levels.items()
    }
    noise = replace(updated.noise, std_m=noise_model.noise.std_m)
    return replace(updated, noise=noise, levels=levels)


@dataclass(frozen=True, eq=False)
class _GroupLevels:
    """The noise of each marker of each trial (a group), from still frames; arrays by group.

    root       mean of the square roots of innovations' magnitudes, robust to outliers
    count      of values
    spread     variance of one value of mean 1
    """

    trial: NDArray[np.intp]
    marker: NDArray[np.intp]
    root: FloatArray
    count: NDArray[np.int_]
    spread: float

    @staticmethod
    def of(
        blocks: Sequence[Sequence[StillBlock]], rest: RestFrames, ar1: float
    ) -> _GroupLevels | None:
        """The levels from still blocks by trial; None if there are none."""
        roots: dict[tuple[int, int], list[FloatArray]] = {}
        for trial, of_trial in enumerate(blocks):
            for block in of_trial:
                free = 1.0 - (rest.degree + 1) / len(block.z_m)  # less the polynomials
                innovations, _ = rest.innovations(block, ar1)
                values = np.sqrt(np.abs(innovations) / np.sqrt(free))
                for series, column in zip(block.series, values.T, strict=True):
                    roots.setdefault((trial, series // 2), []).append(column)
        if not roots:
            return None
        each = [np.concatenate(values) for values in roots.values()]
        mean = np.array([float(v.mean()) for v in each])
        median = float(np.median(mean))
        if median == 0.0:
            return None
        mean = np.clip(mean, median / np.sqrt(LARGEST_FACTOR), median * np.sqrt(LARGEST_FACTOR))
        count = np.array([len(v) for v in each])
        of_one = sum(float(np.sum((v / m - 1.0) ** 2)) for v, m in zip(each, mean, strict=True))
        trials, markers = np.array(list(roots), dtype=np.intp).T
        spread = of_one / max(int(count.sum()) - len(each), 1)
        return _GroupLevels(trials, markers, mean, count, spread)

    @property
    def p_value(self) -> float:
        """p-value of the differences between the levels."""
        mean = float(np.average(self.root, weights=self.count))
        q, dof = _cochran_q(self.root / mean, self.spread / self.count)
        return float(chi2_sf(dof, q)) if dof > 0 else 1.0

    def pooled(self, trials: int, markers: int) -> tuple[FloatArray, FloatArray]:
        """(trials, markers) partially pooled levels, and variances of the logarithms of squares.

        Each marker has its own level, and its trials differ from that.  Both are shrunk towards
        their means by their uncertainty; a group without still frames has its marker's level.
        source  Morris 1983, J. Am. Stat. Assoc. 78, 47: empirical Bayes
        """
        y = np.asarray(4.0 * np.log(self.root))  # ln of the mean square, but for a constant
        v, marker = np.asarray(16.0 * self.spread / self.count), self.marker
        overall = float(np.average(y, weights=1.0 / v))
        q_by_marker = [_cochran_q(y[marker == m], v[marker == m]) for m in range(markers)]
        between = _variance_between(
            sum(q for q, _ in q_by_marker),
            sum(dof for _, dof in q_by_marker),
            sum(_information(1.0 / v[marker == m]) for m in range(markers)),
        )
        mean, spread = np.full(markers, overall), np.full(markers, np.inf)
        for m in np.unique(marker):
            weight = 1.0 / (v[marker == m] + between)
            mean[m] = float(np.average(y[marker == m], weights=weight))
            spread[m] = 1.0 / weight.sum()
        finite = np.isfinite(spread)
        q, dof = _cochran_q(mean[finite], spread[finite])
        of_markers = _variance_between(q, dof, _information(1.0 / spread[finite]))
        overall = float(np.average(mean[finite], weights=1.0 / (spread[finite] + of_markers)))
        shrink = (
            of_markers / (of_markers + spread[finite]) if of_markers > 0.0 else 0.0 * spread[finite]
        )
        mean[finite] = overall + (mean[finite] - overall) * shrink
        pooled = np.tile(mean, (trials, 1))
        variance = np.full((trials, markers), of_markers + between)
        variance[:, finite] = between + spread[finite]
        own = between / (between + v)
        pooled[self.trial, marker] += (y - mean[marker]) * own
        variance[self.trial, marker] = v * own + (1.0 - own) ** 2 * spread[marker]
        # corrects the bias of a division by an uncertain mean square
        return np.exp(0.5 * pooled + 0.25 * variance), variance


def _cochran_q(y: FloatArray, variance: FloatArray) -> tuple[float, int]:
    """Cochran's Q of values, and its degrees of freedom."""
    if len(y) < 2:
        return 0.0, 0
    mean = float(np.average(y, weights=1.0 / variance))
    return float(np.sum((y - mean) ** 2 / variance)), len(y) - 1


def _information(weight: FloatArray) -> float:
    return float(weight.sum() - (weight @ weight) / weight.sum()) if len(weight) > 1 else 0.0


def _variance_between(q: float, dof: float, information: float) -> float:
    """Variance between values beyond their uncertainty (DerSimonian & Laird 1986)."""
    return max(q - dof, 0.0) / information if information > 0.0 else 0.0
