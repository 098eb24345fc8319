"""Accelerations of a chain of rods, O(segments), many lanes side by side.

Bend angles are relative, so the implicit part of bending only adds to the diagonal of the
articulated-body recursion (Featherstone, Rigid Body Dynamics Algorithms, 2008, ch. 7), here planar
and in world axes.
"""

from __future__ import annotations

from cell.cable.arrays import FloatArray
from cell.cable.compiling import inline, widest_vectors
from cell.cable.layout import (
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

_KE2 = (REGULAR_CURVATURE_1_PER_M / REFERENCE_CURVATURE_1_PER_M) ** 2
_KR2 = 1.0 / REFERENCE_CURVATURE_1_PER_M**2


@inline
def kinematics(
    S: FloatArray, lanes: int, n: int, B: FloatArray, row: int, accelerations: bool
) -> None:
    """Angles, tangents, positions and velocities at the collocation time, from the clamp out."""
    widest_vectors()
    C = B[row * BASE_FIELDS * LANES :]
    for w in range(lanes):
        angle = C[w + BASE_ANGLE * LANES] + S[w + BEND_C * LANES]
        spin = C[w + BASE_SPIN * LANES] + S[w + RATE_C * LANES]
        sine, cosine = sincos(angle)
        S[w + ANGLE * LANES] = angle
        S[w + SPIN * LANES] = spin
        S[w + TX * LANES] = -cosine
        S[w + TY * LANES] = -sine
        S[w + PX * LANES] = C[w + BASE_X * LANES]
        S[w + PY * LANES] = C[w + BASE_Y * LANES]
        S[w + UX * LANES] = C[w + BASE_UX * LANES]
        S[w + UY * LANES] = C[w + BASE_UY * LANES]
    for i in range(n):
        R = S[i * BODY :]
        for w in range(lanes):
            k = BODY + w
            length = R[w + LENGTH * LANES]
            tx = R[w + TX * LANES]
            ty = R[w + TY * LANES]
            turn = length * R[w + SPIN * LANES]
            R[k + PX * LANES] = R[w + PX * LANES] + length * tx
            R[k + PY * LANES] = R[w + PY * LANES] + length * ty
            R[k + UX * LANES] = R[w + UX * LANES] - turn * ty
            R[k + UY * LANES] = R[w + UY * LANES] + turn * tx
            angle = R[w + ANGLE * LANES] + R[k + BEND_C * LANES]
            R[k + ANGLE * LANES] = angle
            R[k + SPIN * LANES] = R[w + SPIN * LANES] + R[k + RATE_C * LANES]
            sine, cosine = sincos(angle)
            R[k + TX * LANES] = -cosine
            R[k + TY * LANES] = -sine
    if accelerations:
        for w in range(lanes):
            S[w + QX * LANES] = C[w + BASE_AX * LANES]
            S[w + QY * LANES] = C[w + BASE_AY * LANES]
            S[w + QA * LANES] = C[w + BASE_AA * LANES] + S[w + ACCEL_C * LANES]
        for i in range(n):
            R = S[i * BODY :]
            for w in range(lanes):
                k = BODY + w
                length = R[w + LENGTH * LANES]
                tx = R[w + TX * LANES]
                ty = R[w + TY * LANES]
                turn = length * R[w + QA * LANES]
                centre = length * R[w + SPIN * LANES] * R[w + SPIN * LANES]
                R[k + QX * LANES] = R[w + QX * LANES] - turn * ty - centre * tx
                R[k + QY * LANES] = R[w + QY * LANES] + turn * tx - centre * ty
                R[k + QA * LANES] = R[w + QA * LANES] + R[k + ACCEL_C * LANES]


@inline
def bending(S: FloatArray, lanes: int, n: int, nonlinear: bool, dq: float, dv: float) -> None:
    """The cable's bending moments, and their derivatives by the step's acceleration."""
    widest_vectors()
    for w in range(lanes):
        spring = S[w + SPRING * LANES]
        loss = S[w + VISCOSITY * LANES]
        S[w + MOMENT * LANES] = spring * S[w + BEND_C * LANES] + loss * S[w + RATE_C * LANES]
        S[w + STIFF * LANES] = spring * dq + loss * dv
    for i in range(1, n + 1):
        if nonlinear:
            R = S[i * BODY :]
            for w in range(lanes):
                per_length = R[w + PER_LENGTH * LANES]
                curvature = R[w + BEND_C * LANES] * per_length - R[w + REST * LANES]
                own = curvature * curvature * _KR2
                scale = own + _KE2
                exponent = R[w + POWER * LANES]
                secant = R[w + RIGIDITY * LANES] * power(scale, exponent)
                tangent = secant * (1.0 + 2.0 * exponent * own / scale)
                viscosity = R[w + VISCOSITY * LANES] * per_length
                R[w + MOMENT * LANES] = secant * curvature + viscosity * R[w + RATE_C * LANES]
                R[w + STIFF * LANES] = tangent * per_length * dq + viscosity * dv
        else:
            R = S[i * BODY :]
            for w in range(lanes):
                per_length = R[w + PER_LENGTH * LANES]
                rigidity = R[w + RIGIDITY * LANES]
                viscosity = R[w + VISCOSITY * LANES] * per_length
                R[w + MOMENT * LANES] = (
                    rigidity * (R[w + BEND_C * LANES] * per_length - R[w + REST * LANES])
                    + viscosity * R[w + RATE_C * LANES]
                )
                R[w + STIFF * LANES] = rigidity * per_length * dq + viscosity * dv


@inline
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

    T (≥ 12·LANES,) carries the articulated inertia and bias from body to body.  The last 3·LANES
    are then what the clamp exerts on the cable: force x, y, N, and moment about the gripping
    point, N·m.
    """
    widest_vectors()
    for w in range(9 * LANES):
        T[w] = 0.0
    for i in range(n, -1, -1):
        R = S[i * BODY :]
        for w in range(lanes):
            tx = R[w + TX * LANES]
            ty = R[w + TY * LANES]
            nx = -ty
            ny = tx
            spin = R[w + SPIN * LANES]
            length = R[w + LENGTH * LANES]
            ux = R[w + UX * LANES]
            uy = R[w + UY * LANES]
            along = ux * tx + uy * ty
            across = ux * nx + uy * ny
            # inertia and bias at the far end, moved to the near end
            ixx = T[w]
            ixy = T[w + LANES]
            iyy = T[w + 2 * LANES]
            hx = T[w + 3 * LANES]
            hy = T[w + 4 * LANES]
            rx = length * nx
            ry = length * ny
            cx = -length * spin * spin * tx
            cy = -length * spin * spin * ty
            fx = T[w + 6 * LANES] + ixx * cx + ixy * cy
            fy = T[w + 7 * LANES] + ixy * cx + iyy * cy
            ft = T[w + 8 * LANES] + hx * cx + hy * cy + rx * fx + ry * fy
            gx = hx + ixx * rx + ixy * ry
            gy = hy + ixy * rx + iyy * ry
            ha = T[w + 5 * LANES] + hx * rx + hy * ry + rx * gx + ry * gy
            # the body itself
            mass = R[w + MASS * LANES]
            mass_1 = R[w + MASS_1 * LANES]
            extra = R[w + EXTRA * LANES]
            extra_1 = R[w + EXTRA_1 * LANES]
            extra_2 = R[w + EXTRA_2 * LANES]
            drive = extra * across + extra_1 * spin
            whirl = -mass_1 * spin * spin - spin * drive
            lift = -along * spin * extra
            weight = R[w + WEIGHT * LANES]
            weight_1 = R[w + WEIGHT_1 * LANES]
            fx += whirl * tx + lift * nx - weight * R[w + GX * LANES]
            fy += whirl * ty + lift * ny - weight * R[w + GY * LANES]
            ft += extra * across * along - weight_1 * (
                nx * R[w + GX * LANES] + ny * R[w + GY * LANES]
            )
            if damped:
                half = 0.5 * length
                ex = R[w + FX * LANES] * length
                ey = R[w + FY * LANES] * length
                damp = dv * R[w + DAMP * LANES] * length
                damp_1 = damp * half
                damp_2 = damp_1 * length * (2.0 / 3.0)
                qn = R[w + QX * LANES] * nx + R[w + QY * LANES] * ny
                qa = R[w + QA * LANES]
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
            ha += R[w + MASS_2 * LANES] + extra_2
            # its hinge gives way
            stiff = R[w + STIFF * LANES]
            inv = R[w + FREE * LANES] / (ha + stiff)
            moment = R[w + MOMENT * LANES] - stiff * R[w + ACCEL_C * LANES]
            bias = moment + ft
            R[w + INV * LANES] = inv
            R[w + BIAS * LANES] = bias
            R[w + HX * LANES] = gx
            R[w + HY * LANES] = gy
            R[w + HA * LANES] = ha
            keep = 1.0 - ha * inv
            T[w] = ixx - gx * gx * inv
            T[w + LANES] = ixy - gx * gy * inv
            T[w + 2 * LANES] = iyy - gy * gy * inv
            T[w + 3 * LANES] = gx * keep
            T[w + 4 * LANES] = gy * keep
            T[w + 5 * LANES] = ha * keep
            T[w + 6 * LANES] = fx - gx * inv * bias
            T[w + 7 * LANES] = fy - gy * inv * bias
            T[w + 8 * LANES] = ft - ha * inv * bias
    C = B[row * BASE_FIELDS * LANES :]
    for w in range(lanes):
        ax = C[w + BASE_AX * LANES]
        ay = C[w + BASE_AY * LANES]
        aa = C[w + BASE_AA * LANES]
        gx = T[w + 3 * LANES]
        gy = T[w + 4 * LANES]
        T[w + 9 * LANES] = T[w] * ax + T[w + LANES] * ay + gx * aa + T[w + 6 * LANES]
        T[w + 10 * LANES] = T[w + LANES] * ax + T[w + 2 * LANES] * ay + gy * aa + T[w + 7 * LANES]
        T[w + 11 * LANES] = gx * ax + gy * ay + T[w + 5 * LANES] * aa + T[w + 8 * LANES]
        T[w] = ax
        T[w + LANES] = ay
        T[w + 2 * LANES] = aa
    for i in range(n + 1):
        R = S[i * BODY :]
        for w in range(lanes):
            ax = T[w]
            ay = T[w + LANES]
            aa = T[w + 2 * LANES]
            bend = -R[w + INV * LANES] * (
                R[w + BIAS * LANES]
                + R[w + HX * LANES] * ax
                + R[w + HY * LANES] * ay
                + R[w + HA * LANES] * aa
            )
            aa += bend
            R[w + ACCEL_C * LANES] = bend
            length = R[w + LENGTH * LANES]
            spin = R[w + SPIN * LANES]
            turn = length * aa
            centre = length * spin * spin
            tx = R[w + TX * LANES]
            ty = R[w + TY * LANES]
            T[w] = ax - turn * ty - centre * tx
            T[w + LANES] = ay + turn * tx - centre * ty
            T[w + 2 * LANES] = aa
