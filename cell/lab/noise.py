"""Noise of the camera, level and colour, from frames in which nothing moves; and its whitening."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from cell.cable.geometry import Motion
from cell.study.data import Study, Trial

FloatArray = NDArray[np.float64]

#: The hand counts as still until its speed, over `SPEED_WINDOW_S`, has passed this.
STILL_SPEED_M_PER_S = 0.005
STILL_TURN_RAD_PER_S = 0.02
SPEED_WINDOW_S = 0.02
#: Frames of fewer than this many still instants say nothing about noise.
MIN_STILL_FRAMES = 6
MAX_AR1 = 0.98


class NoiseUnknownError(ValueError):
    """The study neither states its noise nor has frames in which nothing moves."""


@dataclass(frozen=True)
class Noise:
    """Gaussian noise of a marker's coordinate: `std_m`, and AR(1) correlation over `frame_s`."""

    std_m: float
    ar1: float
    frame_s: float

    def correlation(self, gap_s: FloatArray) -> FloatArray:
        """Correlation of two values of one coordinate, `gap_s` apart."""
        if self.ar1 <= 0.0:
            return np.zeros_like(gap_s)
        return np.asarray(self.ar1 ** (gap_s / self.frame_s))

    def effective_fraction(self) -> float:
        """Independent values per value when averaging: (1 − ρ) / (1 + ρ)."""
        return (1.0 - self.ar1) / (1.0 + self.ar1)


@dataclass(frozen=True)
class Whitener:
    """Turns marker coordinates of one trial into independent values of unit variance.

    Every seen coordinate is predicted from the one seen before it of the same marker, however long
    ago; what is left is divided by its standard deviation.  Linear, so that it serves residuals and
    sensitivities alike.

    now, before  (observations,) indices into a flattened (times, markers, 2)
    weight       (observations,) what of `before` is subtracted
    scale_m      (observations,) standard deviation of what is left, m
    """

    now: NDArray[np.intp]
    before: NDArray[np.intp]
    weight: FloatArray
    scale_m: FloatArray

    def __call__(self, xy_m: FloatArray) -> FloatArray:
        """(…, times, markers, 2), m, to (…, observations)."""
        flat = xy_m.reshape(*xy_m.shape[:-3], -1)
        return np.asarray(
            (flat[..., self.now] - self.weight * flat[..., self.before]) / self.scale_m
        )


def whitener(t_s: FloatArray, seen: NDArray[np.bool_], noise: Noise) -> Whitener:
    """Whitener of a trial.  `t_s` (times,), `seen` (times, markers)."""
    markers = seen.shape[1]
    now, before, gap = [], [], []
    for marker in range(markers):
        rows = np.flatnonzero(seen[:, marker])
        for axis in range(2):
            index = (rows * markers + marker) * 2 + axis
            now.append(index)
            before.append(np.concatenate([index[:1], index[:-1]]))
            gap.append(np.concatenate([[np.inf][: len(rows)], np.diff(t_s[rows])]))
    gap_s = np.concatenate(gap)
    weight = np.where(np.isfinite(gap_s), noise.correlation(np.where(gap_s < np.inf, gap_s, 1)), 0)
    return Whitener(
        now=np.concatenate(now).astype(np.intp),
        before=np.concatenate(before).astype(np.intp),
        weight=weight,
        scale_m=noise.std_m * np.sqrt(1.0 - weight**2),
    )


def motion_onset_s(motion: Motion) -> float:
    """When the hand first moves or turns, s; the end of the log if it never does.

    Speeds are taken between means over `SPEED_WINDOW_S`, so that the log's own noise (~10 µm)
    stays far below the limits; the onset is the start of the first window that exceeds one.
    """
    t_s = motion.t_s
    width = max(1, int(np.ceil(SPEED_WINDOW_S / np.median(np.diff(t_s)))))
    if len(t_s) < 2 * width:
        return float(t_s[0])
    kernel = np.full(width, 1.0 / width)
    poses = np.array([motion.x_m, motion.y_m, motion.angle_rad])
    mean = np.array([np.convolve(pose, kernel, "valid") for pose in poses])
    clock = np.convolve(t_s, kernel, "valid")
    rate = (mean[:, width:] - mean[:, :-width]) / (clock[width:] - clock[:-width])
    moving = np.hypot(rate[0], rate[1]) > STILL_SPEED_M_PER_S
    moving |= np.abs(rate[2]) > STILL_TURN_RAD_PER_S
    return float(t_s[int(np.argmax(moving))]) if moving.any() else float(t_s[-1])


def still_end_s(trial: Trial) -> float:
    """Until when nothing moves in a trial: the hand's onset, or the release if that is earlier."""
    onset_s = motion_onset_s(trial.grip)
    return onset_s if trial.release_s is None else min(onset_s, trial.release_s)


def estimate_noise(study: Study) -> Noise:
    """Noise of a study, from the frames before anything moves, all trials and markers together.

    Restricted maximum likelihood of level and AR(1) correlation; each coordinate of each trial has
    its own mean, and its own slope or parabola where the cable is still settling (chosen by BIC).
    A level stated in the study is kept and only its colour estimated.

    raises  NoiseUnknownError: no still frames and no stated level
    """
    blocks = [b for t in study.trials if (b := _still_block(t)) is not None]
    frame_s = float(np.median(np.concatenate([np.diff(t.markers.t_s) for t in study.trials])))
    if not blocks:
        if study.noise_std_m is None:
            raise NoiseUnknownError(
                f"study {study.name}: no trial has {MIN_STILL_FRAMES} frames before the hand "
                "moves, so the camera's noise is unknown; give noise_std_m in study.yaml"
            )
        return Noise(study.noise_std_m, 0.0, frame_s)
    degree = min(range(3), key=lambda d: _fit_colour(blocks, frame_s, d).bic)
    noise = _fit_colour(blocks, frame_s, degree).noise
    return noise if study.noise_std_m is None else replace(noise, std_m=study.noise_std_m)


@dataclass(frozen=True)
class _Block:
    """Still coordinates of one trial: `t_s` (times,), `z_m` (times, series), all seen."""

    t_s: FloatArray
    z_m: FloatArray


@dataclass(frozen=True)
class _Colour:
    noise: Noise
    bic: float


def _still_block(trial: Trial) -> _Block | None:
    still = trial.markers.t_s < still_end_s(trial)
    xy_m = trial.markers.xy_m[still]
    always = np.isfinite(xy_m).all(axis=(0, 2)) if len(xy_m) else np.zeros(0, bool)
    if len(xy_m) < MIN_STILL_FRAMES or not always.any():
        return None
    return _Block(trial.markers.t_s[still], xy_m[:, always].reshape(len(xy_m), -1))


def _fit_colour(blocks: Sequence[_Block], frame_s: float, degree: int) -> _Colour:
    """Best level and correlation with polynomials of a degree taken out of every series."""

    def parts(ar1: float) -> tuple[float, int, float, float]:
        square, freedom, log_det, log_fixed = 0.0, 0, 0.0, 0.0
        for block in blocks:
            gap = np.diff(block.t_s) / frame_s
            weight = np.concatenate([[0.0], ar1**gap if ar1 > 0 else np.zeros(len(gap))])
            scale = np.sqrt(1.0 - weight**2)

            def white(v: FloatArray, w: FloatArray = weight, s: FloatArray = scale) -> FloatArray:
                return np.asarray((v - w[:, None] * np.vstack([v[:1], v[:-1]])) / s[:, None])

            u = np.linspace(-1.0, 1.0, len(block.t_s))
            q, r = np.linalg.qr(white(np.vander(u, degree + 1)))
            z = white(block.z_m)
            series = z.shape[1]
            square += float(np.sum((z - q @ (q.T @ z)) ** 2))
            freedom += (len(u) - degree - 1) * series
            log_det += 2.0 * series * float(np.log(scale).sum())
            log_fixed += 2.0 * series * float(np.log(np.abs(np.diag(r))).sum())
        return square, freedom, log_det, log_fixed

    def restricted(ar1: float) -> float:
        square, freedom, log_det, log_fixed = parts(ar1)
        return freedom * float(np.log(max(square, 1e-300))) + log_det + log_fixed

    ar1 = float(optimize.minimize_scalar(restricted, bounds=(0.0, MAX_AR1), method="bounded").x)
    ar1 = min((0.0, ar1, MAX_AR1), key=restricted)
    square, freedom, log_det, _ = parts(ar1)
    count = sum(b.z_m.size for b in blocks)
    fixed = (degree + 1) * sum(b.z_m.shape[1] for b in blocks)
    bic = (
        count * float(np.log(max(square, 1e-300) / count)) + log_det + fixed * float(np.log(count))
    )
    return _Colour(Noise(float(np.sqrt(square / freedom)), ar1, frame_s), bic)
