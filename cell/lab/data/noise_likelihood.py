"""The confidence set of the noise's level and correlation, from frames at rest."""

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

#: Strongest correlation of neighbouring frames that is believed.
MAX_AR1 = 0.98
#: A change of level or of 1 − ρ below this share changes nothing that is said.
UNCHANGED = 0.005
#: The rest allows a noise whose likelihood ratio (−2 ln, to the likeliest) is below this: a 99.9 %
#: confidence set of level, correlation and white share (χ² of 3 degrees of freedom; Wilks 1938).
ALLOWED = 16.3
#: The same of what is told of a level: a 95 % interval (χ² of 1 degree of freedom).
CHI2_95 = 3.84
#: AR(1) correlations that are compared, evenly in the logarithm of 1 − ρ, on which slow noise
#: depends; and white shares with them, of values that are rounded.
AR1_GRID = 1.0 - (1.0 - MAX_AR1) ** np.linspace(0.0, 1.0, 121)
WHITE_SHARES = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
#: Highest degree of the polynomials taken out of a cable that settles, and of one that drifts.
DEGREE, DRIFT_DEGREE = 2, 5
#: Rounding to less than this share of the noise adds nothing white that is seen.
SEEN_ROUNDING = 0.25
#: Still frames show the level of values that are rounded to less than so many standard deviations.
ROUNDED = 2.0


@dataclass(frozen=True, eq=False)
class RestFrames:
    """Level and AR(1) correlation of the noise as estimated from still frames.

    degree        of the polynomials that are taken out of every series
    resolution_m  step to which values are rounded; 0 = not seen to be
    """

    blocks: tuple[NoiseBlock, ...]
    degree: int
    resolution_m: float

    @staticmethod
    def of(blocks: Sequence[NoiseBlock], resolution_m: float, most: int = DEGREE) -> RestFrames:
        """With polynomials of the degree, up to `most`, that the blocks need, by BIC."""
        rests = [RestFrames(tuple(blocks), degree, resolution_m) for degree in range(most + 1)]
        return min(rests, key=lambda r: r.bic)

    @cached_property
    def bic(self) -> float:
        """Of its polynomials with the likeliest correlation."""
        return self._bic(self._ar1())

    @property
    def frames(self) -> int:
        """Of the longest series."""
        return max(len(b.z_m) for b in self.blocks)

    def likeliest(self) -> tuple[Noise, float]:
        """Level and correlation, by the rest alone, and the degrees of freedom behind the level."""
        ar1 = self._ar1()
        square, dof, _ = self.sums(ar1)
        std_m = max(float(np.sqrt(square / dof)), 1e-12)
        if self.is_hidden(std_m):
            return Noise(self.resolution_m / np.sqrt(12.0)), float(dof)
        return Noise(std_m, ar1), float(dof)

    def is_hidden(self, std_m: float) -> bool:
        """Whether values are rounded so much that a cable at rest does not show their error."""
        return self.resolution_m > ROUNDED * std_m

    @cached_property
    def noises(self) -> list[tuple[float, float]]:
        """AR(1) correlations and white shares that are compared."""
        std_m = float(np.sqrt(self.sums(0.0)[0] / self.sums(0.0)[1]))
        whites = WHITE_SHARES if self.resolution_m > SEEN_ROUNDING * std_m else WHITE_SHARES[:1]
        return [(float(ar1), white) for white in whites for ar1 in AR1_GRID]

    @cached_property
    def allowed(self) -> Allowed:
        """The levels that the rest allows with each of its `noises`."""
        noises = self.noises
        sums = np.array([self.sums(ar1, white) for ar1, white in noises])
        square, dof, fixed = sums.T
        level = np.maximum(square / dof, 1e-24)
        profile = dof * np.log(level) + fixed
        # the likeliest level, not the least: within a short rest slow noise varies little
        if self.is_hidden(float(np.sqrt(level[np.argmin(profile)]))):
            once_m2 = 0.25 * self.resolution_m**2 / dof  # a value that changed a step once
            nothing = np.zeros(len(noises))
            likeliest = np.full(len(noises), level.min()) + once_m2
            return Allowed(
                likeliest, nothing, nothing, nothing, float(dof[0]), self.resolution_m, True
            )
        unlikely = profile - profile.min()
        return Allowed(level, unlikely, square, fixed, float(dof[0]), self.resolution_m)

    def sums(self, ar1: float, white: float = 0.0) -> tuple[float, int, float]:
        """Innovations' square, its degrees of freedom, and log determinants, for a noise.

        What is white in motion is rounding for the most part, and that is not white at rest.
        """
        square, dof, log_det = self._sums(ar1, white, 0.0)
        if white == 0.0:
            return square, dof, log_det
        return self._sums(ar1, white, rounding_ar1(square / dof, ar1, white, self.resolution_m))

    def _sums(self, ar1: float, white: float, of_white: float) -> tuple[float, int, float]:
        """The same with a white share that has an AR(1) correlation of its own."""
        square, dof, log_det = 0.0, 0, 0.0
        for block in self.blocks:
            frames, series = block.z_m.shape
            z, q, r, of_frames = self._parted(block, ar1, white, of_white)
            square += float(np.sum((z - q @ (q.T @ z)) ** 2))
            dof += (frames - self.degree - 1) * series
            log_det += of_frames + 2.0 * series * float(np.log(np.abs(np.diag(r))).sum())
        return square, dof, log_det

    def whitened(self, block: NoiseBlock, ar1: float) -> FloatArray:
        """(frames, series) innovations of a block, less its polynomials."""
        z, q, _, _ = self._parted(block, ar1, 0.0, 0.0)
        return np.asarray(z - q @ (q.T @ z))

    def _parted(
        self, block: NoiseBlock, ar1: float, white: float, of_white: float
    ) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """A block made white; Q and R of its polynomials; ln of the determinant."""
        u = np.linspace(-1.0, 1.0, len(block.z_m))
        columns = np.concatenate([np.vander(u, self.degree + 1), block.z_m], axis=1)
        columns, log_det = _whole(columns, ar1, white, of_white)
        powers, z = np.split(columns, [self.degree + 1], axis=1)
        q, r = np.linalg.qr(powers)
        return z, q, r, block.z_m.shape[1] * log_det

    def _restricted(self, ar1: float) -> float:
        square, dof, log_det = self.sums(ar1)
        return dof * float(np.log(max(square, 1e-300))) + log_det

    def _ar1(self) -> float:
        found = where_least(self._restricted, 0.0, MAX_AR1, within=1e-5)
        return min((0.0, found, MAX_AR1), key=self._restricted)

    def _bic(self, ar1: float) -> float:
        square, _, _ = self.sums(ar1)
        log_det = sum(b.z_m.shape[1] * _whole(b.z_m, ar1, 0.0, 0.0)[1] for b in self.blocks)
        count = sum(b.z_m.size for b in self.blocks)
        fixed = (self.degree + 1) * sum(b.z_m.shape[1] for b in self.blocks)
        likelihood = count * float(np.log(max(square, 1e-300) / count)) + log_det
        return float(likelihood + fixed * np.log(count))


@dataclass(frozen=True, eq=False)
class Allowed:
    """Levels that a rest allows, for each of some correlations and white shares.

    level_m2   likeliest variance; −2 ln of its likelihood is `unlikely` above that of the best
    square_m2, fixed   −2 ln of the likelihood of a variance v is dof · ln v + square / v +
                       fixed
    hidden     rounding hides the error from a cable at rest: what is seen bounds it, no more
    """

    level_m2: FloatArray
    unlikely: FloatArray
    square_m2: FloatArray
    fixed: FloatArray
    dof: float
    resolution_m: float
    hidden: bool = False

    @property
    def weight(self) -> float:
        """Values that the rest's likelihood is worth compared with others'."""
        return 0.0 if self.hidden else self.dof

    def within(self, limit: float) -> tuple[FloatArray, FloatArray]:
        """Least and largest variance with a likelihood ratio below a limit, m².

        Of a correlation and share that do not reach it the least is infinite.  Rounding errs by at
        least as much as steps of that size do, and may add as much to what the rest has shown.
        source  Wilks 1938; u − ln u = 1 + k is solved by Lambert's W
        """
        of_rounding = self.resolution_m**2 / 12.0
        slack = (limit - self.unlikely) / self.dof
        inside = -np.exp(-1.0 - np.maximum(slack, 0.0))
        least, largest = (self.level_m2 / -lambertw(inside, k).real for k in (-1, 0))
        least = np.maximum(0.0 if self.hidden else least, of_rounding)
        least = np.where(slack < 0.0, np.inf, least)
        return least, largest + of_rounding

    @property
    def range_m(self) -> tuple[float, float]:
        """95 % interval of the level, whatever correlation and share."""
        least, largest = self.within(CHI2_95)
        there = least <= largest
        return float(np.sqrt(least[there].min())), float(np.sqrt(largest[there].max()))


def dof_of(log_level: FloatArray, cost: FloatArray, dof: float) -> float:
    """Degrees of freedom behind a level that is as uncertain as noises of such a cost leave it."""
    likely = cost < cost.min() + 2.0 * ALLOWED
    weight = np.exp(-0.5 * (cost[likely] - cost.min()))
    weight /= weight.sum()
    mean = float(weight @ log_level[likely])
    variance = float(weight @ (log_level[likely] - mean) ** 2) + 2.0 / max(dof, 1.0)
    return 2.0 / variance


def alike(one: Noise, other: Noise) -> bool:
    """Whether two noises differ only by a negligible amount."""
    level = abs(np.log(one.std_m / other.std_m))
    memory = abs(np.log((1.0 - one.ar1) / (1.0 - other.ar1)))
    return bool(max(level, memory) < UNCHANGED)


def resolution_m(measured: Sequence[FloatArray]) -> float:
    """Step to which most series are rounded, m; 0 where values do not repeat.

    The smallest difference of two values of a series (frames,), where some are equal.
    """
    steps = []
    for series in measured:
        seen = series[np.isfinite(series)]
        values = np.unique(seen)
        steps.append(float(np.diff(values).min()) if 1 < len(values) < len(seen) else 0.0)
    return float(np.median(steps)) if steps else 0.0


def rounding_ar1(variance_m2: float, ar1: float, white: float, step_m: float) -> float:
    """Correlation of neighbouring frames, at rest, of the white share of a noise.

    variance_m2  of the whole noise
    white        its share that is new in every frame, or rounding to `step_m`

    The error of rounding is a sawtooth of the value.  Of each of its harmonics frames between which
    the value changes by a normal amount have the characteristic function of that for a correlation.
    source  Sripad & Snyder 1977, IEEE Trans. Acoust. 25, 442
    """
    of_rounding = step_m**2 / 12.0
    slow, fresh = (1.0 - white) * variance_m2, max(white * variance_m2 - of_rounding, 0.0)
    change = (2.0 * np.pi / step_m) ** 2 * (slow * (1.0 - ar1) + fresh)
    harmonics = np.arange(1.0, 31.0)
    correlation = 6.0 / np.pi**2 * float(np.sum(np.exp(-change * harmonics**2) / harmonics**2))
    return min(1.0, of_rounding / (white * variance_m2)) * correlation


def _whole(
    columns: FloatArray, ar1: float, white: float, of_white: float
) -> tuple[FloatArray, float]:
    """(frames, columns) of which all is seen, made white; and ln of the determinant of one."""
    since = np.ones((len(columns), 1), dtype=np.int_)
    since[0] = 0
    made, log_det = made_white(columns[:, None], since >= 0, since, ar1, white, of_white)
    return made[:, 0], log_det


@dataclass(frozen=True)
class NoiseBlock:
    """Still coordinates of one trial: (frames, series), all seen.

    series  which of the trial's coordinates they are: 2 · marker + axis
    """

    z_m: FloatArray
    series: tuple[int, ...] = ()


#: What is taken out of a residual is worked out at so many correlations, and between them by a
#: cubic spline: to 0.03 of −2 ln of the likelihood where they span all.
NODES = 13


@dataclass(frozen=True, eq=False)
class Remainder:
    """The part of a residual in motion that neither fitted parameters nor any effect can explain.

    errors_m   per trial (times, channels), nan where not seen or at rest
    explained  per trial (times, channels, directions) what parameters and effects may add to it,
               independent of each other over all trials
    """

    errors_m: tuple[FloatArray, ...]
    explained: tuple[FloatArray, ...]

    @property
    def dof(self) -> int:
        """Values less the directions that were taken out of them."""
        count = sum(int(np.isfinite(e).sum()) for e in self.errors_m)
        return max(count - int(self.explained[0].shape[-1]), 0)

    @cached_property
    def _trials(self) -> list[tuple[FloatArray, NDArray[np.bool_], NDArray[np.int_]]]:
        """Per trial (times, channels, 1) errors, 0 where not seen; which are; frames since then."""
        seen = [np.isfinite(e) for e in self.errors_m]
        return [
            (np.where(s, e, 0.0)[..., None], s, frames_since(s))
            for e, s in zip(self.errors_m, seen, strict=True)
        ]

    def sums(
        self, noises: Sequence[tuple[float, float]], wanted: NDArray[np.bool_]
    ) -> tuple[FloatArray, FloatArray]:
        """By correlation and white share: the innovations' square, m², and log determinant.

        Restricted to what the directions leave: slow noise is like them, so that much of it was
        taken out with them.  nan of a noise that is not wanted.
        source  Patterson & Thompson 1971, Biometrika 58, 545
        """
        found = np.full((len(noises), 2), np.nan)
        for i in np.flatnonzero(wanted):
            found[i] = self._of(noises[int(i)], directions=False)
        if self.dof > 0 and self.explained[0].shape[-1] > 0:
            whites = np.array([white for _, white in noises])
            for white in np.unique(whites[wanted]):
                own = np.flatnonzero(wanted & (whites == white))
                found[own] += self._taken_out(found[own], [noises[i] for i in own.tolist()])
        return found[:, 0], found[:, 1]

    def _taken_out(self, found: FloatArray, noises: Sequence[tuple[float, float]]) -> FloatArray:
        """Changes of sums, of noises of one white share, by what is taken out: between some."""
        nodes = np.unique(np.linspace(0, len(noises) - 1, NODES).round().astype(int))
        exact = np.array([self._of(noises[i], directions=True) for i in nodes])
        if len(nodes) == len(noises):
            return np.asarray(exact - found)
        place = -np.log1p(-np.array([ar1 for ar1, _ in noises]))
        ratio = CubicSpline(place[nodes], exact[:, 0] / np.maximum(found[nodes, 0], 1e-300))(place)
        log_det = CubicSpline(place[nodes], exact[:, 1] - found[nodes, 1])(place)
        return np.stack([found[:, 0] * (ratio - 1.0), log_det], axis=1)

    def _of(self, noise: tuple[float, float], *, directions: bool) -> tuple[float, float]:
        """Square and log determinant, within what the directions leave or of all."""
        size = self.explained[0].shape[-1] * directions + 1
        gram, log_det = np.zeros((size, size)), 0.0
        for (values, seen, since), explained in zip(self._trials, self.explained, strict=True):
            columns = np.concatenate([explained, values], axis=-1) if directions else values
            white, of_trial = made_white(columns, seen, since, *noise, 0.0)
            rows = white.reshape(-1, white.shape[-1])
            gram, log_det = gram + rows.T @ rows, log_det + of_trial
        if not directions:
            return float(gram[0, 0]), log_det
        root = np.linalg.cholesky(gram[:-1, :-1])
        along = solve_triangular(root, gram[:-1, -1], lower=True)
        square = max(float(gram[-1, -1] - along @ along), 0.0)
        return square, log_det + 2.0 * float(np.log(np.diag(root)).sum())
