"""Linear response of a held cable to small deviations, and their estimate from the frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from cell.cable.arrays import FloatArray
from cell.cable.dynamics import simulate
from cell.cable.geometry import Motion
from cell.cable.solver import Solver
from cell.identify.identified import Identified
from cell.identify.parameters import difference_points
from cell.plan.choose import INTERVAL_S, coarsened

#: Modes of the swing that a force from outside excites.
MODES = 2
#: Interval at which unknown forces and gripper displacements change, s.
KNOTS_S = 0.025
#: One node in so many is used in flight, the tip among them.
EVERY_NODE = 2
#: Standard deviation of the pictures' unknown delay, s.
LATE_S = 4e-3
#: Standard deviation of the detected end along the cable, m, the same in all pictures; that of the
#: other nodes is in proportion to their arc lengths.
END_M = 1e-4
#: Step of the gripper, m, and of the modes' velocities, in free lengths per second, from which the
#: responses are computed.
_STEP_M, _KICK = 1e-3, 0.05
#: Duration of the gripper's step, which ends at 0, s: a motion is a sum of one per interval.
_STEP_S = INTERVAL_S


@dataclass(frozen=True, eq=False)
class Response:
    """Expected motion of a cable, and its linear responses to small deviations.

    Nodes are those of the camera, the tip first; responses are those of a cable near rest.

    t_s       (T,) after the commanded start, every `INTERVAL_S`
    nodes_m   (T, nodes, 2) expected positions
    rise      (T, nodes, 2) response to a rise of the gripper by 1 m at 0
    basis     (T, nodes', 2, unknowns) response of every `EVERY_NODE`-th node: to pictures `LATE_S`
              late; to an end detected `END_M` off; to one standard deviation of each parameter;
              then, for every knot, to `MODES` forces that begin there and finally bend the tip by
              1 m, and to a displacement of the gripper by 1 m right and up
    tip       (T, 2, unknowns) response of the true tip, without delay and detection error
    lasting   number of the unknowns that are not changes at a knot
    """

    t_s: FloatArray
    nodes_m: FloatArray
    rise: FloatArray
    basis: FloatArray
    tip: FloatArray
    lasting: int


def simulate_response(
    identified: Identified,
    motion: Motion,
    begin_s: float,
    end_s: float,
    arc_length_m: FloatArray,
    solver: Solver = Solver(),  # noqa: B008
) -> Response:
    """Simulate the expected motion, and each linear response once.

    motion         of the gripper, on the clock of the identification
    begin_s, end_s on that clock: the commanded start, and the end of the response
    arc_length_m   (nodes,) of the nodes from the gripping point, m
    raises         as the engine
    """
    t_s = np.arange(0.0, end_s - begin_s, INTERVAL_S)
    space, mean = identified.space, identified.mean
    coarse = coarsened(solver)
    expected = expected_nodes(identified, motion, begin_s + t_s, arc_length_m, solver)
    lanes = difference_points(mean, space.difference_steps(mean, identified.covariance))
    models = [space.model(q) for q in lanes]
    near = simulate(models, motion, begin_s + t_s, arc_length_m, solver=coarse)
    by_step = (near[1:] - near[:1]) / np.diag(lanes[1:] - mean)[:, None, None, None]
    slopes = np.einsum("qtnx,qp->ptnx", by_step, identified.root)
    forces, hand = _responses_at_rest(identified, motion, t_s, arc_length_m, coarse)
    late = -LATE_S * np.gradient(expected[:, ::EVERY_NODE], INTERVAL_S, axis=0)
    columns = [late, _end_detection_error(expected, arc_length_m), *slopes[:, :, ::EVERY_NODE]]
    for knot in range(0, len(t_s), round(KNOTS_S / INTERVAL_S)):
        for response in (*forces, *hand):
            later = np.zeros_like(columns[0])
            later[knot:] = response[: len(t_s) - knot, ::EVERY_NODE]
            columns.append(later)
    basis = np.stack(columns, axis=-1)
    tip = basis[:, 0].copy()
    tip[..., :2] = 0.0
    return Response(t_s, expected, hand[1], basis, tip, 2 + len(slopes))


def expected_nodes(
    identified: Identified,
    motion: Motion,
    at_s: FloatArray,
    arc_length_m: FloatArray,
    solver: Solver = Solver(),  # noqa: B008
) -> FloatArray:
    """(T, nodes, 2) of the most probable cable, m.  Raises what the engine raises."""
    model = identified.space.model(identified.mean)
    return np.asarray(simulate(model, motion, at_s, arc_length_m, solver=solver)[0])


def _end_detection_error(nodes_m: FloatArray, arc_length_m: FloatArray) -> FloatArray:
    """(T, nodes', 2) apparent displacement of the nodes if the end is detected `END_M` off."""
    along = np.gradient(nodes_m, axis=1)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    share = arc_length_m / arc_length_m.max()
    return np.asarray(END_M * share[::EVERY_NODE, None] * along[:, ::EVERY_NODE])


def _responses_at_rest(
    identified: Identified,
    motion: Motion,
    t_s: FloatArray,
    arc_length_m: FloatArray,
    solver: Solver,
) -> tuple[FloatArray, FloatArray]:
    model = identified.space.model(identified.mean)
    still = _resting(motion, t_s)
    kicks = [np.zeros((2, MODES))]
    for mode in range(MODES):
        kick = np.zeros((2, MODES))
        kick[1, mode] = _KICK
        kicks.append(kick)
    swings = simulate(
        [model] * len(kicks), still, t_s, arc_length_m, solver=solver, start="moving", bent=kicks
    )
    forces = np.cumsum(swings[1:] - swings[:1], axis=1)
    held = simulate(model, still, t_s, arc_length_m, solver=solver)[0]
    # a lasting force bends the tip to the mean of its last swings
    bent_m = np.linalg.norm(forces[:, len(t_s) // 2 :, 0].mean(axis=1), axis=-1)
    forces /= bent_m[:, None, None, None]
    moved = [
        replace(still, **{name: getattr(still, name) + _STEP_M * (still.t_s > -0.5 * _STEP_S)})
        for name in ("x_m", "y_m")
    ]
    hand = simulate([model] * 2, moved, t_s, arc_length_m, solver=solver) - held
    return forces, hand / _STEP_M


def _resting(motion: Motion, t_s: FloatArray) -> Motion:
    """The gripper at rest at its final pose, before time 0 and after."""
    grid = np.arange(-10.0, len(t_s) + 1.0) * _STEP_S
    ends = (np.full(len(grid), float(v[-1])) for v in (motion.x_m, motion.y_m, motion.angle_rad))
    return Motion(grid, *ends)


#: Prior standard deviations of a change at a knot, m: of the tip bent by a force, and of the
#: gripper.  The frames select among them by evidence.  The smallest add up to 0.01 mm at the tip in
#: a flight, the engine's own error.
FORCES_M = (1e-6, 3e-5, 2e-4, 1e-3)
GRIPPER_M = (1e-6, 3e-4)
#: Errors of consecutive frames are correlated: one frame in so many is used, and so many of these
#: count as one independent frame.
EVERY, ALIKE = 2, 2.0


@dataclass(frozen=True, eq=False)
class Deviation:
    """Estimated deviation of a cable's tip from the expected motion, m.

    tip_m       (T, 2) mean, at the response's times, the future included
    tips_m      (samples, T, 2) random samples of it
    misfit      of the frames, root mean square in standard deviations; about 1 = a good fit
    """

    tip_m: FloatArray
    tips_m: FloatArray
    misfit: float


def deviation(
    response: Response,
    t_s: FloatArray,
    nodes_m: FloatArray,
    std_m: float,
    samples: int = 32,
) -> Deviation:
    """Estimate the deviation, until the motion's end, from the frames so far.

    t_s      (frames,) after the commanded start
    nodes_m  (frames, nodes, 2) measured, nan = not detected
    std_m    of their noise
    source   Kalman & Bucy; batch form, as in Bar-Shalom, Li & Kirubarajan 2001, section 3.4
    """
    knots = 1 + int(t_s[-1] / KNOTS_S)  # no changes are estimated after the last frame
    unknowns = response.lasting + knots * (MODES + 2)
    tip = response.tip[..., :unknowns]
    t_s, nodes_m = t_s[::-EVERY], nodes_m[::-EVERY, ::EVERY_NODE]
    expected = _at(response.nodes_m[:, ::EVERY_NODE], t_s)
    basis = _at(response.basis[..., :unknowns], t_s)
    rows, known = (nodes_m - expected).ravel(), np.isfinite(nodes_m).ravel()
    weight = 1.0 / (std_m * np.sqrt(ALIKE))
    values = weight * rows[known]
    jacobian = weight * basis.reshape(len(rows), -1)[known]
    normal, right = jacobian.T @ jacobian, jacobian.T @ values
    best: tuple[float, FloatArray, FloatArray, FloatArray] | None = None
    for prior in _priors(response.lasting, knots):
        scaled = prior[:, None] * normal * prior
        factor = cho_factor(np.eye(len(prior)) + scaled, lower=True)
        z = cho_solve(factor, prior * right)
        log_evidence = 0.5 * float((prior * right) @ z) - float(np.log(np.diag(factor[0])).sum())
        if best is None or log_evidence > best[0]:
            best = log_evidence, prior, z, np.tril(factor[0])
    assert best is not None
    _, prior, z, root = best
    residual = values - jacobian @ (prior * z)
    drawn = np.random.default_rng(20260102).standard_normal((len(prior), samples))
    drawn = z[:, None] + solve_triangular(root.T, drawn, lower=False)
    return Deviation(
        tip @ (prior * z),
        np.moveaxis(tip @ (prior[:, None] * drawn), -1, 0),
        float(np.sqrt(np.mean(residual**2))) if len(residual) else 1.0,
    )


def _priors(lasting: int, knots: int) -> Iterator[FloatArray]:
    """(unknowns,) candidate prior standard deviations."""
    for force_m, hand_m in product(FORCES_M, GRIPPER_M):
        knot = [force_m / (mode + 1.0) ** 2 for mode in range(MODES)] + [hand_m] * 2
        yield np.array([1.0] * lasting + knot * knots)


def _at(values: FloatArray, t_s: FloatArray) -> FloatArray:
    """(frames, …) of (T, …) values sampled every `INTERVAL_S`."""
    place = np.clip(t_s / INTERVAL_S, 0.0, len(values) - 1.001)
    before = place.astype(int)
    share = (place - before).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((1.0 - share) * values[before] + share * values[before + 1])


#: Sampling interval of the tip, s.
_INTERVAL_S = 0.01


def time_to_rest_s(
    identified: Identified, motion: Motion, within_m: float, longest_s: float
) -> float:
    """Time from the end of a motion until the tip stays within a distance of its rest, s.

    motion     of the gripper, from a cable at rest on; it is held still afterwards
    within_m   distance of the tip from its place at rest
    longest_s  returned if it swings longer
    raises     as the engine
    """
    # `simulate` holds the gripper still after its log: a sample added there would make the spline
    # overshoot with the noise of the samples before it
    end_s = float(motion.t_s[-1])
    t_s = np.arange(end_s, end_s + longest_s, _INTERVAL_S)
    at_tip = np.array([identified.space.cable.length_m])
    tip_m = simulate(identified.model, motion, t_s, at_tip, solver=coarsened(Solver()))[0, :, 0]
    away_m = np.linalg.norm(tip_m - tip_m[-1], axis=1)
    swinging = np.flatnonzero(away_m > within_m)
    return 0.0 if not swinging.size else float(t_s[swinging[-1]] - end_s) + _INTERVAL_S
