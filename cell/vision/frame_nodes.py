"""One frame → the nodes of the cable, compiled: every step of it, in one call without Python."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.vision.compiling import compiled, hypot, inline
from cell.vision.discs import (
    DiscMemory,
    Marks,
    disc_memory,
    find_body,
    scale_at,
    to_pixels,
    to_plane,
)
from cell.vision.marks import NEXT_FRAME_M
from cell.vision.second_line import another_line
from cell.vision.sighting import UNSEEN, Unseen
from cell.vision.spline import at
from cell.vision.trace import DENSE, SEEN, CableAppearance, TraceMemory, trace_cable, trace_memory

_EVERY = 16  # pixel and row is looked at to say whether a picture is usable at all

_NO_JAW = UNSEEN.index(Unseen.NO_JAW)
_TWO_CABLES = UNSEEN.index(Unseen.TWO_CABLES)
_WRONG_LENGTH = UNSEEN.index(Unseen.WRONG_LENGTH)
_SATURATED = UNSEEN.index(Unseen.SATURATED)
_EMPTY = UNSEEN.index(Unseen.EMPTY)


class Appearance(NamedTuple):
    """The appearance of jaw and cable, as compiled code takes it; see `VisionOptions`."""

    marks: Marks
    cable: CableAppearance
    free_length_m: float
    length_tolerance_m: float


class FrameMemory(NamedTuple):
    """Memory that is written while a picture is looked at; a thread needs its own."""

    discs: DiscMemory
    trace: TraceMemory
    histogram: NDArray[np.int64]
    arc_length_m: FloatArray


class FrameResult(NamedTuple):
    """Why there are no nodes (place in `UNSEEN`, −1 = there are), the jaw, quality and length."""

    code: int
    x_m: float
    y_m: float
    angle_rad: float
    quality: float
    length_m: float


def frame_memory(shape: tuple[int, int], look: Appearance) -> FrameMemory:
    """Memory for pictures (H, W)."""
    return FrameMemory(
        disc_memory(shape, len(look.marks.centres_m)),
        trace_memory(float(np.hypot(*shape))),
        np.empty(256, np.int64),
        np.empty(DENSE),
    )


@compiled
def nodes_in_frame(picture, view, look, memory, near, nodes):  # type: ignore[no-untyped-def]
    """Find jaw and cable in one picture; writes the nodes.

    picture  see `Picture`
    view     see `View`
    near     place, m, and angle of the jaw in the frame before; nan = unknown
    nodes    (N, 2) are written, tip first, m; nan where unseen
    returns  a `FrameResult`
    """
    _nothing(nodes)
    code = _unusable(picture.image, memory.histogram)
    if code >= 0:
        return FrameResult(code, np.nan, np.nan, np.nan, 0.0, np.nan)
    jaw = find_body(picture.image, view, look.marks, memory.discs, near, NEXT_FRAME_M)
    if jaw.marks == 0:
        return FrameResult(_NO_JAW, np.nan, np.nan, np.nan, 0.0, np.nan)
    x, y, angle = jaw.x_m, jaw.y_m, jaw.angle_rad
    grip = to_pixels(view, x, y)
    length = look.free_length_m * scale_at(view, grip[0], grip[1])
    ahead = to_pixels(view, x - 1e-3 * np.cos(angle), y - 1e-3 * np.sin(angle))
    norm = hypot(ahead[0] - grip[0], ahead[1] - grip[1])
    outward = ((ahead[0] - grip[0]) / norm, (ahead[1] - grip[1]) / norm)
    trace = trace_cable(picture, look.cable, memory.trace, grip, outward, length)
    if trace.code != SEEN:
        return FrameResult(trace.code, x, y, angle, 0.0, np.nan)
    length_m = _in_plane(view, memory, nodes)
    off = abs(length_m - look.free_length_m) / look.length_tolerance_m
    code = -1
    if off > 1.0:
        code = _WRONG_LENGTH
    elif another_line(picture, memory.trace, grip, outward, trace.contrast, length):
        code = _TWO_CABLES
    if code >= 0:
        _nothing(nodes)
        return FrameResult(code, x, y, angle, 0.0, length_m)
    quality = trace.seen_share * min(1.0, trace.signal_to_noise / 5.0)
    quality *= np.exp(-((trace.misfit_px / 0.5) ** 2) - 0.5 * off * off)
    return FrameResult(-1, x, y, angle, quality, length_m)


@compiled
def frame_values(picture, view, look, memory, near, nodes):  # type: ignore[no-untyped-def]
    """The values of `nodes_in_frame`'s result as a plain tuple, as Python may take it.

    To hand out a named one numba runs Python; a signal that is raised there ends the process.
    """
    found = nodes_in_frame(picture, view, look, memory, near, nodes)
    return found.code, found.x_m, found.y_m, found.angle_rad, found.quality, found.length_m


@inline
def _nothing(nodes):  # type: ignore[no-untyped-def]
    for n in range(len(nodes)):
        nodes[n, 0], nodes[n, 1] = np.nan, np.nan


@compiled
def _in_plane(view, memory, nodes):  # type: ignore[no-untyped-def]
    """Nodes at equal arc length, tip first, in the plane; returns the cable's length, m."""
    dense, s = memory.trace.dense, memory.arc_length_m
    x0, y0 = 0.0, 0.0
    for k in range(DENSE):
        u, v, _, _ = at(memory.trace.pieces, k / (DENSE - 1))
        dense[k, 0], dense[k, 1] = u, v
        x, y = to_plane(view, u, v)
        s[k] = 0.0 if k == 0 else s[k - 1] + hypot(x - x0, y - y0)
        x0, y0 = x, y
    length, count = s[-1], len(nodes)
    k = 0
    for n in range(count - 1, -1, -1):
        place = length * (1.0 - n / (count - 1))
        while k < DENSE - 2 and s[k + 1] < place:
            k += 1
        share = min(max((place - s[k]) / (s[k + 1] - s[k]), 0.0), 1.0)
        ax, ay = to_plane(view, dense[k, 0], dense[k, 1])
        bx, by = to_plane(view, dense[k + 1, 0], dense[k + 1, 1])
        nodes[n, 0], nodes[n, 1] = ax + share * (bx - ax), ay + share * (by - ay)
    return length


@compiled
def _unusable(image, histogram):  # type: ignore[no-untyped-def]
    """Code of a picture so black, blank or saturated that nothing can be measured, or −1."""
    height, width = image.shape
    for level in range(256):
        histogram[level] = 0
    count = 0
    for row in range(0, height, _EVERY):
        for column in range(0, width, _EVERY):
            histogram[image[row, column]] += 1
            count += 1
    if histogram[254] + histogram[255] > 0.5 * count:
        return _SATURATED
    light, dark = _quantile(histogram, count, 0.99), _quantile(histogram, count, 0.01)
    if light < 15.0 or light - dark < 10.0:
        return _EMPTY
    return -1


@compiled
def _quantile(histogram, count, share):  # type: ignore[no-untyped-def]
    """Grey level below which a share of the pixels is, between two of them by interpolation."""
    place = share * (count - 1)
    rank = int(place)
    below, level = 0, -1
    while below <= rank:
        level += 1
        below += histogram[level]
    following = level
    if below <= rank + 1 and rank + 1 < count:
        following += 1
        while histogram[following] == 0:
            following += 1
    return level + (place - rank) * (following - level)
