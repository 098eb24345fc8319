"""Rows in which a point was not seen, told by a value that a program writes in its place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.study.imports.shape import FEWEST_REST

Flags = NDArray[np.bool_]

#: A point that is lost jumps by so many of the longest steps that it makes otherwise, of which so
#: many may be wrong samples.
_JUMP, _WRONG = 3.0, 2
#: Where a point never comes nearer to a value than this share of its own way, the value is none of
#: its places.
_NEVER_NEAR = 0.5


def means_lost(value: float, raw: FloatArray) -> bool:
    """Whether a point (rows, d) is not seen where all its coordinates are a value.

    A place that is passed, or at which a point rests before or after its motion, is no such.
    """
    there = np.all(raw == value, axis=1)
    rest = raw[~there & np.isfinite(raw).all(axis=1)]
    if not there.any() or len(rest) < FEWEST_REST:
        return False
    span = np.ptp(rest, axis=0).max()
    if np.linalg.norm(rest - value, axis=1).min() > _NEVER_NEAR * span:
        return True
    seen = np.flatnonzero(np.isfinite(raw).all(axis=1))
    both_sides = not there[seen[0]] and not there[seen[-1]]
    return bool(both_sides and _jumps(raw, value, there)[there].all())


def lost_rows(raw: FloatArray, values: Sequence[float], of_hand: bool) -> Flags:
    """(rows,) of a point (rows, d) that are one of the values in all coordinates.

    of_hand  a hand may rest at a value that means that a marker was lost, such as 0: of it only
             those rows count to which it jumps and from which it jumps back
    """
    lost = np.zeros(len(raw), dtype=bool)
    for value in values:
        there = np.all(raw == value, axis=1)
        lost |= _jumps(raw, value, there) if of_hand else there
    return lost


def _jumps(raw: FloatArray, value: float, there: Flags) -> Flags:
    """Those of the rows between which and the rows beside them a point jumps."""
    known = np.flatnonzero(~there & np.isfinite(raw).all(axis=1))
    if not there.any() or not len(known):
        return np.zeros(len(raw), dtype=bool)
    steps = np.linalg.norm(np.diff(raw[known], axis=0), axis=1)[np.diff(known) == 1]
    usual = float(np.sort(steps)[max(0, len(steps) - 1 - _WRONG)]) if len(steps) else 0.0
    away = np.linalg.norm(raw - value, axis=1)
    after = np.searchsorted(known, np.arange(len(raw)))
    beside = np.full((2, len(raw)), np.inf)
    beside[0, after > 0] = away[known[after[after > 0] - 1]]
    beside[1, after < len(known)] = away[known[after[after < len(known)]]]
    return np.asarray(there & (beside.min(axis=0) > _JUMP * usual))
