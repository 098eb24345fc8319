"""A marker that a program has lost, and whose last place, or 0, it went on to write."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.data import Trial

#: Places are the same within this; cameras measure less well, m.
SAME_M = 1e-7
#: It stays in so many rows, of the outer part of the cable, while the hand or another marker moves
#: by this share of the free length: a cable that is held at its clamp moves there by 1 % of it.
ROWS, OUTER, MOVES = 6, 0.3, 0.1
#: Steps of rounded values, of which one that only turns goes no more from row to row.
STEPS = 3.0


@dataclass(frozen=True)
class Frozen:
    """The rows, first and last, in which a marker stays, and by how much others move meanwhile."""

    marker: int
    first: int
    last: int
    moved_m: float


def frozen(trial: Trial, arc_length_m: FloatArray, free_length_m: float) -> Frozen | None:
    """A marker that stays exactly in place while the cable moves; None if there is none.

    Rounded values of a marker that changes direction may stay, too; then they go on by one step.
    arc_length_m  (markers,) from the gripping point, as in `trial.markers`
    """
    t_s, xy_m = trial.markers.t_s, trial.markers.xy_m
    grip = trial.grip
    hand_m = np.column_stack([np.interp(t_s, grip.t_s, v) for v in (grip.x_m, grip.y_m)])
    points_m = np.concatenate([xy_m, hand_m[:, None]], axis=1)
    for marker in np.flatnonzero(arc_length_m >= OUTER * free_length_m):
        for first, last in _stays(xy_m[:, marker]):
            rows = points_m[first : last + 1]
            moved_m = max(_reach_m(rows[:, other]) for other in range(rows.shape[1]))
            several_m = STEPS * _step_m(xy_m[:, marker])
            jumps = _jump_m(xy_m[:, marker], first, last) > several_m
            if jumps and moved_m > max(MOVES * free_length_m, several_m):
                return Frozen(int(marker), first, last, moved_m)
    return None


def _stays(xy_m: FloatArray) -> list[tuple[int, int]]:
    """First and last row of runs of a point (T, 2) in which it stays; rows without it are none.

    One coordinate alone may stay, rounded, while the cable moves along the other.
    """
    seen = np.flatnonzero(np.isfinite(xy_m).all(axis=1))
    steps_m = np.abs(np.diff(xy_m[seen], axis=0))
    same = np.concatenate([[False], steps_m.max(axis=1) <= SAME_M, [False]])
    edges = np.flatnonzero(np.diff(same.astype(int)))
    runs = zip(edges[::2], edges[1::2], strict=True)
    return [(int(seen[a]), int(seen[b])) for a, b in runs if b - a + 1 >= ROWS]


def _step_m(xy_m: FloatArray) -> float:
    """Smallest difference of two values of a point's coordinates (T, 2): their step, if rounded."""
    steps = [np.diff(np.unique(v[np.isfinite(v)])) for v in xy_m.T]
    return float(min((s.min() for s in steps if s.size), default=0.0))


def _jump_m(xy_m: FloatArray, first: int, last: int) -> float:
    """How far a point (T, 2) comes from before some rows, or goes after them; inf if it never does.

    Along one coordinate.
    """
    seen = np.flatnonzero(np.isfinite(xy_m).all(axis=1))
    if last == seen[-1]:
        return np.inf
    before = int(seen[max(int(np.searchsorted(seen, first)) - 1, 0)])
    after = int(seen[int(np.searchsorted(seen, last)) + 1])
    return float(np.abs(xy_m[[before, after]] - xy_m[[first, last]]).max())


def _reach_m(xy_m: FloatArray) -> float:
    """How far apart the middle 90 % of places (T, 2) are: single wrong ones do not count."""
    good = xy_m[:, np.isfinite(xy_m).any(axis=0)]
    if not good.size:
        return 0.0
    low, high = np.nanquantile(good, [0.05, 0.95], axis=0)
    return float(np.linalg.norm(high - low))
