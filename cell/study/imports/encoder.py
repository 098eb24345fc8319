"""A hand on an arm that turns about an axle: its place and turn by the axle's encoder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture
from cell.study.imports.hand_section import TurnsSection

#: Numbers are counts if they are whole multiples of one step, within this share of it.
_WHOLE = 1e-3
#: Whole numbers up to which double precision tells all of them apart.
_MOST = 2.0**53


def count_of(values: FloatArray) -> float:
    """The step in whole numbers of which all values (rows,) are apart; 0 = there is none."""
    different = np.unique(values[np.isfinite(values)])
    if len(different) < 3:
        return 0.0
    steps = np.diff(different)
    if np.all(different == np.round(different)) and np.abs(different).max() < _MOST:
        return float(np.gcd.reduce(steps.astype(np.int64)))
    count = float(steps.min())
    whole = np.abs(steps / count - np.round(steps / count)) < _WHOLE
    return count if whole.all() and count > 1e-9 * float(np.abs(different).max()) else 0.0


@dataclass(frozen=True, eq=False)
class Turn:
    """Turn of an arm: 0 = it points to the left, positive = pointing down.

    angle_rad  (rows,) nan = unknown
    count_rad  of one count; 0 = the numbers are no counts
    moves      rows that show it leave its first and reach its last place; None = it does not move
    """

    angle_rad: FloatArray
    count_rad: float
    moves: tuple[int, int] | None


def turn_of(capture: Capture, turns: TurnsSection) -> Turn:
    """The turn that an encoder shows.

    One that begins anew after a whole turn is followed over it.  Counts are dithered over their
    width, so that what reads them sees the error that they have.
    source  Widrow & Kollár, Quantization Noise, 2008, ch. 19 (dither)
    raises  InputError: there is no such column
    """
    values, unit = capture.column(turns.column), turns.radians_per_unit or 1.0
    angle = values * unit + turns.offset_rad
    known = np.isfinite(angle)
    count_rad = count_of(values) * abs(unit)
    if not known.any():
        return Turn(angle, count_rad, None)
    whole = np.unwrap(angle[known])
    whole = whole - 2.0 * np.pi * np.round(whole[0] / (2.0 * np.pi))
    away = [np.abs(whole - whole[end]) > 1.5 * count_rad for end in (0, -1)]
    rows = np.flatnonzero(known)
    moves = None
    if away[0].any() and away[1].any():
        moves = int(rows[np.argmax(away[0])]), int(rows[len(rows) - 1 - np.argmax(away[1][::-1])])
    dither = np.random.default_rng(len(rows)).uniform(-0.5, 0.5, len(rows))
    angle[known] = whole + count_rad * dither * (moves is not None)
    return Turn(angle, count_rad, moves)


def place_m(turn: FloatArray, turns: TurnsSection) -> FloatArray:
    """(rows, 2) gripping point at turns (rows,) of the arm, in the study's frame."""
    axle_m = np.array(turns.axle_m or (0.0, 0.0))
    out = np.column_stack([-np.cos(turn), -np.sin(turn)])
    return np.asarray(axle_m + (turns.radius_m or 0.0) * out)
