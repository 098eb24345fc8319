"""Static equilibrium by the same chain, loads and bending moments as the dynamics."""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.assembly import ParameterBlock
from cell.cable.compiling import compiled, inline
from cell.cable.effects.own import run_engine
from cell.cable.effects.pointer import REST, call_force, call_moment
from cell.cable.kernel import bending, kinematics
from cell.cable.layout import (
    BEND,
    BEND_C,
    BODY,
    FREE,
    FX,
    FY,
    GX,
    GY,
    LANES,
    LENGTH,
    MOMENT,
    RATE_C,
    STIFF,
    TX,
    TY,
    WEIGHT,
    WEIGHT_1,
)
from cell.cable.solver import LanesError

#: Equilibrium is reached when no Newton step turns any segment by more than this, rad.
_TOLERANCE = 1e-11
_ITERATIONS = 200
#: Largest turn of a segment in one iteration, rad.
_STRIDE = 0.3


@compiled
def balance(S: FloatArray, lanes: int, n: int, B: FloatArray, nonlinear: bool, effects: Any) -> int:
    """Bring all lanes to rest from where they are, under the clamp pose in row 0 of B.

    Newton's method in absolute angles: bending couples neighbours, dead weight only adds to the
    diagonal, so the Hessian is tridiagonal.  Effects' forces follow without a tangent.
    returns −1, or a lane that did not converge
    """
    forces, moments, params, rows, memory, memory_rows, start = effects
    size = n + 1
    diagonal = np.empty(size * LANES)
    residual = np.empty(size * LANES)
    ahead = np.empty(2 * LANES)
    turn = np.empty(size * LANES)
    for i in range(size):
        for w in range(lanes):
            S[i * BODY + BEND_C * LANES + w] = S[i * BODY + BEND * LANES + w]
            S[i * BODY + RATE_C * LANES + w] = 0.0
    converged = False
    worst = 0
    for _ in range(_ITERATIONS):
        kinematics(S, lanes, n, B, 0, False)
        bending(S, lanes, n, nonlinear, 1.0, 0.0)
        for i in range(size):
            for w in range(3 * LANES):
                S[i * BODY + FX * LANES + w] = 0.0
        for e in range(forces.size):
            call_force(forces[e], (S, lanes, n, start, params, rows[e]))
        for e in range(moments.size):
            row = rows[forces.size + e]
            call_moment(
                moments[e],
                (S, lanes, n, REST, 1.0, 1.0, 1.0, params, row, memory, memory_rows[e]),
            )
        for w in range(2 * LANES):
            ahead[w] = 0.0
        for i in range(n, -1, -1):
            for w in range(lanes):
                k = i * BODY + w
                length = S[k + LENGTH * LANES]
                weight = S[k + WEIGHT * LANES]
                weight_1 = S[k + WEIGHT_1 * LANES]
                gx = S[k + GX * LANES]
                gy = S[k + GY * LANES]
                fx = S[k + FX * LANES] * length
                fy = S[k + FY * LANES] * length
                leverx = length * (ahead[w] + 0.5 * fx) + weight_1 * gx
                levery = length * (ahead[LANES + w] + 0.5 * fy) + weight_1 * gy
                tx = S[k + TX * LANES]
                ty = S[k + TY * LANES]
                pull = -(leverx * -ty + levery * tx)
                hold = leverx * tx + levery * ty
                moment = S[k + MOMENT * LANES]
                stiff = S[k + STIFF * LANES]
                if i < n:
                    moment -= S[k + BODY + MOMENT * LANES]
                    stiff += S[k + BODY + STIFF * LANES]
                residual[i * LANES + w] = moment + pull
                diagonal[i * LANES + w] = stiff
                turn[i * LANES + w] = hold
                ahead[w] += fx + weight * gx
                ahead[LANES + w] += fy + weight * gy
        converged = True
        for w in range(lanes):
            sound = _tridiagonal(S, w, n, diagonal, residual, turn, False)
            if not sound:
                _tridiagonal(S, w, n, diagonal, residual, turn, True)
            largest = 0.0
            for i in range(size):
                largest = max(largest, abs(residual[i * LANES + w]))
            scale = 1.0 if largest <= _STRIDE else _STRIDE / largest
            before = 0.0
            for i in range(size):
                after = scale * residual[i * LANES + w]
                S[i * BODY + BEND_C * LANES + w] -= after - before
                before = after
            if not largest < _TOLERANCE:
                converged = False
                worst = w
        if converged:
            break
    for i in range(size):
        for w in range(lanes):
            S[i * BODY + BEND * LANES + w] = S[i * BODY + BEND_C * LANES + w]
    return -1 if converged else worst


@inline
def _tridiagonal(
    S: FloatArray,
    w: int,
    n: int,
    diagonal: FloatArray,
    residual: FloatArray,
    hold: FloatArray,
    clipped: bool,
) -> bool:
    """Solve one lane's Newton step into `residual`; False (nothing done) if not convex there."""
    pivot = np.empty(n + 1)
    size = n + 1
    first = 0 if S[w + FREE * LANES] > 0.0 else 1
    for i in range(first, size):
        extra = hold[i * LANES + w]
        pivot[i] = diagonal[i * LANES + w] + (max(extra, 0.0) if clipped else extra)
        if i > first:
            stiff = S[i * BODY + STIFF * LANES + w]
            pivot[i] -= stiff * stiff / pivot[i - 1]
        if not pivot[i] > 0.0:
            return False
    for i in range(first + 1, size):
        stiff = S[i * BODY + STIFF * LANES + w]
        residual[i * LANES + w] += stiff / pivot[i - 1] * residual[(i - 1) * LANES + w]
    residual[n * LANES + w] /= pivot[n]
    for i in range(n - 1, first - 1, -1):
        stiff = S[(i + 1) * BODY + STIFF * LANES + w]
        residual[i * LANES + w] = (
            residual[i * LANES + w] + stiff * residual[(i + 1) * LANES + w]
        ) / pivot[i]
    if first == 1:
        residual[w] = 0.0
    return True


class UnsettledError(LanesError):
    """No static equilibrium was found.  Scenario: an effect's force that grows without bound."""


def settle(block: ParameterBlock, base: FloatArray) -> None:
    """Bring the block's state to rest under the clamp poses in row 0 of `base`.

    raises  UnsettledError
    """
    lane = run_engine(
        balance,
        block.own,
        block.state,
        block.width,
        block.segments,
        base,
        block.nonlinear,
        block.effects,
    )
    if lane >= 0:
        number = block.lanes[lane] if lane < len(block.lanes) else block.lanes[0]
        raise UnsettledError(
            [number],
            f"lane {number}: no static equilibrium found; the cable may be too soft for its "
            "weight, or an effect's force may grow without bound",
        )
