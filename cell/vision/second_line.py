"""Whether a second line like the cable runs near it.  Compiled; in pixels (column, row)."""

from __future__ import annotations

import numpy as np

from cell.vision.compiling import compiled, hypot, inline
from cell.vision.ridge import RidgeStart, crossings, find_start, follow
from cell.vision.trace import ARC_RAD, STEP_PX

_SHARES = (0.3, 0.5, 0.7, 0.9)  # of the cable's length, radii of the arcs
_BESIDE_PX = 8.0  # a crossing nearer to the cable is the cable itself
_APART_PX = 6.0  # a point of another line nearer to the cable does not count
_EVERY = 4  # one of so many dense points of the cable is compared with


@compiled
def another_line(picture, memory, grip, outward, contrast, length):  # type: ignore[no-untyped-def]
    """Whether a second line like the cable runs near it: long, as strong, and somewhere else.

    Arcs about the gripping point are searched for lines; what crosses them away from the cable is
    followed both ways, and counts if that goes on for a fifth of the cable's length.
    memory    see `TraceMemory`; `dense` holds the cable
    contrast  typical of the cable, grey levels; length: expected, px
    """
    middle = np.arctan2(outward[1], outward[0])
    crossing = memory.crossing
    for share in _SHARES:
        arc = (grip[0], grip[1], share * length, middle, ARC_RAD)
        count = crossings(picture, arc, memory.scratch, crossing)
        for n in range(count):
            u, v, strength = crossing[n, 0], crossing[n, 1], crossing[n, 2]
            if strength <= 0.5 * contrast or _distance(u, v, memory.dense) < _BESIDE_PX:
                continue
            distance = hypot(u - grip[0], v - grip[1])
            ru, rv = (u - grip[0]) / distance, (v - grip[1]) / distance
            total = _apart(picture, memory, (u, v), (ru, rv), contrast, length)
            total += _apart(picture, memory, (u, v), (-ru, -rv), contrast, length)
            if total > 0.2 * length:
                return True
    return False


@compiled
def _apart(picture, memory, place, heading, contrast, length):  # type: ignore[no-untyped-def]
    """How far, in pixels, a line goes on from a place away from the cable."""
    start = find_start(picture, place, heading, 2.0, 1.0, memory.scratch)
    if start.contrast < 0.5 * contrast:
        return 0.0
    line = memory.line[: min(int(0.3 * length / STEP_PX) + 2, len(memory.line))]
    start = RidgeStart(start.u, start.v, start.du, start.dv, contrast)
    count, _ = follow(picture, start, 0.4, STEP_PX, 10.0, line, memory.scratch)
    if count < 2:
        return 0.0
    apart = 0
    for n in range(count):
        apart += _distance(line[n, 0], line[n, 1], memory.dense) > _APART_PX
    return STEP_PX * apart


@inline
def _distance(u, v, dense):  # type: ignore[no-untyped-def]
    """Distance of a place to the nearest dense point."""
    nearest = np.inf
    for k in range(0, len(dense), _EVERY):
        du, dv = u - dense[k, 0], v - dense[k, 1]
        nearest = min(nearest, du * du + dv * dv)
    return np.sqrt(nearest)
