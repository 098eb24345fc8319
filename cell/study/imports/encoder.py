"""A hand on an arm that turns about an axle: its place and turn by the axle's encoder."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cell.study.imports.capture import Capture
from cell.study.imports.hand_section import TurnsSection

FloatArray = NDArray[np.float64]


def turn_rad(capture: Capture, turns: TurnsSection) -> FloatArray:
    """(rows,) turn of the arm: 0 = it points to the left, positive = pointing down; nan = unknown.

    An encoder that begins anew after a whole turn is followed over it.
    raises  InputError: there is no such column
    """
    turn = capture.column(turns.column) * (turns.radians_per_unit or 1.0) + turns.offset_rad
    known = np.isfinite(turn)
    if known.any():
        whole = np.unwrap(turn[known])
        turn[known] = whole - 2.0 * np.pi * np.round(whole[0] / (2.0 * np.pi))
    return turn


def place_m(turn: FloatArray, turns: TurnsSection) -> FloatArray:
    """(rows, 2) gripping point at turns (rows,) of the arm, in the study's frame."""
    axle_m = np.array(turns.axle_m or (0.0, 0.0))
    out = np.column_stack([-np.cos(turn), -np.sin(turn)])
    return np.asarray(axle_m + (turns.radius_m or 0.0) * out)
