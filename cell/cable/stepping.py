"""Linearly implicit generalised-α steps of a chain of rods, and where its markers are.

Time: Chung & Hulbert, J. Appl. Mech. 60 (1993) 371; mass matrix and velocity terms are taken at the
predicted collocation state, bending moments linearised about it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.compiling import compiled, inline, widest_vectors
from cell.cable.effects.pointer import ADVANCE, EVALUATE, call_force, call_moment
from cell.cable.kernel import bending, kinematics, solve
from cell.cable.layout import (
    ACCEL,
    ACCEL_C,
    BASE_FIELDS,
    BEND,
    BEND_0,
    BEND_C,
    BODY,
    FX,
    LANES,
    RATE,
    RATE_C,
    VECTOR,
)
from cell.cable.numerics import sincos

#: Steps between checks for divergence.
_CHECK_EVERY = 8
#: Product of two rates of a hinge below which their signs are ignored, (rad/s)².
_STILL_RAD2_PER_S2 = 1e-10


@inline
def predict(S: FloatArray, lanes: int, n: int, step: FloatArray) -> None:
    """Predicted bends and rates at the collocation time, from the predicted acceleration."""
    widest_vectors()
    for i in range(n + 1):
        R = S[i * BODY :]
        for w in range(lanes):
            bend = R[w + BEND * LANES]
            rate = R[w + RATE * LANES]
            old = R[w + ACCEL * LANES]
            guess = R[w + ACCEL_C * LANES]
            R[w + BEND_0 * LANES] = bend
            R[w + BEND_C * LANES] = bend + step[3] * rate + step[4] * old + step[1] * guess
            R[w + RATE_C * LANES] = rate + step[5] * old + step[2] * guess


@inline
def turned(S: FloatArray, lanes: int, n: int, step: FloatArray) -> bool:
    """Whether a hinge's rate has another sign than where its moment was evaluated."""
    widest_vectors()
    worst = 0.0
    for i in range(n + 1):
        R = S[i * BODY :]
        for w in range(lanes):
            rate = R[w + RATE * LANES] + step[5] * R[w + ACCEL * LANES]
            rate += step[2] * R[w + ACCEL_C * LANES]
            product = -rate * R[w + RATE_C * LANES]
            worst = product if product > worst else worst
    return worst > _STILL_RAD2_PER_S2


@inline
def advance(S: FloatArray, lanes: int, n: int, step: FloatArray) -> None:
    """State at the end of the step from the acceleration in its equation."""
    widest_vectors()
    for i in range(n + 1):
        R = S[i * BODY :]
        for w in range(lanes):
            bend = R[w + BEND * LANES]
            rate = R[w + RATE * LANES]
            old = R[w + ACCEL * LANES]
            new = step[6] * R[w + ACCEL_C * LANES] + step[7] * old
            R[w + BEND_0 * LANES] = bend
            R[w + BEND * LANES] = bend + step[0] * rate + step[8] * old + step[9] * new
            R[w + BEND_C * LANES] = rate
            R[w + RATE * LANES] = rate + step[10] * old + step[11] * new
            R[w + ACCEL * LANES] = new


@inline
def diverged(S: FloatArray, lanes: int, n: int) -> bool:
    """Whether any hinge is bent by half a turn or more, or not finite."""
    widest_vectors()
    worst = 0.0
    for i in range(n + 1):
        R = S[i * BODY :]
        for w in range(lanes):
            bend = abs(R[w + BEND * LANES])
            worst = worst if bend <= worst else bend
    return not worst < math.pi


def sample_times(when: Sequence[FloatArray]) -> FloatArray:
    """The times at which `integrate` records samples, and of which lanes.

    when     (times,) of every lane in steps from the start, increasing; one array for neighbours
             that are recorded jointly
    returns  (samples, 4) in the order of time: time, first lane, lane after the last, row of `out`;
             without samples at the start or before
    """
    first = [k for k, times in enumerate(when) if k == 0 or times is not when[k - 1]]
    tables = []
    for a, b in zip(first, [*first[1:], len(when)], strict=True):
        table = np.empty((len(when[a]), 4))
        table[:, 0] = when[a]
        table[:, 1:3] = a, b
        table[:, 3] = np.arange(len(table))
        tables.append(table[table[:, 0] > 0.0])
    if len(tables) == 1:
        return tables[0]
    table = np.concatenate(tables)
    return table[np.argsort(table[:, 0], kind="stable")]


@inline
def record(
    S: FloatArray, first: int, last: int, n: int, h: float, u: float, out: FloatArray, row: int
) -> None:
    """Record bends of lanes first … last − 1 at fraction `u` of the last step (cubic)."""
    widest_vectors()
    u2 = u * u
    u3 = u2 * u
    p0 = 2.0 * u3 - 3.0 * u2 + 1.0
    p1 = 3.0 * u2 - 2.0 * u3
    m0 = h * (u3 - 2.0 * u2 + u)
    m1 = h * (u3 - u2)
    for i in range(n + 1):
        R = S[i * BODY :]
        Q = out[(row * (n + 1) + i) * LANES :]
        for w in range(first, last):
            Q[w] = (
                p0 * R[w + BEND_0 * LANES]
                + p1 * R[w + BEND * LANES]
                + m0 * R[w + BEND_C * LANES]
                + m1 * R[w + RATE * LANES]
            )


@inline
def _aligned(size: int) -> FloatArray:
    """An array that begins on a cache line; see `layout.vectors`."""
    raw = np.empty(size + VECTOR)
    begin = -(raw.ctypes.data // 8) % VECTOR
    return raw[begin : begin + size]


@compiled
def integrate(
    S: FloatArray,
    lanes: int,
    n: int,
    B: FloatArray,
    step: FloatArray,
    nonlinear: bool,
    iterations: int,
    effects: Any,
    when: FloatArray,
    out: FloatArray,
    wrench: FloatArray,
) -> int:
    """All steps of a block; bends (rows, n + 1, LANES) into `out`; returns the step that blew up.

    step    coefficients of `generalised_alpha`
    iterations  most Newton iterations per step; a further one only if a hinge's rate changes sign
    when    (samples, 4) of `sample_times`
    wrench  (steps · 3 · LANES,) is filled with what the clamp exerts on the cable at the steps'
            collocation times, as `kernel.solve` has it; (0,) = not wanted
    returns −1, or the number of the first step whose bends are not below half a turn each
    """
    widest_vectors()
    forces, moments, params, rows, memory, memory_rows, start = effects
    T = _aligned(12 * LANES)
    h = step[0]
    dq = step[1]
    dv = step[2]
    steps = B.size // (BASE_FIELDS * LANES)
    forced = forces.size > 0
    done = 0
    for j in range(steps):
        for k in range(iterations):
            predict(S, lanes, n, step)
            kinematics(S, lanes, n, B, j, forced)
            bending(S, lanes, n, nonlinear, dq, dv)
            if forced:
                for i in range(n + 1):
                    R = S[i * BODY :]
                    for w in range(3 * LANES):
                        R[w + FX * LANES] = 0.0
                time = start + h * (j + step[12])
                for e in range(forces.size):
                    call_force(forces[e], (S, lanes, n, time, params, rows[e]))
            for e in range(moments.size):
                row = rows[forces.size + e]
                call_moment(
                    moments[e],
                    (
                        S,
                        lanes,
                        n,
                        EVALUATE,
                        h * step[12],
                        dq,
                        dv,
                        params,
                        row,
                        memory,
                        memory_rows[e],
                    ),
                )
            solve(S, T, lanes, n, B, j, dv, forced)
            if k + 1 < iterations and not turned(S, lanes, n, step):
                break
        if wrench.size > 0:
            W = wrench[3 * j * LANES :]
            for w in range(3 * LANES):
                W[w] = T[w + 9 * LANES]
        advance(S, lanes, n, step)
        for e in range(moments.size):
            row = rows[forces.size + e]
            call_moment(
                moments[e], (S, lanes, n, ADVANCE, h, dq, dv, params, row, memory, memory_rows[e])
            )
        if (j % _CHECK_EVERY == 0 or j == steps - 1) and diverged(S, lanes, n):
            return j
        while done < len(when) and when[done, 0] <= j + 1:
            first, last, row = int(when[done, 1]), int(when[done, 2]), int(when[done, 3])
            record(S, first, last, n, h, when[done, 0] - j, out, row)
            done += 1
    return -1


@compiled
def nodes(
    bends: FloatArray,
    lanes: int,
    n: int,
    lengths: FloatArray,
    clamp: FloatArray,
    cell: NDArray[np.int64],
    weights: FloatArray,
    out: FloatArray,
) -> None:
    """Positions at the markers from bends: rods joined end to end, cubic Hermite in between.

    bends    (times · (n + 1) · LANES,) of `record`
    lengths  (LANES,) of a full segment, m
    clamp    (times · 3 · LANES,) x, y, angle of the gripping point
    cell     (markers,) segment of each marker; weights (markers, 5) of its ends and end tangents,
             and how far beyond its far end, along the tangent there, it is, m
    out      (lanes, times, markers, 2), of these lanes or of the first of them
    """
    widest_vectors()
    times = out.shape[1]
    X = _aligned((n + 1) * 4 * LANES)
    P = _aligned(cell.size * 2 * LANES)
    for j in range(times):
        held = clamp[j * 3 * LANES :]
        o = j * (n + 1) * LANES
        for w in range(lanes):
            angle = held[w + 2 * LANES] + bends[o + w]
            sine, cosine = sincos(angle)
            X[w] = held[w]
            X[w + LANES] = held[w + LANES]
            X[w + 2 * LANES] = -lengths[w] * cosine
            X[w + 3 * LANES] = -lengths[w] * sine
        for i in range(1, n + 1):
            R = X[(i - 1) * 4 * LANES :]
            turn = bends[o + (i - 1) * LANES :]
            for w in range(lanes):
                k = 4 * LANES + w
                turn[LANES + w] += turn[w]
                angle = held[w + 2 * LANES] + turn[LANES + w]
                sine, cosine = sincos(angle)
                tx = -lengths[w] * cosine
                ty = -lengths[w] * sine
                R[k] = R[w] + 0.5 * (R[w + 2 * LANES] + tx)
                R[k + LANES] = R[w + LANES] + 0.5 * (R[w + 3 * LANES] + ty)
                R[k + 2 * LANES] = tx
                R[k + 3 * LANES] = ty
        for m in range(cell.size):
            R = X[cell[m] * 4 * LANES :]
            a, b, c0 = weights[m, 0], weights[m, 1], weights[m, 2]
            Q = P[m * 2 * LANES :]
            for w in range(lanes):
                q = w + 4 * LANES
                c1 = weights[m, 3] + weights[m, 4] / lengths[w]
                Q[w] = a * R[w] + b * R[q] + c0 * R[w + 2 * LANES] + c1 * R[q + 2 * LANES]
                Q[w + LANES] = (
                    a * R[w + LANES]
                    + b * R[q + LANES]
                    + c0 * R[w + 3 * LANES]
                    + c1 * R[q + 3 * LANES]
                )
        for w in range(out.shape[0]):
            for m in range(cell.size):
                out[w, j, m, 0] = P[m * 2 * LANES + w]
                out[w, j, m, 1] = P[(m * 2 + 1) * LANES + w]


@compiled
def spread_rows(rows: FloatArray, lanes: NDArray[np.int64], out: FloatArray) -> None:
    """Write rows (N, fields) to some lanes of `out` (N, fields, LANES)."""
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            for w in lanes:
                out[i, j, w] = rows[i, j]
