"""Linearly implicit generalised-α steps of a chain of rods, O(segments), many lanes side by side.

Bend angles are relative, so the implicit part of bending only adds to the diagonal of the
articulated-body recursion (Featherstone, Rigid Body Dynamics Algorithms, 2008, ch. 7), here planar
and in world axes.  Time: Chung & Hulbert, J. Appl. Mech. 60 (1993) 371; mass matrix and velocity
terms are taken at the predicted collocation state, bending moments linearised about it.
Statics: Newton's method in absolute angles, where the Hessian is tridiagonal.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.cable.compiling import compiled
from cell.cable.effects.pointer import ADVANCE, EVALUATE, call_force, call_moment
from cell.cable.layout import (
    ACCEL,
    ACCEL_C,
    ANGLE,
    BASE_AA,
    BASE_ANGLE,
    BASE_AX,
    BASE_AY,
    BASE_FIELDS,
    BASE_SPIN,
    BASE_UX,
    BASE_UY,
    BASE_X,
    BASE_Y,
    BEND,
    BEND_0,
    BEND_C,
    BIAS,
    BODY,
    DAMP,
    EXTRA,
    EXTRA_1,
    EXTRA_2,
    FREE,
    FX,
    FY,
    GX,
    GY,
    HA,
    HX,
    HY,
    INV,
    LANES,
    LENGTH,
    MASS,
    MASS_1,
    MASS_2,
    MOMENT,
    PER_LENGTH,
    POWER,
    PX,
    PY,
    QA,
    QX,
    QY,
    RATE,
    RATE_C,
    REST,
    RIGIDITY,
    SPIN,
    SPRING,
    STIFF,
    TX,
    TY,
    UX,
    UY,
    VISCOSITY,
    WEIGHT,
    WEIGHT_1,
)
from cell.cable.model import REFERENCE_CURVATURE_1_PER_M, REGULAR_CURVATURE_1_PER_M
from cell.cable.numerics import power, sincos

FloatArray = NDArray[np.float64]


_KE2 = (REGULAR_CURVATURE_1_PER_M / REFERENCE_CURVATURE_1_PER_M) ** 2
_KR2 = 1.0 / REFERENCE_CURVATURE_1_PER_M**2


@compiled
def kinematics(
    S: FloatArray, lanes: int, n: int, B: FloatArray, row: int, accelerations: bool
) -> None:
    """Angles, tangents, positions and velocities at the collocation time, from the clamp out."""
    b = row * BASE_FIELDS * LANES
    for w in range(lanes):
        k = w
        angle = B[b + BASE_ANGLE * LANES + w] + S[k + BEND_C * LANES]
        spin = B[b + BASE_SPIN * LANES + w] + S[k + RATE_C * LANES]
        sine, cosine = sincos(angle)
        S[k + ANGLE * LANES] = angle
        S[k + SPIN * LANES] = spin
        S[k + TX * LANES] = -cosine
        S[k + TY * LANES] = -sine
        S[k + PX * LANES] = B[b + BASE_X * LANES + w]
        S[k + PY * LANES] = B[b + BASE_Y * LANES + w]
        S[k + UX * LANES] = B[b + BASE_UX * LANES + w]
        S[k + UY * LANES] = B[b + BASE_UY * LANES + w]
    for i in range(1, n + 1):
        for w in range(lanes):
            p = (i - 1) * BODY + w
            k = i * BODY + w
            length = S[p + LENGTH * LANES]
            tx = S[p + TX * LANES]
            ty = S[p + TY * LANES]
            turn = length * S[p + SPIN * LANES]
            S[k + PX * LANES] = S[p + PX * LANES] + length * tx
            S[k + PY * LANES] = S[p + PY * LANES] + length * ty
            S[k + UX * LANES] = S[p + UX * LANES] - turn * ty
            S[k + UY * LANES] = S[p + UY * LANES] + turn * tx
            angle = S[p + ANGLE * LANES] + S[k + BEND_C * LANES]
            S[k + ANGLE * LANES] = angle
            S[k + SPIN * LANES] = S[p + SPIN * LANES] + S[k + RATE_C * LANES]
            sine, cosine = sincos(angle)
            S[k + TX * LANES] = -cosine
            S[k + TY * LANES] = -sine
    if accelerations:
        for w in range(lanes):
            S[w + QX * LANES] = B[b + BASE_AX * LANES + w]
            S[w + QY * LANES] = B[b + BASE_AY * LANES + w]
            S[w + QA * LANES] = B[b + BASE_AA * LANES + w] + S[w + ACCEL_C * LANES]
        for i in range(1, n + 1):
            for w in range(lanes):
                p = (i - 1) * BODY + w
                k = i * BODY + w
                length = S[p + LENGTH * LANES]
                turn = length * S[p + QA * LANES]
                centre = length * S[p + SPIN * LANES] * S[p + SPIN * LANES]
                S[k + QX * LANES] = (
                    S[p + QX * LANES] - turn * S[p + TY * LANES] - centre * S[p + TX * LANES]
                )
                S[k + QY * LANES] = (
                    S[p + QY * LANES] + turn * S[p + TX * LANES] - centre * S[p + TY * LANES]
                )
                S[k + QA * LANES] = S[p + QA * LANES] + S[k + ACCEL_C * LANES]


@compiled
def bending(S: FloatArray, lanes: int, n: int, nonlinear: bool, dq: float, dv: float) -> None:
    """The cable's own bending moments and their slope against the step's acceleration."""
    for w in range(lanes):
        spring = S[w + SPRING * LANES]
        S[w + MOMENT * LANES] = spring * S[w + BEND_C * LANES]
        S[w + STIFF * LANES] = spring * dq
    for i in range(1, n + 1):
        if nonlinear:
            for w in range(lanes):
                k = i * BODY + w
                per_length = S[k + PER_LENGTH * LANES]
                curvature = S[k + BEND_C * LANES] * per_length - S[k + REST * LANES]
                own = curvature * curvature * _KR2
                scale = own + _KE2
                exponent = S[k + POWER * LANES]
                secant = S[k + RIGIDITY * LANES] * power(scale, exponent)
                tangent = secant * (1.0 + 2.0 * exponent * own / scale)
                viscosity = S[k + VISCOSITY * LANES] * per_length
                S[k + MOMENT * LANES] = secant * curvature + viscosity * S[k + RATE_C * LANES]
                S[k + STIFF * LANES] = tangent * per_length * dq + viscosity * dv
        else:
            for w in range(lanes):
                k = i * BODY + w
                per_length = S[k + PER_LENGTH * LANES]
                rigidity = S[k + RIGIDITY * LANES]
                viscosity = S[k + VISCOSITY * LANES] * per_length
                S[k + MOMENT * LANES] = (
                    rigidity * (S[k + BEND_C * LANES] * per_length - S[k + REST * LANES])
                    + viscosity * S[k + RATE_C * LANES]
                )
                S[k + STIFF * LANES] = rigidity * per_length * dq + viscosity * dv


@compiled
def solve(
    S: FloatArray,
    T: FloatArray,
    lanes: int,
    n: int,
    B: FloatArray,
    row: int,
    dv: float,
    damped: bool,
) -> None:
    """Accelerations of all hinges at the collocation time: inward and outward sweep.

    T (≥ 6·LANES,) carries the articulated inertia from body to body.
    """
    for w in range(6 * LANES):
        T[w] = 0.0
    for w in range(lanes):
        k = n * BODY + w
        S[k + HX * LANES] = 0.0
        S[k + HY * LANES] = 0.0
        S[k + HA * LANES] = 0.0
    for i in range(n, -1, -1):
        o = i * BODY
        for w in range(lanes):
            k = o + w
            tx = S[k + TX * LANES]
            ty = S[k + TY * LANES]
            nx = -ty
            ny = tx
            spin = S[k + SPIN * LANES]
            length = S[k + LENGTH * LANES]
            ux = S[k + UX * LANES]
            uy = S[k + UY * LANES]
            along = ux * tx + uy * ty
            across = ux * nx + uy * ny
            # what hangs on the far end, moved to the near end
            ixx = T[w]
            ixy = T[LANES + w]
            iyy = T[2 * LANES + w]
            hx = T[3 * LANES + w]
            hy = T[4 * LANES + w]
            rx = length * nx
            ry = length * ny
            cx = -length * spin * spin * tx
            cy = -length * spin * spin * ty
            fx = S[k + HX * LANES] + ixx * cx + ixy * cy
            fy = S[k + HY * LANES] + ixy * cx + iyy * cy
            ft = S[k + HA * LANES] + hx * cx + hy * cy + rx * fx + ry * fy
            gx = hx + ixx * rx + ixy * ry
            gy = hy + ixy * rx + iyy * ry
            ha = T[5 * LANES + w] + hx * rx + hy * ry + rx * gx + ry * gy
            # the body itself
            mass = S[k + MASS * LANES]
            mass_1 = S[k + MASS_1 * LANES]
            extra = S[k + EXTRA * LANES]
            extra_1 = S[k + EXTRA_1 * LANES]
            extra_2 = S[k + EXTRA_2 * LANES]
            drive = extra * across + extra_1 * spin
            whirl = -mass_1 * spin * spin - spin * drive
            lift = -along * spin * extra
            weight = S[k + WEIGHT * LANES]
            weight_1 = S[k + WEIGHT_1 * LANES]
            fx += whirl * tx + lift * nx - weight * S[k + GX * LANES]
            fy += whirl * ty + lift * ny - weight * S[k + GY * LANES]
            ft += extra * across * along - weight_1 * (
                nx * S[k + GX * LANES] + ny * S[k + GY * LANES]
            )
            if damped:
                half = 0.5 * length
                ex = S[k + FX * LANES] * length
                ey = S[k + FY * LANES] * length
                damp = dv * S[k + DAMP * LANES] * length
                damp_1 = damp * half
                damp_2 = damp_1 * length * (2.0 / 3.0)
                qn = S[k + QX * LANES] * nx + S[k + QY * LANES] * ny
                qa = S[k + QA * LANES]
                lag = damp * qn + damp_1 * qa
                fx -= ex + lag * nx
                fy -= ey + lag * ny
                ft -= half * (ex * nx + ey * ny) + damp_1 * qn + damp_2 * qa
                extra += damp
                extra_1 += damp_1
                extra_2 += damp_2
            ixx += mass + extra * nx * nx
            ixy += extra * nx * ny
            iyy += mass + extra * ny * ny
            gx += (mass_1 + extra_1) * nx
            gy += (mass_1 + extra_1) * ny
            ha += S[k + MASS_2 * LANES] + extra_2
            # its hinge gives way
            stiff = S[k + STIFF * LANES]
            inv = S[k + FREE * LANES] / (ha + stiff)
            moment = S[k + MOMENT * LANES] - stiff * S[k + ACCEL_C * LANES]
            bias = moment + ft
            S[k + INV * LANES] = inv
            S[k + BIAS * LANES] = bias
            S[k + HX * LANES] = gx
            S[k + HY * LANES] = gy
            S[k + HA * LANES] = ha
            keep = 1.0 - ha * inv
            T[w] = ixx - gx * gx * inv
            T[LANES + w] = ixy - gx * gy * inv
            T[2 * LANES + w] = iyy - gy * gy * inv
            T[3 * LANES + w] = gx * keep
            T[4 * LANES + w] = gy * keep
            T[5 * LANES + w] = ha * keep
            if i > 0:
                S[k - BODY + HX * LANES] = fx - gx * inv * bias
                S[k - BODY + HY * LANES] = fy - gy * inv * bias
                S[k - BODY + HA * LANES] = ft - ha * inv * bias
    b = row * BASE_FIELDS * LANES
    for w in range(lanes):
        T[w] = B[b + BASE_AX * LANES + w]
        T[LANES + w] = B[b + BASE_AY * LANES + w]
        T[2 * LANES + w] = B[b + BASE_AA * LANES + w]
    for i in range(n + 1):
        o = i * BODY
        for w in range(lanes):
            k = o + w
            ax = T[w]
            ay = T[LANES + w]
            aa = T[2 * LANES + w]
            bend = -S[k + INV * LANES] * (
                S[k + BIAS * LANES]
                + S[k + HX * LANES] * ax
                + S[k + HY * LANES] * ay
                + S[k + HA * LANES] * aa
            )
            aa += bend
            S[k + ACCEL_C * LANES] = bend
            length = S[k + LENGTH * LANES]
            spin = S[k + SPIN * LANES]
            turn = length * aa
            centre = length * spin * spin
            tx = S[k + TX * LANES]
            ty = S[k + TY * LANES]
            T[w] = ax - turn * ty - centre * tx
            T[LANES + w] = ay + turn * tx - centre * ty
            T[2 * LANES + w] = aa


@compiled
def predict(S: FloatArray, lanes: int, n: int, step: FloatArray) -> None:
    """Bends and rates at the collocation time, were the acceleration the predicted one."""
    for i in range(n + 1):
        for w in range(lanes):
            k = i * BODY + w
            rate = S[k + RATE * LANES]
            old = S[k + ACCEL * LANES]
            guess = S[k + ACCEL_C * LANES]
            S[k + BEND_C * LANES] = (
                S[k + BEND * LANES] + step[3] * rate + step[4] * old + step[1] * guess
            )
            S[k + RATE_C * LANES] = rate + step[5] * old + step[2] * guess


@compiled
def advance(S: FloatArray, lanes: int, n: int, step: FloatArray) -> None:
    """State at the end of the step from the acceleration in its equation."""
    for i in range(n + 1):
        for w in range(lanes):
            k = i * BODY + w
            bend = S[k + BEND * LANES]
            rate = S[k + RATE * LANES]
            old = S[k + ACCEL * LANES]
            new = step[6] * S[k + ACCEL_C * LANES] + step[7] * old
            S[k + BEND_0 * LANES] = bend
            S[k + BEND * LANES] = bend + step[0] * rate + step[8] * old + step[9] * new
            S[k + BEND_C * LANES] = rate
            S[k + RATE * LANES] = rate + step[10] * old + step[11] * new
            S[k + ACCEL * LANES] = new


@compiled
def record(
    S: FloatArray, lanes: int, n: int, h: float, u: float, out: FloatArray, row: int
) -> None:
    """Bends `u` of the way through the step just made, by cubic Hermite interpolation."""
    u2 = u * u
    u3 = u2 * u
    p0 = 2.0 * u3 - 3.0 * u2 + 1.0
    p1 = 3.0 * u2 - 2.0 * u3
    m0 = h * (u3 - 2.0 * u2 + u)
    m1 = h * (u3 - u2)
    for i in range(n + 1):
        for w in range(lanes):
            k = i * BODY + w
            out[(row * (n + 1) + i) * LANES + w] = (
                p0 * S[k + BEND_0 * LANES]
                + p1 * S[k + BEND * LANES]
                + m0 * S[k + BEND_C * LANES]
                + m1 * S[k + RATE * LANES]
            )


@compiled
def integrate(
    S: FloatArray,
    lanes: int,
    n: int,
    B: FloatArray,
    step: FloatArray,
    nonlinear: bool,
    passes: int,
    effects: Any,
    when: FloatArray,
    out: FloatArray,
) -> int:
    """All steps of a block; bends (times, n + 1, LANES) into `out`; returns the step that blew up.

    step    coefficients of `generalised_alpha`
    when    (times,) output times in steps from the start, increasing
    returns −1, or the number of the first step whose bends are not below half a turn each
    """
    forces, moments, params, rows, memory, memory_rows, start = effects
    T = np.zeros(6 * LANES)
    h = step[0]
    dq = step[1]
    dv = step[2]
    steps = B.size // (BASE_FIELDS * LANES)
    forced = forces.size > 0
    done = 0
    for j in range(steps):
        for i in range(n + 1):
            for w in range(lanes):
                S[i * BODY + BEND_0 * LANES + w] = S[i * BODY + BEND * LANES + w]
        for _ in range(passes):
            predict(S, lanes, n, step)
            kinematics(S, lanes, n, B, j, forced)
            bending(S, lanes, n, nonlinear, dq, dv)
            if forced:
                for i in range(n + 1):
                    for w in range(3 * LANES):
                        S[i * BODY + FX * LANES + w] = 0.0
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
        advance(S, lanes, n, step)
        for e in range(moments.size):
            row = rows[forces.size + e]
            call_moment(
                moments[e], (S, lanes, n, ADVANCE, h, dq, dv, params, row, memory, memory_rows[e])
            )
        bad = False
        for i in range(n + 1):
            for w in range(lanes):
                bad |= not (abs(S[i * BODY + BEND * LANES + w]) < math.pi)
        if bad:
            return j
        while done < when.size and when[done] <= j + 1:
            record(S, lanes, n, h, when[done] - j, out, done)
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
    cell     (markers,) segment of each marker; weights (markers, 4) of its ends and end tangents
    out      (lanes, times, markers, 2)
    """
    times = out.shape[1]
    X = np.empty((n + 1) * 4 * LANES)
    for j in range(times):
        c = j * 3 * LANES
        o = j * (n + 1) * LANES
        for w in range(lanes):
            angle = clamp[c + 2 * LANES + w] + bends[o + w]
            sine, cosine = sincos(angle)
            X[w] = clamp[c + w]
            X[LANES + w] = clamp[c + LANES + w]
            X[2 * LANES + w] = -lengths[w] * cosine
            X[3 * LANES + w] = -lengths[w] * sine
        for i in range(1, n + 1):
            for w in range(lanes):
                k = i * 4 * LANES + w
                p = k - 4 * LANES
                # angles add up; the previous one is kept implicitly through its own sum
                bends[o + i * LANES + w] += bends[o + (i - 1) * LANES + w]
                angle = clamp[c + 2 * LANES + w] + bends[o + i * LANES + w]
                sine, cosine = sincos(angle)
                tx = -lengths[w] * cosine
                ty = -lengths[w] * sine
                X[k] = X[p] + 0.5 * (X[p + 2 * LANES] + tx)
                X[k + LANES] = X[p + LANES] + 0.5 * (X[p + 3 * LANES] + ty)
                X[k + 2 * LANES] = tx
                X[k + 3 * LANES] = ty
        for m in range(cell.size):
            k = cell[m] * 4 * LANES
            a, b, c0, c1 = weights[m, 0], weights[m, 1], weights[m, 2], weights[m, 3]
            for w in range(lanes):
                q = k + 4 * LANES
                out[w, j, m, 0] = (
                    a * X[k + w]
                    + b * X[q + w]
                    + c0 * X[k + 2 * LANES + w]
                    + c1 * X[q + 2 * LANES + w]
                )
                out[w, j, m, 1] = (
                    a * X[k + LANES + w]
                    + b * X[q + LANES + w]
                    + c0 * X[k + 3 * LANES + w]
                    + c1 * X[q + 3 * LANES + w]
                )
