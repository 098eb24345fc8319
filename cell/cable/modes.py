"""Shapes of a cable that is not in equilibrium: those in which a clamped, free beam vibrates."""

from __future__ import annotations

import numpy as np

from cell.cable.arrays import FloatArray

#: Roots of cosh β cos β = −1.
ROOTS = (1.87510407, 4.69409113, 7.85475744, 10.99554073, 14.13716839, 17.27875953)


def mode_curvature(fraction: FloatArray, modes: int) -> FloatArray:
    """(fractions, modes) curvature times free length that moves the tip by one free length.

    To first order in the bending; at fractions 0 … 1 of the length from the clamp.
    source  Blevins 1979, Formulas for Natural Frequency and Mode Shape, table 8-1, clamped–free
    """
    roots = np.array(ROOTS[:modes])
    x = np.asarray(fraction, dtype=np.float64)[:, None] * roots
    ratio = (np.sinh(roots) - np.sin(roots)) / (np.cosh(roots) + np.cos(roots))
    shape = np.cosh(x) + np.cos(x) - ratio * (np.sinh(x) + np.sin(x))
    tip = np.cosh(roots) - np.cos(roots) - ratio * (np.sinh(roots) - np.sin(roots))
    return np.asarray(roots**2 * shape / tip)
