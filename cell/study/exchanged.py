"""Markers that a tracker has exchanged: from one row to the next each is where the other was."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray

#: Two have changed places if each is nearer to where the other was, or was going, than to its own
#: by this factor, and if they were farther apart than this many times what they usually move beside
#: one another within a row, noise included.
NEARER, APART = 4.0, 4.0
#: Pairs that are compared at once.
_AT_ONCE = 100_000


@dataclass(frozen=True)
class Exchange:
    """Two markers that are exchanged from a row on, until another or the end (exclusive)."""

    first: int
    second: int
    row: int
    until: int


def exchanges(xy_m: FloatArray) -> list[Exchange]:
    """Markers of a trial that change places, in the order of rows.

    A marker is compared with where it was seen last, and with where it was going.

    xy_m  (T, markers, 2), nan = not seen
    """
    there = _last_seen(xy_m)
    events: dict[tuple[int, int], list[int]] = {}
    for row in _worth_a_look(there):
        before, goes_on = there[row - 1], 2.0 * there[row - 1] - there[max(row - 2, 0)]
        for pair in {*_changed(before, there[row]), *_changed(goes_on, there[row])}:
            if _apart(there, *pair):
                events.setdefault(pair, []).append(row)
                there[row:, pair] = there[row:, pair[::-1]]
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
    return np.array(xy_m[last, np.arange(xy_m.shape[1])])


def _worth_a_look(there: FloatArray) -> list[int]:
    """Rows in which any two may have changed places."""
    goes_on = 2.0 * there[:-1] - np.concatenate([there[:1], there[:-2]])
    found: list[int] = []
    together = max(1, _AT_ONCE // there.shape[1] ** 2)
    for first in range(0, len(goes_on), together):
        some = slice(first, first + together)
        now_m = there[1:][some]
        any_of = [_both_nearer(b[some], now_m).any(axis=(1, 2)) for b in (there[:-1], goes_on)]
        found += (np.flatnonzero(any_of[0] | any_of[1]) + first + 1).tolist()
    return found


def _changed(before_m: FloatArray, now_m: FloatArray) -> list[tuple[int, int]]:
    """Pairs of markers (markers, 2) that have changed places."""
    both = _both_nearer(before_m[None], now_m[None])[0]
    return [(int(a), int(b)) for a, b in np.argwhere(np.triu(both, 1))]


def _both_nearer(before_m: FloatArray, now_m: FloatArray) -> NDArray[np.bool_]:
    """(rows, markers, markers) which of two, (rows, markers, 2), are where the other was."""
    moved_m = np.linalg.norm(now_m[:, None] - before_m[:, :, None], axis=3)  # (from, to)
    own_m = np.diagonal(moved_m, axis1=1, axis2=2)
    nearer = NEARER * moved_m < own_m[:, :, None]
    return np.asarray(nearer & nearer.swapaxes(1, 2))


def _apart(there: FloatArray, first: int, second: int) -> bool:
    """Whether two markers are told apart by more than they move beside one another."""
    between = there[:, first] - there[:, second]
    usual_m = np.nanmedian(np.linalg.norm(np.diff(between, axis=0), axis=1))
    return bool(np.nanmedian(np.linalg.norm(between, axis=1)) > APART * usual_m)
