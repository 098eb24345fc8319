"""A smooth curve through points on a line: arc length, direction and curvature without noise bias.

A polyline through noisy points is too long.  Here two quintic B-splines x(u), y(u) are fitted by
penalised least squares to points whose parameter u comes from a smoother curve before, so noise
moves points across the curve but never along it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cell.cable.arrays import FloatArray
from cell.vision.compiling import compiled

DEGREE = 5


@dataclass(frozen=True)
class Curve:
    """A plane curve over u = 0 … 1, in the units of the points that it was fitted to.

    coefficients  (C, 2) of quintic B-splines on uniform intervals
    """

    coefficients: FloatArray

    @property
    def intervals(self) -> int:
        """Number of polynomial pieces."""
        return len(self.coefficients) - DEGREE

    def at(self, u: FloatArray, derivative: int = 0) -> FloatArray:
        """(M, 2) points, or derivatives by u, at (M,) parameters; u outside 0 … 1 goes on."""
        value = np.empty((len(u), 2))
        pieces = pieces_of_splines(self.intervals, derivative) @ self.coefficients
        _polynomials(pieces, np.asarray(u, dtype=np.float64), value)
        return value

    def normals(self, u: FloatArray) -> FloatArray:
        """(M, 2) unit normals: the direction of travel turned by +90°."""
        d = self.at(u, 1)
        return np.stack([-d[:, 1], d[:, 0]], axis=1) / np.hypot(d[:, 0], d[:, 1])[:, None]

    def centreline(self, samples: int) -> Centreline:
        """Dense samples with arc length, direction and curvature; for a curve in metres."""
        u = np.linspace(0.0, 1.0, samples)
        d1, d2 = self.at(u, 1), self.at(u, 2)
        speed = np.linalg.norm(d1, axis=1)
        step = 0.5 * (speed[1:] + speed[:-1]) * np.diff(u)
        return Centreline(
            arc_length_m=np.concatenate([[0.0], np.cumsum(step)]),
            xy_m=self.at(u),
            angle_rad=np.unwrap(np.arctan2(d1[:, 1], d1[:, 0])),
            curvature_1_per_m=(d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]) / speed**3,
        )


@dataclass(frozen=True)
class Centreline:
    """Dense samples of a centreline, from its held end.

    arc_length_m  (M,) from the held end
    xy_m          (M, 2)
    angle_rad     (M,) direction of travel, from the x axis towards y, unwrapped
    curvature_1_per_m  (M,) d angle / d arc length
    """

    arc_length_m: FloatArray
    xy_m: FloatArray
    angle_rad: FloatArray
    curvature_1_per_m: FloatArray

    @property
    def length_m(self) -> float:
        """Length of the whole."""
        return float(self.arc_length_m[-1])

    def moment(self, load_n_per_m: float) -> FloatArray:
        """(M,) bending moment of a load along −y beyond each point: weight × lever, N·m."""
        s, x = self.arc_length_m, self.xy_m[:, 0]
        step = np.diff(s)
        mean = 0.5 * (x[1:] + x[:-1])
        beyond = np.concatenate([np.cumsum((mean * step)[::-1])[::-1], [0.0]])
        return np.asarray(load_n_per_m * np.abs(beyond - x * (s[-1] - s)), dtype=np.float64)


def basis_matrix(intervals: int, u: FloatArray, derivative: int = 0) -> FloatArray:
    """(M, intervals + 5) quintic B-splines with clamped ends, or their derivatives, at (M,) u."""
    pieces = pieces_of_splines(intervals, derivative)
    piece = np.clip(np.floor(u * intervals).astype(int), 0, intervals - 1)
    place = (u * intervals - piece)[:, None]
    value = np.zeros((len(u), intervals + DEGREE))
    for power in range(DEGREE, -1, -1):
        value = value * place + pieces[piece, power]
    return value


@lru_cache(maxsize=32)
def pieces_of_splines(intervals: int, derivative: int) -> FloatArray:
    """(intervals, 6, C) from coefficients of splines to those of powers of the place in a piece.

    The place goes from 0 to 1 in every piece; lowest power first.

    source  de Boor 1972 (recursion over the degree)
    """
    knots = np.clip(np.arange(-DEGREE, intervals + DEGREE + 1), 0, intervals)
    pieces = np.zeros((intervals, DEGREE + 1, intervals + 2 * DEGREE))
    left = np.arange(intervals)
    pieces[left, 0, left + DEGREE] = 1.0
    for degree in range(1, DEGREE + 1):
        width = knots[degree:] - knots[:-degree]
        share = np.where(width > 0, pieces / np.maximum(width, 1), 0.0)
        times_u = left[:, None, None] * share
        times_u[:, 1:] += share[:, :-1]
        rising, falling = times_u - knots[:-degree] * share, knots[degree:] * share - times_u
        pieces = rising[:, :, :-1] + falling[:, :, 1:]
    for _ in range(derivative):
        pieces[:, :-1] = intervals * np.arange(1, DEGREE + 1)[:, None] * pieces[:, 1:]
        pieces[:, -1] = 0.0
    return pieces


@compiled
def _polynomials(pieces, u, out):  # type: ignore[no-untyped-def]
    """Values (M, 2) of polynomials `pieces` (intervals, 6, 2) at (M,) u; the end ones go on."""
    intervals, count, _ = pieces.shape
    for m in range(len(u)):
        place = u[m] * intervals
        piece = min(max(int(np.floor(place)), 0), intervals - 1)
        place -= piece
        for axis in range(2):
            value = 0.0
            for k in range(count - 1, -1, -1):
                value = value * place + pieces[piece, k, axis]
            out[m, axis] = value


@lru_cache(maxsize=32)
def roughness(intervals: int) -> FloatArray:
    """(C, C) matrix of ∫ (d³/du³)² du, by Gauss–Legendre quadrature (exact)."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    left = np.arange(intervals)[:, None] / intervals
    u = (left + (nodes + 1.0) / (2.0 * intervals)).ravel()
    w = np.tile(weights / (2.0 * intervals), intervals)
    d3 = basis_matrix(intervals, u, 3)
    return np.asarray(d3.T @ (w[:, None] * d3), dtype=np.float64)


def fit_curve(
    u: FloatArray,
    points: FloatArray,
    weights: FloatArray,
    intervals: int,
    penalty: float,
    start_direction: FloatArray | None = None,
    basis: FloatArray | None = None,
) -> Curve:
    """Curve through (N, 2) points at (N,) parameters u with (N,) weights.

    penalty          on ∫ (d³/du³)² du, relative to the mean squared weighted distance
    start_direction  (2,) the direction at u = 0, where it is known; held exactly
    basis            `basis_matrix(intervals, u)` if already at hand
    raises           ValueError: fewer weighted points than a curve needs
    """
    if np.count_nonzero(weights) < 8:
        raise ValueError(f"{np.count_nonzero(weights)} usable points on the line; needs at least 8")
    b = basis_matrix(intervals, u) if basis is None else basis
    weighted = (weights / weights.sum())[:, None] * b
    normal = b.T @ weighted + penalty * roughness(intervals) + 1e-12 * np.eye(b.shape[1])
    right = weighted.T @ points
    if start_direction is None:
        return Curve(np.linalg.solve(normal, right))
    # held direction: d/du at 0 is along `start_direction`, so its part across vanishes
    count = b.shape[1]
    d0 = basis_matrix(intervals, np.zeros(1), 1)[0]
    across = np.array([-start_direction[1], start_direction[0]])
    system = np.zeros((2 * count + 1, 2 * count + 1))
    system[:count, :count] = system[count:-1, count:-1] = normal
    system[-1, :count] = system[:count, -1] = across[0] * d0
    system[-1, count:-1] = system[count:-1, -1] = across[1] * d0
    solution = np.linalg.solve(system, np.concatenate([right[:, 0], right[:, 1], [0.0]]))
    return Curve(solution[:-1].reshape(2, count).T)


def choose_penalty(
    u: FloatArray,
    points: FloatArray,
    intervals: int,
    stretches: int,
    start_direction: FloatArray | None = None,
) -> float:
    """Penalty of `fit_curve` that predicts left-out stretches of (N, 2) points best.

    Whole stretches are left out, not points, because the unevenness of a real line is correlated
    along it: leaving out single points would call it shape.
    """
    stretch = np.minimum((u * stretches).astype(int), stretches - 1)
    penalties = 10.0 ** np.arange(-13.0, -5.9, 0.25)
    basis = basis_matrix(intervals, u)
    misfit = np.zeros(len(penalties))
    for i, penalty in enumerate(penalties):
        for left_out in np.unique(stretch):
            out = stretch == left_out
            weights = np.where(out, 0.0, 1.0)
            curve = fit_curve(u, points, weights, intervals, penalty, start_direction, basis)
            across = np.sum((curve.at(u[out]) - points[out]) * curve.normals(u[out]), axis=1)
            misfit[i] += float(across @ across)
    return float(penalties[misfit.argmin()])


def chord_parameters(points: FloatArray) -> FloatArray:
    """(N,) parameters 0 … 1 along (N, 2) points, by distance."""
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return np.asarray(s / s[-1], dtype=np.float64)
