"""The effects on the camera: from true marker positions to the positions that the image shows."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.compiling import compiled
from cell.cable.effects.compiled import cable_data, parameters
from cell.cable.model import CableModel

#: A camera's clock may be ahead by this much, s.
LOOK_AHEAD_S = 0.12

#: Steps between the times at which a scene is stored for interpolation, and largest interval, s,
#: where steps are long.
EVERY, _LONGEST_S = 2, 2e-3
#: A point's time depends on its place, which depends on its time: shutter speeds are far below
#: the picture's height per millisecond, so this many rounds reach rounding error.
_ROUNDS = 4
#: The past of a moving cable is extrapolated from positions at this interval, s.
_PAST_S = 4e-3


def shifts_time(models: Sequence[CableModel]) -> bool:
    """Whether a model has an effect on the camera's time, such as latency."""
    return any(a.effect.camera_time is not None for m in models for a in m.effects)


def earlier_steps(models: Sequence[CableModel], step_s: float) -> int:
    """Number of steps before an image at which its scene may begin; a multiple of the spacing.

    The clock's `LOOK_AHEAD_S`, two spacings that `scene_times` adds, and one for rounding.
    """
    if not shifts_time(models):
        return 0
    return EVERY * (math.ceil(LOOK_AHEAD_S / (EVERY * step_s)) + 3)


def scene_times(
    model: CableModel, times_s: FloatArray, begin_s: float, end_s: float, step_s: float
) -> FloatArray:
    """Times at which marker positions are needed: the images', or a fine grid around them."""
    if not shifts_time([model]):
        return times_s
    spacing = min(EVERY * step_s, _LONGEST_S)
    # Counted from the beginning: the grid must not depend on which lanes share a block, or the
    # interpolation error would differ between lanes, and spoil finite differences between them.
    before = (float(times_s[0]) - LOOK_AHEAD_S - begin_s) / spacing - 2.0
    first = begin_s + spacing * max(0, int(before))
    count = int((end_s - first) / spacing + 1e-9) + 1
    return np.asarray(first + spacing * np.arange(count))


def image_positions(
    model: CableModel,
    times_s: FloatArray,
    scene_s: FloatArray,
    xy: FloatArray,
    *,
    in_motion: bool = False,
) -> FloatArray:
    """(times, markers, 2) marker positions as the camera shows them.

    times_s      (times,) of the pictures
    scene_s, xy  (scene,) of `scene_times`, and (scene, markers, 2) where the points are then
    in_motion    the cable moves before the scene begins too, not at rest until then
    """
    if shifts_time([model]):
        xy = _shown(model, times_s, scene_s, xy, in_motion)
    for active in model.effects:
        if active.effect.camera_points is not None:
            xy = active.effect.camera_points(cable_data(model), xy, parameters(active))
    return xy


def _shown(
    model: CableModel,
    times_s: FloatArray,
    scene_s: FloatArray,
    xy: FloatArray,
    in_motion: bool,
) -> FloatArray:
    """(times, markers, 2) positions at each point's own time."""
    picture = np.repeat(times_s[:, None], xy.shape[1], axis=1)
    points, before = _at(scene_s, xy, picture), np.zeros_like(picture)
    for _ in range(_ROUNDS):
        shift = np.zeros_like(picture)
        for active in model.effects:
            hook = active.effect.camera_time
            if hook is not None:
                shift += hook(cable_data(model), picture, points, parameters(active)) - picture
        if np.array_equal(shift, before):
            break
        points, before = _at(scene_s, xy, picture + shift), shift
        if in_motion:
            early = (picture + shift < scene_s[0])[..., None]
            points = np.where(early, _before(scene_s, xy, picture + shift), points)
    return points


def _before(scene_s: FloatArray, xy: FloatArray, t: FloatArray) -> FloatArray:
    """(times, markers, 2) positions a little before the scene begins, extrapolated by parabolas.

    nan where a simulation has diverged.
    """
    apart = max(1, min(round(_PAST_S / (scene_s[1] - scene_s[0])), (len(scene_s) - 1) // 2))
    u = ((t - scene_s[0]) / (scene_s[apart] - scene_s[0]))[..., None]
    first, second, third = xy[0], xy[apart], xy[2 * apart]
    with np.errstate(over="ignore", invalid="ignore"):
        bend = third - 2.0 * second + first
        points = np.asarray(first + u * (second - first) + 0.5 * u * (u - 1.0) * bend)
    return np.where(np.isfinite(points), points, np.nan)


@compiled
def _at(scene_s: FloatArray, xy: FloatArray, t: FloatArray) -> FloatArray:
    """Cubic interpolation of each marker at its own times (times, markers); held outside.

    nan at a time that is nan, as a point has that could not be simulated.
    """
    spacing = scene_s[1] - scene_s[0]
    last = scene_s.size - 1
    out = np.empty((t.shape[0], t.shape[1], 2))
    for i in range(t.shape[0]):
        for m in range(t.shape[1]):
            place = (t[i, m] - scene_s[0]) / spacing
            if math.isnan(place):
                out[i, m, :] = np.nan
                continue
            place = min(max(place, 0.0), float(last))
            k = min(int(place), last - 1)
            u = place - k
            for a in range(2):
                p0, p1 = xy[max(k - 1, 0), m, a], xy[k, m, a]
                p2, p3 = xy[k + 1, m, a], xy[min(k + 2, last), m, a]
                m1, m2 = 0.5 * (p2 - p0), 0.5 * (p3 - p1)
                cubic = 2.0 * (p1 - p2) + m1 + m2
                out[i, m, a] = p1 + u * (m1 + u * (3.0 * (p2 - p1) - 2.0 * m1 - m2 + u * cubic))
    return out
