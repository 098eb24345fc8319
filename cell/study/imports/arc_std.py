"""How well arc lengths are known that are guessed by a curve through the markers."""

from __future__ import annotations

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.entries import MAX_ARC_STD_FRACTION
from cell.study.imports.shape import arc_lengths, middle, resting

#: Arc lengths are proposed to so much, m.
ROUNDED_M = 1e-5
#: Values nearer to each other differ by how they are computed, m.
_SAME_M = 1e-9
#: Consecutive rows are parted into so many blocks, long enough for a tracker's slow noise.
_BLOCKS = 6
#: Nothing shows the bend between two points: 0.7 rad make a curve this share longer.
_TWO, _ONE_PIECE = 2, 0.02
#: Of three points this share of what the middle one adds is left open; of more, this share of what
#: the curve's length changes by if its ends are not bent: what was wrong on simulated cables.
_OF_MIDDLE, _OF_ENDS = 0.4, 0.5


def arc_length_stds(places_m: FloatArray, length_m: float, from_hand: bool) -> FloatArray:
    """(markers,) standard deviation of arc lengths that a curve through points shows, m.

    Noise shifts each marker by itself.  What the curve does between two points, and noise of the
    hand, is one error of all n markers; a study knows only independent ones, so it counts √n times.

    places_m   (rows, points, 2 or 3) in their order along the cable, nan = not seen
    length_m   free length of the cable
    from_hand  whether the first point is the gripping point; else the last is the cable's tip
    """
    most_m = MAX_ARC_STD_FRACTION * length_m
    lengths, added_m = _lengths_by_block(places_m)
    if len(lengths) < _TWO:
        return np.full(places_m.shape[1] - from_hand, most_m)
    arcs = lengths[:, 1:] - lengths[:, :1] if from_hand else lengths - lengths[:, -1:]
    count = arcs.shape[1]
    own = _of_mean(arcs)
    alike = np.sqrt(count) * _of_mean(arcs.mean(axis=1, keepdims=True))
    noise_m = np.maximum(own, max(float(np.sqrt(np.mean(own**2))), float(alike[0])))
    rest = resting(places_m)
    shape = middle(places_m if rest is None else rest)
    curve_m = _between_points(shape, length_m) + added_m
    rounded = (ROUNDED_M**2 + _step_m(places_m) ** 2) / 12.0
    std_m = np.sqrt(noise_m**2 + count * curve_m**2 + rounded)
    return np.array([min(float(f"{s:.2g}"), most_m) for s in std_m])


def _of_mean(values: FloatArray) -> FloatArray:
    """Standard deviation of the mean over blocks (blocks, …)."""
    return np.asarray(np.std(values, axis=0, ddof=1) / np.sqrt(len(values)))


def _lengths_by_block(places_m: FloatArray) -> tuple[FloatArray, float]:
    """(blocks, points) arc lengths by parts of the rows, and by what noise makes all longer, m."""
    rest = resting(places_m)
    if rest is not None:
        return np.array([arc_lengths(shape[None]) for shape in _shapes(rest)]), 0.0
    blocks = np.array_split(places_m, min(_BLOCKS, len(places_m)))
    lengths = np.array([arc_lengths(block) for block in blocks])
    whole, added_m = places_m[np.isfinite(places_m).all(axis=(1, 2))], 0.0
    if len(whole) > _TWO:  # each row's curve is that of noisy points
        noise_m = 1.4826 * float(np.median(np.abs(np.diff(whole, 2, axis=0)))) / np.sqrt(6.0)
        noisier = whole + np.random.default_rng(0).normal(0.0, noise_m, whole.shape)
        added_m = float(abs(arc_lengths(noisier)[-1] - arc_lengths(whole)[-1]))
    return lengths[np.isfinite(lengths).all(axis=1)], added_m


def _shapes(rest: FloatArray) -> FloatArray:
    """(blocks, points, d) medians of parts of the rows, of each point by those that show it."""
    each = [point[np.isfinite(point).all(axis=1)] for point in rest.transpose(1, 0, 2)]
    count = min(_BLOCKS, *(len(point) for point in each))
    blocks = [[np.median(b, axis=0) for b in np.array_split(point, count)] for point in each]
    return np.array(blocks).transpose(1, 0, 2)


def _between_points(shape: FloatArray, length_m: float) -> float:
    """By how much a curve through points (points, d) may be longer or shorter than the cable, m."""
    whole = float(arc_lengths(shape[None])[-1])
    if len(shape) == _TWO:
        return min(_ONE_PIECE * whole, max(length_m - whole, 0.0))
    if len(shape) == _TWO + 1:
        return _OF_MIDDLE * abs(whole - float(np.linalg.norm(shape[-1] - shape[0])))
    return _OF_ENDS * abs(whole - float(arc_lengths(shape[None], "natural")[-1]))


def _step_m(places_m: FloatArray) -> float:
    """Largest step to which a coordinate is rounded, m; so is its median, then."""
    steps_m = [0.0]
    for values in places_m.reshape(len(places_m), -1).T:
        steps = np.diff(np.unique(values[np.isfinite(values)]))
        steps_m += [float(steps[steps > _SAME_M].min())] if np.any(steps > _SAME_M) else []
    return max(steps_m)
