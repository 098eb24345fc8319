"""From where points are to where, and when, a camera sees them: the effects on the camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cell.cable.effects.base import FloatArray
from cell.cable.effects.compiled import cable_data, parameters
from cell.cable.model import CableModel

#: A camera's clock may be ahead by this much, s.
LOOK_AHEAD_S = 0.12

#: Steps between the times at which a scene is kept for interpolation.
_EVERY = 2
#: A point's time depends on its place, which depends on its time: shutter speeds are far below
#: the picture's height per millisecond, so this many rounds reach rounding error.
_ROUNDS = 4


def shifts_time(models: Sequence[CableModel]) -> bool:
    """Whether any model's camera shows points of other times than its pictures'."""
    return any(a.effect.camera_time is not None for m in models for a in m.effects)


def scene_times(
    model: CableModel, times_s: FloatArray, begin_s: float, end_s: float, step_s: float
) -> FloatArray:
    """Times at which positions are needed: the pictures', or a fine grid around them."""
    if not shifts_time([model]):
        return times_s
    spacing = _EVERY * step_s
    first = max(begin_s, float(times_s[0]) - LOOK_AHEAD_S - 2.0 * spacing)
    count = int((end_s - first) / spacing + 1e-9) + 1
    return np.asarray(first + spacing * np.arange(count))


def seen(
    models: Sequence[CableModel], times_s: FloatArray, scene_s: FloatArray, xy: FloatArray
) -> FloatArray:
    """What the cameras show.

    models   (lanes,) with the same effects
    times_s  (times,) of the pictures; scene_s, xy (lanes, scene, markers, 2) of `scene_times`
    returns  (lanes, times, markers, 2)
    """
    if shifts_time(models[:1]):
        xy = np.stack([_shown(m, times_s, scene_s, p) for m, p in zip(models, xy, strict=True)])
    for k, model in enumerate(models):
        for active in model.effects:
            if active.effect.camera_points is not None:
                xy[k] = active.effect.camera_points(cable_data(model), xy[k], parameters(active))
    return xy


def _shown(
    model: CableModel, times_s: FloatArray, scene_s: FloatArray, xy: FloatArray
) -> FloatArray:
    """(times, markers, 2) positions at each point's own time."""
    picture = np.repeat(times_s[:, None], xy.shape[1], axis=1)
    points = _at(scene_s, xy, picture)
    for _ in range(_ROUNDS):
        shift = np.zeros_like(picture)
        for active in model.effects:
            hook = active.effect.camera_time
            if hook is not None:
                shift += hook(cable_data(model), picture, points, parameters(active)) - picture
        points = _at(scene_s, xy, picture + shift)
    return points


def _at(scene_s: FloatArray, xy: FloatArray, t: FloatArray) -> FloatArray:
    """Cubic interpolation of each marker at its own times (times, markers); held outside.

    nan at a time that is not finite, as a point has that could not be simulated.
    """
    spacing = scene_s[1] - scene_s[0]
    place = np.clip((t - scene_s[0]) / spacing, 0.0, scene_s.size - 1.0)
    whole = np.where(np.isfinite(place), place, 0.0).astype(np.int64)
    k: NDArray[np.int64] = np.minimum(whole, scene_s.size - 2)
    u = (place - k)[..., None]
    marker = np.arange(xy.shape[1])

    def value(j: NDArray[np.int64]) -> FloatArray:
        return np.asarray(xy[np.clip(j, 0, scene_s.size - 1), marker])

    p0, p1, p2, p3 = value(k - 1), value(k), value(k + 1), value(k + 2)
    m1, m2 = 0.5 * (p2 - p0), 0.5 * (p3 - p1)
    return np.asarray(
        p1 + u * (m1 + u * (3.0 * (p2 - p1) - 2.0 * m1 - m2 + u * (2.0 * (p1 - p2) + m1 + m2)))
    )
