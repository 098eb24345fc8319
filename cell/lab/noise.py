"""Noise of the camera, level and colour, from frames in which nothing moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cell.identify.golden_section import where_least
from cell.identify.noise import Noise, still_frames
from cell.study.data import Study, Trial

FloatArray = NDArray[np.float64]

#: Fewer still frames than this say nothing about noise.
MIN_STILL_FRAMES = 6
MAX_COLOUR = 0.98


class NoiseUnknownError(ValueError):
    """The study neither states its noise nor has frames in which nothing moves."""


@dataclass(frozen=True)
class Floor:
    """The noise floor: what no model can explain, and how well that itself is known.

    freedom   degrees of freedom behind the level; `inf` if the study states it
    coloured  whether still frames have shown its colour
    together  channels that err together, as of markers taken from a fitted shape: so many values
              tell as much as one
    """

    noise: Noise
    freedom: float
    coloured: bool = True
    together: float = 1.0

    @property
    def stated(self) -> bool:
        """Whether the study states the level."""
        return bool(np.isinf(self.freedom))

    @property
    def weighed(self) -> Noise:
        """Noise of independent markers that tell as much."""
        if self.together == 1.0:
            return self.noise
        return replace(self.noise, std_m=self.noise.std_m * float(np.sqrt(self.together)))

    @property
    def effective_fraction(self) -> float:
        """Independent values per value, when averaging: (1 − ρ) / (1 + ρ)."""
        return (1.0 - self.noise.colour) / (1.0 + self.noise.colour)

    @property
    def slow_freedom(self) -> float:
        """Degrees of freedom behind the level of its slow part, which the colour decides.

        That level is the innovations' variance over (1 − ρ)²; the variance of ρ is (1 − ρ²) / n.
        """
        return self.freedom / (1.0 + 2.0 / self.effective_fraction)


def floor_of_residuals(floor: Floor, errors: Sequence[FloatArray]) -> Floor:
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
    if not floor.stated or power == 0.0:
        return floor
    pairs = [np.isfinite(e[1:]) & np.isfinite(e[:-1]) for e in errors]
    products = sum(float(np.sum((e[1:] * e[:-1])[p])) for e, p in zip(filled, pairs, strict=True))
    count, neighbours = (sum(int(x.sum()) for x in y) for y in (map(np.isfinite, errors), pairs))
    colour = float(np.clip(products / max(neighbours, 1) * count / power, 0.0, MAX_COLOUR))
    if floor.coloured:
        colour = min(colour, floor.noise.colour)
    channels = np.sum([e.T @ e for e in filled], axis=0)
    there = int(np.count_nonzero(np.diag(channels)))
    frames = count / there * (1.0 - colour**2) / (1.0 + colour**2)
    alike = float(np.sum(channels**2)) / power**2 - 1.0 / frames
    together = float(np.clip(there * alike, 1.0, there))
    return replace(floor, noise=replace(floor.noise, colour=colour), together=together)


def noise_floor(study: Study) -> Floor:
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
        return Floor(Noise(study.noise_std_m), np.inf, coloured=False)
    degree = min(range(3), key=lambda d: _fit_colour(blocks, d)[1])
    floor = _fit_colour(blocks, degree)[0]
    if study.noise_std_m is None:
        return floor
    return Floor(Noise(study.noise_std_m, floor.noise.colour), np.inf)


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


def _fit_colour(blocks: Sequence[_Block], degree: int) -> tuple[Floor, float]:
    """Floor with polynomials of a degree taken out of every series; and its BIC."""

    def parts(colour: float) -> tuple[float, int, float, float]:
        square, freedom, log_det, log_fixed = 0.0, 0, 0.0, 0.0
        for block in blocks:
            frames, series = block.z_m.shape
            u = np.linspace(-1.0, 1.0, frames)
            q, r = np.linalg.qr(_white(np.vander(u, degree + 1), colour))
            z = _white(block.z_m, colour)
            square += float(np.sum((z - q @ (q.T @ z)) ** 2))
            freedom += (frames - degree - 1) * series
            log_det += series * (frames - 1) * float(np.log(1.0 - colour**2))
            log_fixed += 2.0 * series * float(np.log(np.abs(np.diag(r))).sum())
        return square, freedom, log_det, log_fixed

    def restricted(colour: float) -> float:
        square, freedom, log_det, log_fixed = parts(colour)
        return freedom * float(np.log(max(square, 1e-300))) + log_det + log_fixed

    found = where_least(restricted, 0.0, MAX_COLOUR, within=1e-5)
    colour = min((0.0, found, MAX_COLOUR), key=restricted)
    square, freedom, log_det, _ = parts(colour)
    count = sum(b.z_m.size for b in blocks)
    fixed = (degree + 1) * sum(b.z_m.shape[1] for b in blocks)
    bic = count * float(np.log(max(square, 1e-300) / count)) + log_det + fixed * np.log(count)
    std_m = max(float(np.sqrt(square / freedom)), 1e-12)
    return Floor(Noise(std_m, colour), float(freedom)), float(bic)


def _white(values: FloatArray, colour: float) -> FloatArray:
    """(frames, series) made white, of the variance that they had."""
    white = values.copy()
    white[1:] = (values[1:] - colour * values[:-1]) / np.sqrt(1.0 - colour**2)
    return white
