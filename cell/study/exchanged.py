"""Markers that a tracker has exchanged: from one row to the next each is where the other was."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: Two have changed places if each is nearer to where the other was than to where it was itself by
#: this factor, and if they were farther apart than this many times what they usually move beside
#: one another within a row, noise included.
NEARER, APART = 4.0, 4.0


@dataclass(frozen=True)
class Exchange:
    """Two markers that are exchanged from a row on, until another or the end (exclusive)."""

    first: int
    second: int
    row: int
    until: int


def exchanges(xy_m: FloatArray) -> list[Exchange]:
    """Markers of a trial that change places, in the order of rows.

    xy_m  (T, markers, 2), nan = not seen: a marker is compared with where it was seen last
    """
    there = _last_seen(xy_m)
    events: dict[tuple[int, int], list[int]] = {}
    for row in range(1, len(there)):
        for pair in _changed(there[row - 1], there[row]):
            if _apart(there, *pair):
                events.setdefault(pair, []).append(row)
    found = []
    for (first, second), rows in events.items():
        ends = [*rows[1::2], len(there)]
        found += [Exchange(first, second, a, b) for a, b in zip(rows[::2], ends, strict=False)]
    return sorted(found, key=lambda e: e.row)


def _last_seen(xy_m: FloatArray) -> FloatArray:
    """(T, markers, 2) where each was seen last; nan before it is seen at all."""
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(xy_m).all(axis=2))
    rows = np.arange(len(xy_m))[:, None]
    last = np.maximum.accumulate(np.where(seen, rows, 0), axis=0)
    return np.asarray(xy_m[last, np.arange(xy_m.shape[1])])


def _changed(before_m: FloatArray, now_m: FloatArray) -> list[tuple[int, int]]:
    """Pairs of markers (markers, 2) that have changed places."""
    moved_m = np.linalg.norm(now_m[None] - before_m[:, None], axis=2)  # (from, to)
    own = np.diag(moved_m)
    nearer = NEARER * moved_m < own[:, None]
    both = nearer & nearer.T
    return [(int(a), int(b)) for a, b in np.argwhere(np.triu(both, 1))]


def _apart(there: FloatArray, first: int, second: int) -> bool:
    """Whether two markers are told apart by more than they move beside one another."""
    between = there[:, first] - there[:, second]
    usual_m = np.nanmedian(np.linalg.norm(np.diff(between, axis=0), axis=1))
    return bool(np.nanmedian(np.linalg.norm(between, axis=1)) > APART * usual_m)
