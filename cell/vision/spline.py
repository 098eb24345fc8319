"""The cable's curve, compiled: quintic B-splines on a fixed number of intervals.

A polyline through noisy points is too long.  Here two B-splines x(u), y(u) are fitted by penalised
least squares to points whose parameter u comes from a previous, smoother curve, so noise moves
points across the curve but never along it.  A curve is stored as one polynomial per interval:
pieces (intervals, 6, 2), lowest power first, in a variable from 0 to 1 in every piece.
"""

from __future__ import annotations

from math import floor, sqrt

import numpy as np

from cell.cable.arrays import FloatArray
from cell.vision.compiling import inline, part

DEGREE = 5
INTERVALS = 7  # of the cable's curve: room for the fourth bending mode
_PENALTY = 1e-10  # keeps the ends of the curve from waving
_WIDTH = DEGREE + 1  # splines that are not zero in an interval
_COUNT = INTERVALS + DEGREE


#: Columns of a table of points that a curve is fitted to.
COLUMN, ROW, STRENGTH, PARAMETER, WEIGHT = range(5)


def pieces_of_splines(derivative: int = 0) -> FloatArray:
    """(INTERVALS, 6, C) matrices from spline coefficients to polynomial coefficients of each piece.

    source  de Boor 1972 (recursion over the degree)
    """
    knots = np.clip(np.arange(-DEGREE, INTERVALS + DEGREE + 1), 0, INTERVALS)
    pieces = np.zeros((INTERVALS, DEGREE + 1, INTERVALS + 2 * DEGREE))
    first = np.arange(INTERVALS)
    pieces[first, 0, first + DEGREE] = 1.0
    for degree in range(1, DEGREE + 1):
        width = knots[degree:] - knots[:-degree]
        share = np.where(width > 0, pieces / np.maximum(width, 1), 0.0)
        times_u = first[:, None, None] * share
        times_u[:, 1:] += share[:, :-1]
        rising, falling = times_u - knots[:-degree] * share, knots[degree:] * share - times_u
        pieces = rising[:, :, :-1] + falling[:, :, 1:]
    for _ in range(derivative):
        pieces[:, :-1] = INTERVALS * np.arange(1, DEGREE + 1)[:, None] * pieces[:, 1:]
        pieces[:, -1] = 0.0
    return pieces


def roughness() -> FloatArray:
    """(C, C) matrix of ∫ (d³/du³)² du, by Gauss–Legendre quadrature (exact)."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    first = np.arange(INTERVALS)[:, None] / INTERVALS
    u = (first + (nodes + 1.0) / (2.0 * INTERVALS)).ravel()
    w = np.tile(weights / (2.0 * INTERVALS), INTERVALS)
    pieces = pieces_of_splines(3)
    piece = np.clip(np.floor(u * INTERVALS).astype(int), 0, INTERVALS - 1)
    place = (u * INTERVALS - piece)[:, None]
    d3 = np.zeros((len(u), _COUNT))
    for power in range(DEGREE, -1, -1):
        d3 = d3 * place + pieces[piece, power]
    return np.asarray(d3.T @ (w[:, None] * d3), dtype=np.float64)


def _splines() -> tuple[FloatArray, FloatArray]:
    """Powers (INTERVALS, 6, 6) of the splines that are not zero in an interval; the penalty.

    penalty  (C, C), what is added to the normal equations
    """
    full = pieces_of_splines()
    pieces = np.stack([full[i, :, i : i + _WIDTH] for i in range(INTERVALS)])
    return pieces, _PENALTY * roughness() + 1e-12 * np.eye(_COUNT)


_PIECES, _PENALTIES = _splines()


def new_equations() -> FloatArray:
    """Memory that `fit_cable` needs: normal equations, right-hand side, the splines at a place."""
    return np.empty((_COUNT, _COUNT + 3))


def new_pieces() -> FloatArray:
    """Memory of one curve."""
    return np.empty((INTERVALS, _WIDTH, 2))


@inline
def at(pieces, u):  # type: ignore[no-untyped-def]
    """Point (column, row) at u and its derivative by u; the end pieces are extrapolated."""
    place = u * INTERVALS
    piece = min(max(floor(place), 0), INTERVALS - 1)
    place -= piece
    p = pieces[piece]
    x, y, dx, dy = p[DEGREE, 0], p[DEGREE, 1], 0.0, 0.0
    for k in range(DEGREE - 1, -1, -1):
        dx = dx * place + x
        dy = dy * place + y
        x = x * place + p[k, 0]
        y = y * place + p[k, 1]
    return x, y, dx * INTERVALS, dy * INTERVALS


@part
def fit_cable(points, pieces, equations):  # type: ignore[no-untyped-def]
    """Curve through points at parameters 0 … 1, by penalised least squares.

    points     (N, ≥ 5) columns as above, weights ≥ 0 and not all zero
    pieces     of the curve, are written
    equations  memory, see `new_equations`
    """
    x_axis, y_axis, value = _COUNT, _COUNT + 1, _COUNT + 2
    for c in range(_COUNT):
        for d in range(_COUNT + 3):
            equations[c, d] = 0.0
    total = 0.0
    for n in range(len(points)):
        total += points[n, WEIGHT]
    for n in range(len(points)):
        if points[n, WEIGHT] == 0.0:
            continue
        weight = points[n, WEIGHT] / total
        place = points[n, PARAMETER] * INTERVALS
        piece = min(max(int(place), 0), INTERVALS - 1)
        place -= piece
        for c in range(_WIDTH):
            power = _PIECES[piece, DEGREE, c]
            for k in range(DEGREE - 1, -1, -1):
                power = power * place + _PIECES[piece, k, c]
            equations[c, value] = power
        for c in range(_WIDTH):
            weighted = weight * equations[c, value]
            for d in range(c + 1):
                equations[piece + c, piece + d] += weighted * equations[d, value]
            equations[piece + c, x_axis] += weighted * points[n, COLUMN]
            equations[piece + c, y_axis] += weighted * points[n, ROW]
    for c in range(_COUNT):
        for d in range(c + 1):
            equations[c, d] += _PENALTIES[c, d]
    _solve(equations)
    for piece in range(INTERVALS):
        for k in range(_WIDTH):
            x, y = 0.0, 0.0
            for c in range(_WIDTH):
                x += _PIECES[piece, k, c] * equations[piece + c, x_axis]
                y += _PIECES[piece, k, c] * equations[piece + c, y_axis]
            pieces[piece, k, 0], pieces[piece, k, 1] = x, y


@inline
def _solve(equations):  # type: ignore[no-untyped-def]
    """Solve for the two right-hand sides in place, by Cholesky's factors of the lower triangle."""
    for c in range(_COUNT):
        for d in range(max(0, c - DEGREE), c + 1):
            value = equations[c, d]
            for k in range(max(0, c - DEGREE), d):
                value -= equations[c, k] * equations[d, k]
            equations[c, d] = sqrt(value) if c == d else value / equations[d, d]
    for axis in range(_COUNT, _COUNT + 2):
        for c in range(_COUNT):
            value = equations[c, axis]
            for k in range(max(0, c - DEGREE), c):
                value -= equations[c, k] * equations[k, axis]
            equations[c, axis] = value / equations[c, c]
        for c in range(_COUNT - 1, -1, -1):
            value = equations[c, axis]
            for k in range(c + 1, min(c + _WIDTH, _COUNT)):
                value -= equations[k, c] * equations[k, axis]
            equations[c, axis] = value / equations[c, c]
