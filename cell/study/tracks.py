"""Statistics of marker tracks: exchanged, lost, frozen or identical markers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.study.series import forward_filled, rounding_step_m, runs, span_m

#: Two have changed places if each is nearer to the other's former or predicted place than to its
#: own by this factor, and if their distance exceeds this multiple of its usual change per row,
#: noise included.
NEARER, APART = 4.0, 4.0
#: Pairs that are compared at once.
_AT_ONCE = 100_000
#: Tolerance for equal places, m; cameras are less precise.
SAME_M = 1e-7
#: Least number of rows in which a lost marker stays.
FROZEN_ROWS = 6
#: Rounding steps: largest change per row of a marker that only changes its direction.
STEPS = 3.0
#: Least number of successive identical rows that is noted, if the next step is this multiple of the
#: usual one: a cable at rest, rounded, repeats its rows too.
HELD_ROWS, HELD_JUMP = 3, 2.0


@dataclass(frozen=True)
class Exchange:
    """Two markers that are exchanged from a row to another or the end (exclusive)."""

    first: int
    second: int
    row: int
    until: int


def exchanges(xy_m: FloatArray) -> list[Exchange]:
    """Markers of a trial that change places, in the order of rows.

    A marker is compared with its last place, and with its extrapolated place.

    xy_m  (T, markers, 2), nan = not detected
    """
    detected = np.asarray(np.isfinite(xy_m).all(axis=2))
    there = forward_filled(xy_m, detected)  # nan before the first detection
    events: dict[tuple[int, int], list[int]] = {}
    for row in _exchange_candidates(there):
        before, goes_on = there[row - 1], 2.0 * there[row - 1] - there[max(row - 2, 0)]
        for pair in {*_swapped_pairs(before, there[row]), *_swapped_pairs(goes_on, there[row])}:
            if _are_distinguishable(there, *pair):
                events.setdefault(pair, []).append(row)
                there[row:, pair] = there[row:, pair[::-1]]
    listed = []
    for (first, second), rows in events.items():
        ends = [*rows[1::2], len(there)]
        listed += [Exchange(first, second, a, b) for a, b in zip(rows[::2], ends, strict=False)]
    return sorted(listed, key=lambda e: e.row)


def _exchange_candidates(there: FloatArray) -> list[int]:
    """Rows in which any two may have changed places."""
    goes_on = 2.0 * there[:-1] - np.concatenate([there[:1], there[:-2]])
    rows: list[int] = []
    together = max(1, _AT_ONCE // there.shape[1] ** 2)
    for first in range(0, len(goes_on), together):
        some = slice(first, first + together)
        now_m = there[1:][some]
        any_of = [_both_nearer(b[some], now_m).any(axis=(1, 2)) for b in (there[:-1], goes_on)]
        rows += (np.flatnonzero(any_of[0] | any_of[1]) + first + 1).tolist()
    return rows


def _swapped_pairs(before_m: FloatArray, now_m: FloatArray) -> list[tuple[int, int]]:
    both = _both_nearer(before_m[None], now_m[None])[0]
    return [(int(a), int(b)) for a, b in np.argwhere(np.triu(both, 1))]


def _both_nearer(before_m: FloatArray, now_m: FloatArray) -> NDArray[np.bool_]:
    """(rows, markers, markers) which of two, (rows, markers, 2), are at the other's place."""
    moved_m = np.linalg.norm(now_m[:, None] - before_m[:, :, None], axis=3)  # (from, to)
    own_m = np.diagonal(moved_m, axis1=1, axis2=2)
    nearer = NEARER * moved_m < own_m[:, :, None]
    return np.asarray(nearer & nearer.swapaxes(1, 2))


def _are_distinguishable(there: FloatArray, first: int, second: int) -> bool:
    """Whether the distance of two markers exceeds its usual change per row."""
    between = there[:, first] - there[:, second]
    usual_m = np.nanmedian(np.linalg.norm(np.diff(between, axis=0), axis=1))
    return bool(np.nanmedian(np.linalg.norm(between, axis=1)) > APART * usual_m)


@dataclass(frozen=True)
class Frozen:
    """First and last row in which a marker stays, and the motion of others meanwhile."""

    marker: int
    first: int
    last: int
    moved_m: float


def frozen(
    xy_m: FloatArray, hands_m: FloatArray, markers: NDArray[np.intp], least_m: float
) -> Frozen | None:
    """A marker that stays exactly in place while the cable moves; None if there is none.

    Rounded values of a marker that changes direction may stay, too; then they change by one step.

    xy_m     (T, markers, 2), nan = not detected
    hands_m  (delays, T, 2) gripper for each delay of the pictures: the cable moves later than in a
             log without delay
    markers  numbers of those that are tested
    least_m  least motion of the gripper or a further marker meanwhile
    """
    for marker in markers:
        own_m = xy_m[:, marker]
        detected = np.flatnonzero(np.isfinite(own_m).all(axis=1))
        # One coordinate alone may stay, rounded, while the cable moves along the other.
        same = np.abs(np.diff(own_m[detected], axis=0)).max(axis=1) <= SAME_M
        for a, b in runs(same):
            if b - a + 2 < FROZEN_ROWS:
                continue
            first, last = int(detected[a]), int(detected[b + 1])
            rows = slice(first, last + 1)
            others_m = [np.nan_to_num(span_m(p, 0.05)) for p in xy_m[rows].swapaxes(0, 1)]
            moved_m = float(max(*others_m, min(span_m(p[rows], 0.05) for p in hands_m)))
            steps_m = [rounding_step_m(v) for v in own_m.T]
            several_m = STEPS * min((s for s in steps_m if s), default=0.0)
            jumps = _jump_m(own_m, first, last) > several_m
            if jumps and moved_m > max(least_m, several_m):
                return Frozen(int(marker), first, last, moved_m)
    return None


def _jump_m(xy_m: FloatArray, first: int, last: int) -> float:
    """Distance of a point (T, 2) from its places before and after some rows; inf without any.

    Along one coordinate.
    """
    detected = np.flatnonzero(np.isfinite(xy_m).all(axis=1))
    if last == detected[-1]:
        return np.inf
    before = int(detected[max(int(np.searchsorted(detected, first)) - 1, 0)])
    after = int(detected[int(np.searchsorted(detected, last)) + 1])
    return float(np.abs(xy_m[[before, after]] - xy_m[[first, last]]).max())


def identical(xy_m: FloatArray) -> Iterator[tuple[int, int, NDArray[np.bool_]]]:
    """Pairs of markers (T, markers, d) with the same places in all rows (T,) that show both."""
    for first, second in combinations(range(xy_m.shape[1]), 2):
        both = np.isfinite(xy_m[:, [first, second]]).all(axis=(1, 2))
        equal = np.array_equal(xy_m[both, first], xy_m[both, second])
        if equal and np.count_nonzero(both) >= HELD_ROWS:
            yield first, second, np.asarray(both)


def repeated_rows(xy_m: FloatArray) -> tuple[int, int] | None:
    """First row and number of rows that repeat the one before in all values, then jump; or None.

    xy_m  (T, markers, 2), nan = not detected
    """
    flat_m = xy_m.reshape(len(xy_m), -1)
    both = np.isfinite(flat_m[1:]) & np.isfinite(flat_m[:-1])
    steps_m = np.where(both, np.abs(flat_m[1:] - flat_m[:-1]), 0.0).max(axis=1)
    same = (steps_m == 0.0) & both.any(axis=1)
    usual_m = float(np.median(steps_m[~same])) if not same.all() else np.inf
    for begin, end in runs(same):
        jumps = end + 1 < len(same) and steps_m[end + 1] > HELD_JUMP * usual_m
        # A cable that rests before the motion repeats its rows too, but did not move before.
        moved = begin > 0 and steps_m[begin - 1] > 0.5 * usual_m
        if jumps and moved and end - begin + 1 >= HELD_ROWS:
            return begin + 1, end - begin + 1
    return None
