"""Noise of the camera, level and colour: what the rest allows, and of that what all frames say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import lambertw

from cell.identify.golden_section import where_least
from cell.identify.noise import Noise, still_frames
from cell.study.data import Study, Trial

FloatArray = NDArray[np.float64]

#: Fewer still frames than this say nothing about noise.
MIN_STILL_FRAMES = 6
MAX_COLOUR = 0.98
#: The rest allows a noise whose likelihood ratio (−2 ln, to the likeliest) is below this: a 99.9 %
#: confidence set of level, colour and white share (χ² of 3 degrees of freedom; Wilks 1938).
ALLOWED = 16.3
#: The same of what is told of a level: a 95 % interval (χ² of 1 degree of freedom).
TOLD = 3.84
#: Colours that are compared, evenly in the logarithm of 1 − ρ, on which slow noise depends; and
#: white shares beside them, of values that are rounded.
COLOURS = 1.0 - (1.0 - MAX_COLOUR) ** np.linspace(0.0, 1.0, 121)
WHITES = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
#: Rounding to less than this share of the noise adds nothing white that is seen.
SEEN_ROUNDING = 0.25
#: Still frames show the level of values that are rounded to less than so many standard deviations.
ROUNDED = 2.0
#: A level is known if the rest would not allow an error as large as the noise beside it.
KNOWN_WITHIN = 2.0
#: A change of level or of 1 − ρ below this share changes nothing that is said.
UNCHANGED = 0.005


class NoiseUnknownError(ValueError):
    """The study neither states its noise nor has frames in which nothing moves."""


@dataclass(frozen=True)
class NoiseModel:
    """The noise of the markers: what no model can explain, and how well that itself is known.

    dof   degrees of freedom behind the level; `inf` if the study states it
    coloured  whether still frames have shown its colour
    together  channels that err together, as of markers taken from a fitted shape: so many values
              tell as much as one
    rest      what still frames tell of level and colour; None where the level is stated
    range_m   95 % interval of the level by the rest alone, m; None where that is not asked
    hidden    values are rounded so much that still frames do not show their error
    slow      degrees of freedom behind the level of its slow part; None: as a known colour's
    """

    noise: Noise
    dof: float
    coloured: bool = True
    correlated_channels: float = 1.0
    rest: Rest | None = field(default=None, compare=False, repr=False)
    range_m: tuple[float, float] | None = None
    slow: float | None = None
    hidden: bool = False

    @property
    def stated(self) -> bool:
        """Whether the study states the level."""
        return bool(np.isinf(self.dof))

    @property
    def level_known(self) -> bool:
        """Whether an error as large as the noise would be more than the rest allows."""
        return self.range_m is None or self.range_m[1] ** 2 < KNOWN_WITHIN * self.noise.std_m**2

    @property
    def frames_needed(self) -> int:
        """Still frames of a trial after which the level would be known, as many trials as here."""
        if self.rest is None or self.range_m is None:
            return 0
        known, wanted = (
            np.log(r) + 1.0 / r - 1.0
            for r in ((self.range_m[1] / self.noise.std_m) ** 2, KNOWN_WITHIN)
        )
        return int(10 * np.ceil(0.1 * self.rest.frames * max(known / wanted, 1.0)))

    @property
    def weighed(self) -> Noise:
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
        """Degrees of freedom behind the level of its slow part, which the colour decides.

        That level is the innovations' variance over (1 − ρ)²; the variance of ρ is (1 − ρ²) / n.
        """
        return self.slow or self.dof / (1.0 + 2.0 / self.effective_fraction)


def floor_of_residuals(noise_model: NoiseModel, errors: Sequence[FloatArray]) -> NoiseModel:
    """A stated floor with the correlations that a fitted model's residuals have.

    A study that states its error has it from elsewhere: from shapes fitted to pictures, say, which
    err along the whole cable at once and for several frames, and its few still frames say little of
    that.  What the model misses is slow and along the whole cable too, so that the residual is no
    less correlated than the error: its colour bounds the error's.

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
    colour = float(np.clip(products / max(neighbours, 1) * count / power, 0.0, MAX_COLOUR))
    if noise_model.coloured:
        colour = min(colour, noise_model.noise.ar1)
    channels = np.sum([e.T @ e for e in filled], axis=0)
    there = int(np.count_nonzero(np.diag(channels)))
    frames = count / there * (1.0 - colour**2) / (1.0 + colour**2)
    alike = float(np.sum(channels**2)) / power**2 - 1.0 / frames
    together = float(np.clip(there * alike, 1.0, there))
    return replace(
        noise_model, noise=replace(noise_model.noise, ar1=colour), correlated_channels=together
    )


def noise_floor(study: Study) -> NoiseModel:
    """Noise floor of a study, from the frames before anything moves, all markers together.

    Restricted maximum likelihood of level and AR(1) correlation; each coordinate of each trial has
    its own mean, and its own slope or parabola where the cable is still settling (chosen by BIC).
    A level stated in the study is kept and only its colour estimated.

    raises  NoiseUnknownError: no still frames and no stated level
    """
    blocks = [block for trial in study.trials for block in _still_blocks(trial)]
    if not blocks:
        if study.noise_std_m is None:
            raise NoiseUnknownError(
                f"study {study.name}: no trial has {MIN_STILL_FRAMES} frames before the hand "
                "moves, so the camera's noise is unknown; give noise_std_m in study.yaml"
            )
        return NoiseModel(Noise(study.noise_std_m), np.inf, coloured=False)
    rest = Rest.of(blocks, _resolution_m(study))
    found, dof = rest.likeliest()
    if study.noise_std_m is None:
        return NoiseModel(found, dof, rest=rest)
    return NoiseModel(Noise(study.noise_std_m, found.ar1), np.inf)


@dataclass(frozen=True)
class _Block:
    """Still coordinates of one trial: (frames, series), all seen."""

    z_m: FloatArray


def _still_blocks(trial: Trial) -> list[_Block]:
    """Of every coordinate the longest run of frames in which it is seen, equal runs together.

    So that a lost frame costs what came before or after it, and not the marker.
    """
    still = still_frames(trial.markers.t_s, trial.grip, trial.rests_until_s)
    series_m = trial.markers.xy_m[still]
    series_m = series_m.reshape(len(series_m), 2 * series_m.shape[1])
    together: dict[tuple[int, int], list[int]] = {}
    seen: NDArray[np.bool_] = np.isfinite(series_m)
    for series in range(series_m.shape[1]):
        begin, end = _longest_run(seen[:, series])
        if end - begin >= MIN_STILL_FRAMES:
            together.setdefault((begin, end), []).append(series)
    return [_Block(series_m[begin:end, series]) for (begin, end), series in together.items()]


def _longest_run(seen: NDArray[np.bool_]) -> tuple[int, int]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(np.int8)))
    runs = edges.reshape(-1, 2)
    if len(runs) == 0:
        return 0, 0
    begin, end = runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return int(begin), int(end)


@dataclass(frozen=True, eq=False)
class Rest:
    """What still frames tell of level and colour.

    degree        of the polynomials that are taken out of every series
    resolution_m  step to which values are rounded; 0 = not seen to be
    """

    blocks: tuple[_Block, ...]
    degree: int
    resolution_m: float

    @staticmethod
    def of(blocks: Sequence[_Block], resolution_m: float) -> Rest:
        """With polynomials of the degree that the blocks need, by BIC."""
        rests = [Rest(tuple(blocks), degree, resolution_m) for degree in range(3)]
        return min(rests, key=lambda r: r._bic(r._colour()))

    @property
    def frames(self) -> int:
        """Of the longest series."""
        return max(len(b.z_m) for b in self.blocks)

    def likeliest(self) -> tuple[Noise, float]:
        """Level and colour, by the rest alone, and the degrees of freedom behind the level."""
        colour = self._colour()
        square, dof, _ = self.sums(colour)
        std_m = max(float(np.sqrt(square / dof)), 1e-12)
        if self.is_hidden(std_m):
            return Noise(self.resolution_m / np.sqrt(12.0)), float(dof)
        return Noise(std_m, colour), float(dof)

    def is_hidden(self, std_m: float) -> bool:
        """Whether values are rounded so much that a cable at rest does not show their error."""
        return self.resolution_m > ROUNDED * std_m

    @property
    def noises(self) -> list[tuple[float, float]]:
        """Colours and white shares that are compared."""
        std_m = float(np.sqrt(self.sums(0.0)[0] / self.sums(0.0)[1]))
        whites = WHITES if self.resolution_m > SEEN_ROUNDING * std_m else WHITES[:1]
        return [(float(colour), white) for white in whites for colour in COLOURS]

    def allowed(self, noises: Sequence[tuple[float, float]]) -> Allowed:
        """The levels that the rest allows with each of some colours and white shares."""
        sums = np.array([self.sums(colour, white) for colour, white in noises])
        square, dof, fixed = sums.T
        level = np.maximum(square / dof, 1e-24)
        if self.is_hidden(float(np.sqrt(level.min()))):
            once_m2 = 0.25 * self.resolution_m**2 / dof  # a value that changed a step once
            nothing = np.zeros(len(noises))
            likeliest = np.full(len(noises), level.min()) + once_m2
            return Allowed(
                likeliest, nothing, nothing, nothing, float(dof[0]), self.resolution_m, True
            )
        profile = dof * np.log(level) + fixed
        unlikely = profile - profile.min()
        return Allowed(level, unlikely, square, fixed, float(dof[0]), self.resolution_m)

    def sums(self, colour: float, white: float = 0.0) -> tuple[float, int, float]:
        """Innovations' square, its degrees of freedom, and log determinants, for a noise."""
        square, dof, log_det = 0.0, 0, 0.0
        for block in self.blocks:
            frames, series = block.z_m.shape
            u = np.linspace(-1.0, 1.0, frames)
            powers, _ = _white(np.vander(u, self.degree + 1), colour, white)
            z, of_frames = _white(block.z_m, colour, white)
            q, r = np.linalg.qr(powers)
            square += float(np.sum((z - q @ (q.T @ z)) ** 2))
            dof += (frames - self.degree - 1) * series
            log_det += of_frames + 2.0 * series * float(np.log(np.abs(np.diag(r))).sum())
        return square, dof, log_det

    def _restricted(self, colour: float) -> float:
        square, dof, log_det = self.sums(colour)
        return dof * float(np.log(max(square, 1e-300))) + log_det

    def _colour(self) -> float:
        found = where_least(self._restricted, 0.0, MAX_COLOUR, within=1e-5)
        return min((0.0, found, MAX_COLOUR), key=self._restricted)

    def _bic(self, colour: float) -> float:
        square, _, _ = self.sums(colour)
        log_det = sum(_white(b.z_m, colour, 0.0)[1] for b in self.blocks)
        count = sum(b.z_m.size for b in self.blocks)
        fixed = (self.degree + 1) * sum(b.z_m.shape[1] for b in self.blocks)
        likelihood = count * float(np.log(max(square, 1e-300) / count)) + log_det
        return float(likelihood + fixed * np.log(count))


@dataclass(frozen=True, eq=False)
class Remainder:
    """What of a residual neither fitted parameters nor any effect could explain, in motion.

    errors_m  per trial (times, channels), nan where not seen or at rest
    dof   values less what was taken out of them
    """

    errors_m: tuple[FloatArray, ...]
    dof: float

    def sums(self, noises: Sequence[tuple[float, float]]) -> tuple[FloatArray, FloatArray]:
        """Of colours and white shares the innovations' square, m², and their log determinant."""
        count = sum(int(np.isfinite(e).sum()) for e in self.errors_m)
        found = np.zeros((len(noises), 2))
        for error in self.errors_m:
            seen = np.isfinite(error)
            series = np.ascontiguousarray(np.where(seen, error, 0.0))
            for i, (colour, white) in enumerate(noises):
                found[i] += _innovation_sums(series, seen, colour, white)
        return found[:, 0], found[:, 1] * self.dof / max(count, 1)


@dataclass(frozen=True, eq=False)
class Allowed:
    """Levels that a rest allows, for each of some colours and white shares.

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
        """Values that the rest's likelihood is worth beside others'."""
        return 0.0 if self.hidden else self.dof

    def within(self, limit: float) -> tuple[FloatArray, FloatArray]:
        """Least and largest variance with a likelihood ratio below a limit, m².

        Of a colour and share that do not reach it the least is infinite.  Rounding errs by at
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
        """95 % interval of the level, whatever colour and share."""
        least, largest = self.within(TOLD)
        there = least <= largest
        return float(np.sqrt(least[there].min())), float(np.sqrt(largest[there].max()))


def floor_of_all_frames(noise_model: NoiseModel, remainder: Remainder) -> NoiseModel:
    """The noise, of all that the rest allows, that explains rest and remainder best.

    Few still frames leave level and colour uncertain, and a noise taken for known that is not makes
    misfits of it.  In motion there are more values, but a misfit may be in them: so they choose
    within what the rest allows, and what goes beyond that is no noise.
    source  Berger and Boos 1994, J. Am. Stat. Assoc. 89, 1012: nuisances within a confidence set
    """
    if noise_model.rest is None:
        return noise_model
    noises = noise_model.rest.noises
    rest = noise_model.rest.allowed(noises)
    least, largest = rest.within(ALLOWED)
    moving_m2, log_det = remainder.sums(noises)
    square, dof = rest.square_m2 + moving_m2, rest.weight + remainder.dof
    wanted = square / max(dof, 1.0)
    level = np.clip(wanted, least, np.maximum(largest, least))
    cost = dof * np.log(level) + square / level + rest.fixed + log_det
    cost = np.where(least <= largest, cost, np.inf)
    best = int(np.argmin(cost))
    colour, white = noises[best]
    noise = Noise(float(np.sqrt(level[best])), colour, white=white)
    if not least[best] <= wanted[best] <= largest[best]:
        dof = noise_model.dof
    slow = None
    if len(noises) > len(COLOURS):
        fractions = np.array([Noise(1.0, *n[:1], white=n[1]).effective_fraction for n in noises])
        slow = _freedom_of(np.log(level / fractions), cost, dof)
    told = replace(noise_model, range_m=rest.range_m, hidden=rest.hidden)
    if _alike(noise, noise_model.noise):
        return told
    return replace(told, noise=noise, dof=dof, slow=slow)


def _freedom_of(log_level: FloatArray, cost: FloatArray, dof: float) -> float:
    """Degrees of freedom behind a level that is as uncertain as noises of such a cost leave it."""
    likely = cost < cost.min() + 2.0 * ALLOWED
    weight = np.exp(-0.5 * (cost[likely] - cost.min()))
    weight /= weight.sum()
    mean = float(weight @ log_level[likely])
    variance = float(weight @ (log_level[likely] - mean) ** 2) + 2.0 / max(dof, 1.0)
    return 2.0 / variance


def _alike(one: Noise, other: Noise) -> bool:
    level = abs(np.log(one.std_m / other.std_m))
    colour = abs(np.log((1.0 - one.ar1) / (1.0 - other.ar1)))
    return bool(max(level, colour) < UNCHANGED)


def _resolution_m(study: Study) -> float:
    """Step to which most series of markers are rounded, m; 0 where values do not repeat.

    The smallest difference of two values of a series, where some are equal.
    """
    steps = []
    for trial in study.trials:
        for series in trial.markers.xy_m.reshape(len(trial.markers.t_s), -1).T:
            seen = series[np.isfinite(series)]
            values = np.unique(seen)
            steps.append(float(np.diff(values).min()) if 1 < len(values) < len(seen) else 0.0)
    return float(np.median(steps)) if steps else 0.0


@njit(cache=True)
def _white(values: FloatArray, colour: float, white: float) -> tuple[FloatArray, float]:
    """(frames, series) made white, of the variance that they had; and ln of the determinant."""
    frames, series = values.shape
    out = np.empty_like(values)
    expected = np.zeros(series)
    log_det = known = 0.0
    for t in range(frames):
        memory = colour if t > 0 else 0.0
        fresh = memory**2 * known + (1.0 - memory**2) * (1.0 - white)
        variance = fresh + white
        gain = fresh / variance
        known = (1.0 - gain) * fresh
        log_det += series * np.log(variance)
        for i in range(series):
            new = values[t, i] - memory * expected[i]
            out[t, i] = new / np.sqrt(variance)
            expected[i] = memory * expected[i] + gain * new
    return out, log_det


@njit(cache=True)
def _innovation_sums(
    values: FloatArray, seen: NDArray[np.bool_], colour: float, white: float
) -> tuple[float, float]:
    """Of (frames, series) with gaps: sum of the squares when white, and ln of the determinant."""
    frames, series = values.shape
    square = log_det = 0.0
    for i in range(series):
        known, expected, memory = 0.0, 0.0, 0.0
        for t in range(frames):
            if seen[t, i]:
                fresh = memory**2 * known + (1.0 - memory**2) * (1.0 - white)
                variance = fresh + white
                gain = fresh / variance
                known = (1.0 - gain) * fresh
                new = values[t, i] - memory * expected
                expected = memory * expected + gain * new
                square += new * new / variance
                log_det += np.log(variance)
                memory = colour
            else:
                memory *= colour
    return square, log_det
