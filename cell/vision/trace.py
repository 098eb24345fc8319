"""The held cable in one picture: followed from the gripping point, its tip found, its curve fitted.

Everything here is in pixels (column, row); `detect` puts it into the cell's plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from cell.vision.curve import Curve, arc_lengths, basis_matrix, chord_parameters, fit_curve
from cell.vision.ridge import End, Picture, crossings, find_start, follow, offsets_along
from cell.vision.sighting import Unseen

FloatArray = NDArray[np.float64]

_INTERVALS = 7  # of the cable's curve: room for the fourth bending mode
_PENALTY = 1e-10  # keeps the ends of the curve from waving
_SAMPLES = 400  # along the cable, at which offsets are measured
_START_PX = 4.0  # beside the jaw a profile sees the jaw too
_END_PX = 2.0  # beside the tip it sees the tip's blur
_LEAST_SEEN = 0.7  # of the cable's length; less would be guessing


@dataclass(frozen=True)
class Trace:
    """The cable in pixels: its curve from the gripping point to the tip, and how sure it is.

    contrast         typical contrast, grey levels
    seen_share       share of its length along which it was seen
    misfit_px        rms distance of what was seen from the curve
    signal_to_noise  amplitude of the line's profile over what the profile's fit leaves
    """

    curve: Curve
    contrast: float
    seen_share: float
    misfit_px: float
    signal_to_noise: float


def trace_cable(
    picture: Picture,
    grip_px: FloatArray,
    outward: FloatArray,
    *,
    length_px: float,
    min_contrast: float,
    width_px: float,
) -> Trace | Unseen:
    """Trace of the cable that leaves the gripping point (2,) about along `outward` (2,).

    length_px     expected length; the cable is followed for 1.3 times that
    min_contrast  at the start, grey levels
    width_px      standard deviation of the cable's profile
    returns       the trace, or why there is none: NO_CABLE (also when too little of it is seen),
                  LEAVES_PICTURE
    """
    height, width = picture.image.shape
    if not (2.0 < grip_px[0] < width - 3.0 and 2.0 < grip_px[1] < height - 3.0):
        return Unseen.LEAVES_PICTURE
    start, heading, contrast = find_start(picture, grip_px, outward, reach_px=3.0)
    if not contrast >= min_contrast:
        return Unseen.NO_CABLE
    points, contrasts, end = follow(
        picture,
        start + 3.0 * heading,
        heading,
        contrast=contrast,
        seen_share=0.4,
        step_px=2.0,
        gap_px=0.03 * length_px,
        longest_px=1.3 * length_px,
    )
    if end is End.LEFT_PICTURE:
        return Unseen.LEAVES_PICTURE
    if len(points) < 20:
        return Unseen.NO_CABLE
    line = np.vstack([start, points])
    u = chord_parameters(line)
    weights = np.ones(len(line))
    weights[0] = 0.1
    curve = fit_curve(u, line, weights, _INTERVALS, _PENALTY)
    tip = _tip(picture, curve, width_px)
    if tip is None:
        return Unseen.LEAVES_PICTURE
    trace = _refined(picture, curve, tip, grip_px, width_px, float(np.median(contrasts)))
    return Unseen.NO_CABLE if trace is None else trace


def another_line(
    picture: Picture,
    grip_px: FloatArray,
    outward: FloatArray,
    cable_px: FloatArray,
    contrast: float,
    length_px: float,
) -> bool:
    """Whether a second line like the cable runs near it: long, as strong, and somewhere else.

    Arcs about the gripping point are searched for lines; what crosses them away from the cable
    (M, 2) is followed both ways, and counts if that goes on for a fifth of the cable's length.
    """
    middle = float(np.arctan2(outward[1], outward[0]))
    for share in (0.3, 0.5, 0.7, 0.9):
        points, contrasts = crossings(picture, grip_px, share * length_px, middle, 1.75)
        strong = contrasts > 0.5 * contrast
        for point in points[strong]:
            if _distance(point[None], cable_px)[0] < 8.0:
                continue
            radial = (point - grip_px) / np.linalg.norm(point - grip_px)
            total = 0.0
            for heading in (radial, -radial):
                begin, along, strength = find_start(picture, point, heading, 2.0, 1.0)
                if strength < 0.5 * contrast:
                    continue
                line, _, _ = follow(
                    picture,
                    begin,
                    along,
                    contrast=contrast,
                    seen_share=0.4,
                    step_px=2.0,
                    gap_px=10.0,
                    longest_px=0.3 * length_px,
                )
                if len(line) > 1:
                    apart = line[_distance(line, cable_px) > 6.0]
                    total += 2.0 * len(apart)
            if total > 0.2 * length_px:
                return True
    return False


def _distance(points: FloatArray, line: FloatArray) -> FloatArray:
    """(N,) distance of (N, 2) points to the nearest of (M, 2) dense samples."""
    d = points[:, None, :] - line[None, ::4, :]
    nearest: FloatArray = np.sqrt(np.min(np.sum(d * d, axis=2), axis=1))
    return nearest


def _tip(picture: Picture, curve: Curve, width_px: float) -> float | None:
    """Parameter at which the line ends: where its amplitude falls to half, to a part of a pixel.

    Least squares of amplitude ≈ full · Φ((end − along) / blur), which blur does not move.
    """
    speed = float(np.linalg.norm(curve.at(np.array([0.97]), 1)[0]))
    along = np.arange(-50.0, 14.0)
    # beyond the last few points, which may have strayed, the line goes on straight
    bent = np.minimum(along, -6.0)
    points, normals = curve.at(1.0 + bent / speed), curve.normals(1.0 + bent / speed)
    tangents = np.stack([normals[:, 1], -normals[:, 0]], axis=1)
    points = points + (along - bent)[:, None] * tangents
    _, amplitude, _ = offsets_along(picture, points, normals, 1.2 * width_px)
    inside = np.isfinite(amplitude)
    along, amplitude = along[inside], amplitude[inside]
    if len(along) < 40:
        return None
    full = max(float(np.median(amplitude[along < -16.0])), 1e-6)
    share = amplitude / full
    smooth = np.convolve(np.pad(share, 1, mode="edge"), np.full(3, 1.0 / 3.0), mode="valid")
    gone = np.flatnonzero((smooth[:-2] < 0.5) & (smooth[1:-1] < 0.5) & (smooth[2:] < 0.5))
    gone = gone[along[gone] > -40.0]
    if not len(gone):
        return 1.0 + float(along[-1]) / speed if np.all(inside) else None
    end = float(along[gone[0]])
    for _ in range(5):
        z = (end - along) / width_px
        density = np.exp(-0.5 * z * z) / (np.sqrt(2.0 * np.pi) * width_px)
        end += float(np.sum((share - ndtr(z)) * density) / np.sum(density**2))
        end = float(np.clip(end, along[0], along[-1]))
    return 1.0 + end / speed


def _refined(
    picture: Picture,
    curve: Curve,
    tip: float,
    grip_px: FloatArray,
    width_px: float,
    contrast: float,
) -> Trace | None:
    """The curve again, from offsets across it, sampled at equal arc length from grip to tip."""
    samples, basis = _samples()
    last = tip
    for _ in range(2):
        velocity = curve.at(np.zeros(1), 1)[0]
        first = float((grip_px - curve.at(np.zeros(1))[0]) @ velocity / (velocity @ velocity))
        fine = np.linspace(first, last, 2 * _SAMPLES)
        s = arc_lengths(curve.at(fine))
        u = np.interp(samples * s[-1], s, fine)
        points, normals = curve.at(u), curve.normals(u)
        offsets, amplitudes, noise = offsets_along(picture, points, normals, width_px)
        away = samples * s[-1]
        clear = (away > _START_PX) & (s[-1] - away > _END_PX)
        usable = np.isfinite(offsets) & clear
        if not usable.sum() > _LEAST_SEEN * clear.sum():
            return None
        weights = np.where(usable, 1.0, 0.0)
        moved = points + np.where(usable, offsets, 0.0)[:, None] * normals
        curve = fit_curve(samples, moved, weights, _INTERVALS, _PENALTY, basis=basis)
        last = 1.0
    left = np.sum((moved - basis @ curve.coefficients) * normals, axis=1)[usable]
    return Trace(
        curve,
        contrast,
        float(usable[clear].mean()),
        float(np.sqrt(np.mean(left**2))),
        float(np.median(amplitudes[usable]) / max(np.median(noise[usable]), 0.1)),
    )


@lru_cache(maxsize=1)
def _samples() -> tuple[FloatArray, FloatArray]:
    """Where along the cable offsets are measured, 0 … 1, and the splines there."""
    samples = np.linspace(0.0, 1.0, _SAMPLES)
    return samples, basis_matrix(_INTERVALS, samples)
