"""Restricted likelihoods of AR(1) noise: of frames at rest, and of residuals in motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import solve_triangular
from scipy.special import lambertw

from cell.cable.arrays import FloatArray
from cell.identify.golden_section import where_least
from cell.identify.innovations import frames_since, made_white
from cell.identify.noise import Noise

#: Largest credible correlation of neighbouring frames.
MAX_AR1 = 0.98
#: A change of level or of 1 − ρ below this share changes no result.
NEGLIGIBLE_CHANGE = 0.005
#: A noise is in the confidence set if its likelihood ratio (−2 ln, to the likeliest) is below this:
#: a 99.9 % set of level, correlation and white share (χ² of 3 degrees of freedom; Wilks 1938).
CHI2_999 = 16.3
#: The same of the level that is printed: a 95 % interval (χ² of 1 degree of freedom).
CHI2_95 = 3.84
#: Grid of AR(1) correlations, evenly spaced in the logarithm of 1 − ρ, on which slow noise depends;
#: and of white shares, for rounded values.
AR1_GRID = 1.0 - (1.0 - MAX_AR1) ** np.linspace(0.0, 1.0, 121)
WHITE_SHARES = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
#: Highest degree of the subtracted polynomials, of a cable that settles, and of one that drifts.
DEGREE, DRIFT_DEGREE = 2, 5
#: Rounding to less than this share of the noise adds no detectable white noise.
DETECTABLE_ROUNDING = 0.25
#: Rounding to more than this many standard deviations hides the noise of still frames.
HIDING_ROUNDING = 2.0
#: Number of correlations at which the projection is computed; between them a cubic spline, with an
#: error of 0.03 in −2 ln of the likelihood where the projected directions span all.
NODES = 13


@dataclass(frozen=True)
class StillBlock:
    """Coordinates of one trial at rest: (frames, series), none missing.

    series  indices of the trial's coordinates: 2 · marker + axis
    """

    z_m: FloatArray
    series: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class RestFrames:
    """The likelihood of level and AR(1) correlation, given frames at rest.

    degree        of the polynomials that are subtracted from every series
    resolution_m  step to which values are rounded; 0 = none detected
    """

    blocks: tuple[StillBlock, ...]
    degree: int
    resolution_m: float

    @staticmethod
    def of(
        blocks: Sequence[StillBlock], resolution_m: float, max_degree: int = DEGREE
    ) -> RestFrames:
        """The likelihood with polynomials of the degree selected by BIC."""
        rests = [
            RestFrames(tuple(blocks), degree, resolution_m) for degree in range(max_degree + 1)
        ]
        return min(rests, key=lambda r: r.bic)

    @cached_property
    def bic(self) -> float:
        """BIC of its polynomials with the likeliest correlation."""
        square, _, _ = self.sums(self.ar1)
        log_det = sum(b.z_m.shape[1] * _whitened(b.z_m, self.ar1)[1] for b in self.blocks)
        count = sum(b.z_m.size for b in self.blocks)
        parameters = (self.degree + 1) * sum(b.z_m.shape[1] for b in self.blocks)
        likelihood = count * float(np.log(max(square, 1e-300) / count)) + log_det
        return float(likelihood + parameters * np.log(count))

    @cached_property
    def ar1(self) -> float:
        """The likeliest correlation."""

        def restricted(ar1: float) -> float:
            square, dof, log_det = self.sums(ar1)
            return dof * float(np.log(max(square, 1e-300))) + log_det

        inner = where_least(restricted, 0.0, MAX_AR1, within=1e-5)
        return min((0.0, inner, MAX_AR1), key=restricted)

    @property
    def frames(self) -> int:
        """Number of frames of the longest series."""
        return max(len(b.z_m) for b in self.blocks)

    def likeliest(self) -> tuple[Noise, float]:
        """Level and correlation from rest alone, and the degrees of freedom of the level."""
        square, dof, _ = self.sums(self.ar1)
        std_m = max(float(np.sqrt(square / dof)), 1e-12)
        if self.is_hidden(std_m):
            return Noise(self.resolution_m / np.sqrt(12.0)), float(dof)
        return Noise(std_m, self.ar1), float(dof)

    def is_hidden(self, std_m: float) -> bool:
        """Whether rounding hides the noise of a cable at rest."""
        return self.resolution_m > HIDING_ROUNDING * std_m

    @cached_property
    def noises(self) -> list[tuple[float, float]]:
        """Grid of AR(1) correlations and white shares."""
        square, dof, _ = self.sums(0.0)
        rounded = self.resolution_m > DETECTABLE_ROUNDING * float(np.sqrt(square / dof))
        whites = WHITE_SHARES if rounded else WHITE_SHARES[:1]
        return [(float(ar1), white) for white in whites for ar1 in AR1_GRID]

    @cached_property
    def confidence_set(self) -> ConfidenceSet:
        """The levels in the confidence set, for each of `noises`."""
        sums = np.array([self.sums(ar1, white) for ar1, white in self.noises])
        square, dof, fixed = sums.T
        level = np.maximum(square / dof, 1e-24)
        profile = dof * np.log(level) + fixed
        # the likeliest level, not the smallest: within a short rest slow noise varies little
        if self.is_hidden(float(np.sqrt(level[np.argmin(profile)]))):
            one_step_m2 = 0.25 * self.resolution_m**2 / dof  # a value that changed a step once
            zero = np.zeros(len(level))
            likeliest = np.full(len(level), level.min()) + one_step_m2
            return ConfidenceSet(
                likeliest, zero, zero, zero, float(dof[0]), self.resolution_m, hidden=True
            )
        ratio = profile - profile.min()
        return ConfidenceSet(level, ratio, square, fixed, float(dof[0]), self.resolution_m)

    def sums(self, ar1: float, white: float = 0.0) -> tuple[float, int, float]:
        """Innovations' square, its degrees of freedom, and log determinants, for a noise.

        The white share in motion is mostly rounding, which is not white at rest.
        """
        square, dof, log_det = self._sums(ar1, white, 0.0)
        if white == 0.0:
            return square, dof, log_det
        return self._sums(ar1, white, rounding_ar1(square / dof, ar1, white, self.resolution_m))

    def _sums(self, ar1: float, white: float, white_ar1: float) -> tuple[float, int, float]:
        square, dof, log_det = 0.0, 0, 0.0
        for block in self.blocks:
            frames, series = block.z_m.shape
            innovations, of_block = self.innovations(block, ar1, white, white_ar1)
            square += float(np.sum(innovations**2))
            dof += (frames - self.degree - 1) * series
            log_det += of_block
        return square, dof, log_det

    def innovations(
        self, block: StillBlock, ar1: float, white: float = 0.0, white_ar1: float = 0.0
    ) -> tuple[FloatArray, float]:
        """(frames, series) innovations of a block less its polynomials; their log determinant.

        white_ar1  AR(1) correlation of the white share
        """
        series = block.z_m.shape[1]
        u = np.linspace(-1.0, 1.0, len(block.z_m))
        columns = np.concatenate([np.vander(u, self.degree + 1), block.z_m], axis=1)
        columns, log_det = _whitened(columns, ar1, white, white_ar1)
        powers, z = np.split(columns, [self.degree + 1], axis=1)
        q, r = np.linalg.qr(powers)
        of_powers = 2.0 * series * float(np.log(np.abs(np.diag(r))).sum())
        return np.asarray(z - q @ (q.T @ z)), series * log_det + of_powers


@dataclass(frozen=True, eq=False)
class ConfidenceSet:
    """Confidence set of noise levels from rest, on a grid of correlations and white shares.

    level_m2   likeliest variance
    ratio      its −2 ln likelihood less that of the best
    square_m2, fixed   −2 ln of the likelihood of a variance v is dof · ln v + square / v + fixed
    hidden     rounding hides the error from a cable at rest: the frames only bound it
    """

    level_m2: FloatArray
    ratio: FloatArray
    square_m2: FloatArray
    fixed: FloatArray
    dof: float
    resolution_m: float
    hidden: bool = False

    def within(self, limit: float) -> tuple[FloatArray, FloatArray]:
        """Least and largest variance with a likelihood ratio below a limit, m².

        The least is infinite for a correlation and share outside the set.  Its lower bound is the
        variance of rounding, which may also add to the noise at rest.
        source  Wilks 1938; u − ln u = 1 + k is solved by Lambert's W
        """
        of_rounding = self.resolution_m**2 / 12.0
        slack = (limit - self.ratio) / self.dof
        inside = -np.exp(-1.0 - np.maximum(slack, 0.0))
        least, largest = (self.level_m2 / -lambertw(inside, k).real for k in (-1, 0))
        least = np.maximum(0.0 if self.hidden else least, of_rounding)
        return np.where(slack < 0.0, np.inf, least), largest + of_rounding

    @property
    def range_m(self) -> tuple[float, float]:
        """95 % interval of the level over all correlations and shares."""
        least, largest = self.within(CHI2_95)
        inside = least <= largest
        return float(np.sqrt(least[inside].min())), float(np.sqrt(largest[inside].max()))


@dataclass(frozen=True, eq=False)
class ProjectedResidual:
    """A residual in motion, orthogonal to the directions of parameters and effects.

    errors_m  per trial (times, channels), nan if missing or at rest
    basis     per trial (times, channels, directions), orthonormal over all trials
    """

    errors_m: tuple[FloatArray, ...]
    basis: tuple[FloatArray, ...]

    @property
    def dof(self) -> int:
        """Number of values less that of directions."""
        count = sum(int(np.isfinite(e).sum()) for e in self.errors_m)
        return max(count - int(self.basis[0].shape[-1]), 0)

    @cached_property
    def _trials(self) -> list[tuple[FloatArray, NDArray[np.bool_], NDArray[np.int_]]]:
        """Per trial: errors (times, channels, 1), 0 if missing; their mask; frames since."""
        present = [np.isfinite(e) for e in self.errors_m]
        return [
            (np.where(p, e, 0.0)[..., None], p, frames_since(p))
            for e, p in zip(self.errors_m, present, strict=True)
        ]

    def sums(
        self, noises: Sequence[tuple[float, float]], wanted: NDArray[np.bool_]
    ) -> tuple[FloatArray, FloatArray]:
        """By correlation and white share: the innovations' square, m², and log determinant.

        nan for a noise that is not wanted.  The likelihood is restricted to the complement of the
        directions: slow noise resembles them, so that much of it was projected out.
        source  Patterson & Thompson 1971, Biometrika 58, 545
        """
        sums = np.full((len(noises), 2), np.nan)
        for i in np.flatnonzero(wanted):
            sums[i] = self._of(noises[int(i)], projected=False)
        if self.dof > 0 and self.basis[0].shape[-1] > 0:
            whites = np.array([white for _, white in noises])
            for white in np.unique(whites[wanted]):
                own = np.flatnonzero(wanted & (whites == white))
                sums[own] += self._by_projection(sums[own], [noises[i] for i in own.tolist()])
        return sums[:, 0], sums[:, 1]

    def _by_projection(self, sums: FloatArray, noises: Sequence[tuple[float, float]]) -> FloatArray:
        """Changes of sums by the projection, for noises of one white share; interpolated."""
        nodes = np.unique(np.linspace(0, len(noises) - 1, NODES).round().astype(int))
        exact = np.array([self._of(noises[i], projected=True) for i in nodes])
        if len(nodes) == len(noises):
            return np.asarray(exact - sums)
        place = -np.log1p(-np.array([ar1 for ar1, _ in noises]))
        ratio = CubicSpline(place[nodes], exact[:, 0] / np.maximum(sums[nodes, 0], 1e-300))(place)
        log_det = CubicSpline(place[nodes], exact[:, 1] - sums[nodes, 1])(place)
        return np.stack([sums[:, 0] * (ratio - 1.0), log_det], axis=1)

    def _of(self, noise: tuple[float, float], *, projected: bool) -> tuple[float, float]:
        """Square and log determinant, in total or orthogonal to the directions."""
        size = self.basis[0].shape[-1] * projected + 1
        gram, log_det = np.zeros((size, size)), 0.0
        for (values, present, since), basis in zip(self._trials, self.basis, strict=True):
            columns = np.concatenate([basis, values], axis=-1) if projected else values
            white, of_trial = made_white(columns, present, since, *noise, 0.0)
            rows = white.reshape(-1, white.shape[-1])
            gram, log_det = gram + rows.T @ rows, log_det + of_trial
        if not projected:
            return float(gram[0, 0]), log_det
        root = np.linalg.cholesky(gram[:-1, :-1])
        along = solve_triangular(root, gram[:-1, -1], lower=True)
        square = max(float(gram[-1, -1] - along @ along), 0.0)
        return square, log_det + 2.0 * float(np.log(np.diag(root)).sum())


def dof_of(log_level: FloatArray, cost: FloatArray, dof: float) -> float:
    """Degrees of freedom of a level, from its posterior variance.

    cost  −2 ln of the likelihood of each level
    """
    likely = cost < cost.min() + 2.0 * CHI2_999
    weight = np.exp(-0.5 * (cost[likely] - cost.min()))
    weight /= weight.sum()
    mean = float(weight @ log_level[likely])
    variance = float(weight @ (log_level[likely] - mean) ** 2) + 2.0 / max(dof, 1.0)
    return 2.0 / variance


def nearly_equal(first: Noise, second: Noise) -> bool:
    """Whether two noises differ only by a negligible amount."""
    level = abs(np.log(first.std_m / second.std_m))
    memory = abs(np.log((1.0 - first.ar1) / (1.0 - second.ar1)))
    return bool(max(level, memory) < NEGLIGIBLE_CHANGE)


def resolution_m(measured: Sequence[FloatArray]) -> float:
    """Step to which most series are rounded, m; 0 where values do not repeat.

    The smallest difference of two values of a series (frames,), where some are equal.
    """
    steps = []
    for series in measured:
        present = series[np.isfinite(series)]
        values = np.unique(present)
        steps.append(float(np.diff(values).min()) if 1 < len(values) < len(present) else 0.0)
    return float(np.median(steps)) if steps else 0.0


def rounding_ar1(variance_m2: float, ar1: float, white: float, step_m: float) -> float:
    """Correlation of neighbouring frames, at rest, of the white share of a noise.

    variance_m2  of the noise
    white        its share that is independent between frames, or rounding to `step_m`

    The rounding error is a sawtooth function of the value.  If the value changes by a normally
    distributed amount between frames, each harmonic's correlation is its characteristic function.
    source  Sripad & Snyder 1977, IEEE Trans. Acoust. 25, 442
    """
    of_rounding = step_m**2 / 12.0
    slow, fresh = (1.0 - white) * variance_m2, max(white * variance_m2 - of_rounding, 0.0)
    change = (2.0 * np.pi / step_m) ** 2 * (slow * (1.0 - ar1) + fresh)
    harmonics = np.arange(1.0, 31.0)
    correlation = 6.0 / np.pi**2 * float(np.sum(np.exp(-change * harmonics**2) / harmonics**2))
    return min(1.0, of_rounding / (white * variance_m2)) * correlation


def _whitened(
    columns: FloatArray, ar1: float, white: float = 0.0, white_ar1: float = 0.0
) -> tuple[FloatArray, float]:
    """Innovations of (frames, columns) without gaps; and ln of the determinant of one column."""
    since = np.ones((len(columns), 1), dtype=np.int_)
    since[0] = 0
    made, log_det = made_white(columns[:, None], since >= 0, since, ar1, white, white_ar1)
    return made[:, 0], log_det
