"""Which share of each pixel polygons cover, by their edges and a running sum along every row.

Compiled.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def gather(corners, levels, hides, added, hidden):  # type: ignore[no-untyped-def]
    """Add the edges of (P, V, 2) polygons; pixel (row, column) covers [column, column + 1]."""
    rows, columns = added.shape[0], added.shape[1] - 2
    for p in range(corners.shape[0]):
        count = corners.shape[1]
        area = 0.0
        for v in range(count):
            w = (v + 1) % count
            area += corners[p, v, 0] * corners[p, w, 1] - corners[p, w, 0] * corners[p, v, 1]
        turn = 1.0 if area < 0.0 else -1.0
        for v in range(count):
            w = (v + 1) % count
            x0, y0 = corners[p, v, 0], corners[p, v, 1]
            x1, y1 = corners[p, w, 0], corners[p, w, 1]
            if y0 == y1:
                continue
            sign = turn
            if y0 > y1:
                x0, y0, x1, y1 = x1, y1, x0, y0
                sign = -turn
            slope = (x1 - x0) / (y1 - y0)
            for row in range(max(0, int(np.floor(y0))), min(rows, int(np.ceil(y1)))):
                top, bottom = max(y0, float(row)), min(y1, row + 1.0)
                a = x0 + slope * (top - y0)
                b = x0 + slope * (bottom - y0)
                a = min(max(a, 0.0), float(columns))
                b = min(max(b, 0.0), float(columns))
                if a > b:
                    a, b = b, a
                _edge(added, row, a, b, sign * (bottom - top) * levels[p])
                _edge(hidden, row, a, b, sign * (bottom - top) * hides[p])


@njit(cache=True, inline="always")
def _edge(buffer, row, a, b, weight):  # type: ignore[no-untyped-def]
    """Share of each pixel to the right of an edge that runs from column a to b within a row."""
    first, last = int(a), int(b)
    if first == last:
        middle = 0.5 * (a + b) - first
        buffer[row, first] += weight * (1.0 - middle)
        buffer[row, first + 1] += weight * middle
        return
    per_column = weight / (b - a)
    before = 0.0  # covered so far, up to and including the pixel before
    for column in range(first, last + 1):
        left, right = max(a, float(column)), min(b, column + 1.0)
        # to the right of the edge within this pixel, plus all that crossed before it
        crossed = per_column * (right - left)
        covered = crossed * (column + 1.0 - 0.5 * (left + right))
        start = per_column * (left - a)
        buffer[row, column] += start + covered - before
        before = start + covered
    buffer[row, last + 1] += weight - before


@njit(cache=True)
def running_sum(buffer):  # type: ignore[no-untyped-def]
    """Sum along every row, in place."""
    for row in range(buffer.shape[0]):
        total = np.float64(0.0)
        for column in range(buffer.shape[1]):
            total += buffer[row, column]
            buffer[row, column] = total


@njit(cache=True)
def lay_over(light, added, hidden):  # type: ignore[no-untyped-def]
    """Take from light (rows, columns) the share that is hidden, and add to it, in place."""
    one = np.float32(1.0)
    for row in range(light.shape[0]):
        for column in range(light.shape[1]):
            light[row, column] *= one - min(hidden[row, column], one)
            light[row, column] += added[row, column]
