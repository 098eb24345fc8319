"""The paper's own method: rigidity of every node from the still shape, N and C from the swing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Cable
from cell.cable.model import REFERENCE_CURVATURE_1_PER_M, REGULAR_CURVATURE_1_PER_M
from cell.identify import gauss_newton
from cell.identify.fit import (
    MINIMISER,
    FitError,
    FitOptions,
    frames_detected,
    predict,
    rms_m,
    still_noise,
    tip_error_m,
    variance_inflation,
    whiteners_of,
)
from cell.identify.identified import Identified
from cell.identify.noise import Noise, still_frames
from cell.identify.parameters import ParameterSpace, Prior
from cell.study.data import Trial


@dataclass(frozen=True)
class StillShape:
    """Moments and curvatures of a cable at rest, per hinge i = 0 (tip) … n−1, by the paper.

    arc_length_m  (n,) of the hinges, from the gripping point, m
    moment_n_m    (n,) bending moment of what hangs beyond, N·m
    curvature     (n,) bend angle per length that it spans, 1/m
    curvature_std (n,) its standard deviation, 1/m
    """

    arc_length_m: FloatArray
    moment_n_m: FloatArray
    curvature: FloatArray
    curvature_std: FloatArray

    @property
    def determined(self) -> NDArray[np.bool_]:
        """(n,) whether the curvature stands out of the noise, and has the moment's sign."""
        along: NDArray[np.bool_] = self.curvature * np.sign(self.moment_n_m) > 0.0
        return along & (np.abs(self.curvature) > 3.0 * self.curvature_std)


def still_shape(
    nodes_m: FloatArray,
    clamp_angle_rad: float,
    cable: Cable,
    gravity_m_per_s2: tuple[float, float],
    node_std_m: float,
) -> StillShape:
    """Moments and curvatures of a cable at rest, by the paper's (10) with its index corrected.

    nodes_m     (n+1, 2) mean still nodes, tip first, m
    node_std_m  standard deviation of a coordinate of them, m
    source      K_i φ_i = Σ_{k≤i} m_k g (x_{i+1} − x_k), which for equal masses is the corrected
                (10).  Departs: the tip carries half a mass, the hinge in the grip bends half a
                segment; both make the sum second-order accurate.  Near the tip φ_i vanishes while
                its noise, √6 node_std/l, does not: hinges with φ_i below three times that are
                not determined, see `rigidity`.
    """
    n = len(nodes_m) - 1
    length = cable.free_length_m / n
    steps = nodes_m[:-1] - nodes_m[1:]  # from P_{i+1} to P_i
    angle = np.arctan2(-steps[:, 1], -steps[:, 0])
    bend = angle - np.append(angle[1:], clamp_angle_rad)
    masses = np.full(n, cable.line_density_kg_per_m * length)
    masses[0] *= 0.5
    gx, gy = gravity_m_per_s2
    moment = np.empty(n)
    for i in range(n):
        arm = nodes_m[: i + 1] - nodes_m[i + 1]
        moment[i] = np.sum(masses[: i + 1] * (arm[:, 0] * gy - arm[:, 1] * gx))
    # a second difference of nodes over a segment; in the grip the clamp's angle is known, and the
    # paper's K_{n-1} is that of half a segment, which bends as the cable does at a third of it
    moment[-1] += (moment[-2] - moment[-1]) / 3.0
    span_m, noisy_nodes = np.full(n, length), np.full(n, 6.0)
    span_m[-1], noisy_nodes[-1] = 0.5 * length, 2.0
    return StillShape(
        length * np.arange(n - 1.0, -1.0, -1.0),
        moment,
        bend / span_m,
        np.sqrt(noisy_nodes) * node_std_m / (length * span_m),
    )


def rigidity(shape: StillShape, exponent: float) -> FloatArray:
    """(n+1,) EI at equally spaced knots from the gripping point, given N, N·m².

    The paper's K_i = moment/φ_i^N, as a property of the cable by `CableModel`'s law, not the mesh.
    Hinges that are not determined, and the tip, take the value of the next one towards the grip.
    raises  FitError: the hinge in the grip is itself not determined
    """
    if not shape.determined[-1]:
        raise FitError("the cable hardly bends at rest: its shape does not tell its rigidity")
    curvature = shape.curvature
    size = (curvature**2 + REGULAR_CURVATURE_1_PER_M**2) / REFERENCE_CURVATURE_1_PER_M**2
    from_grip = (shape.moment_n_m / (curvature * size ** (0.5 * (exponent - 1.0))))[::-1]
    source = np.where(shape.determined[::-1], np.arange(len(from_grip)), 0)
    filled = from_grip[np.maximum.accumulate(source)]
    return np.append(filled, filled[-1])


def fit_as_paper(
    trial: Trial,
    arc_length_m: FloatArray,
    cable: Cable,
    gravity_m_per_s2: tuple[float, float],
    *,
    noise: Noise | None = None,
    options: FitOptions = FitOptions(),  # noqa: B008
) -> Identified:
    """K_i from the still shape given N, N and C from the swing given K_i, iterated.

    trial         begins with still frames; markers at equal distances, tip first, the last at the
                  gripping point
    returns       EI at as many knots as there are markers
    raises        FitError: no still frames, too little bending
    source        the paper, sec. 4.  Departs: "select appropriate values" is least squares over
                  all frames, in which every trial value of N brings its own K_i
    """
    if noise is None:
        noise = still_noise([trial])
    n = len(arc_length_m) - 1
    if not np.allclose(arc_length_m, np.linspace(cable.free_length_m, 0.0, n + 1)):
        raise FitError("the paper's method needs nodes at equal distances from tip to grip")
    if not np.any(gravity_m_per_s2):
        raise FitError("the paper's method needs gravity in the plane")
    still = trial.markers.xy_m[still_frames(trial.markers.t_s, trial.grip)]
    still = still[np.isfinite(still).all((1, 2))]
    if len(still) == 0:
        raise FitError("the cable is not seen at rest")
    independent = len(still) * (1.0 - noise.ar1) / (1.0 + noise.ar1)
    node_std_m = noise.std_m / np.sqrt(max(1.0, independent))
    shape = still_shape(
        still.mean(0), float(trial.grip.angle_rad[0]), cable, gravity_m_per_s2, node_std_m
    )
    space = ParameterSpace.of(cable, gravity_m_per_s2=gravity_m_per_s2, prior=Prior(knots=n + 1))
    whiteners = whiteners_of([trial], noise)

    def coordinates(swing: FloatArray) -> FloatArray:
        return np.concatenate([np.log(rigidity(shape, float(swing[0]))), swing])

    def residuals(lanes: FloatArray) -> FloatArray:
        models = [space.model(coordinates(swing)) for swing in lanes]
        return whiteners[0](predict(trial, models, arc_length_m, options.solver))

    swing = slice(n + 1, n + 3)
    problem = gauss_newton.LeastSquaresProblem(
        residuals,
        space.mean[swing],
        space.precision[swing, swing],
        space.step[swing],
        space.low[swing],
        space.high[swing],
    )
    solution = gauss_newton.minimise(problem, _best_start(residuals, space.mean[swing]), MINIMISER)
    inflation = variance_inflation(solution.residual, whiteners, len(space.mean))
    return Identified(
        space=space,
        mean=coordinates(solution.q),
        covariance=_covariance(shape, solution, inflation),
        noise=noise,
        residual_rms_m=rms_m(solution.residual, whiteners),
        inflation=inflation,
        frames_used=frames_detected(trial),
        frames_total=len(trial.markers.t_s),
        iterations=solution.iterations,
        method="paper",
        gripper_covariance=np.zeros((n + 3, n + 3)),
        model_error_m=tip_error_m(solution.residual, whiteners, arc_length_m, noise),
        converged=solution.converged,
    )


def _best_start(residuals: gauss_newton.Residuals, mean: FloatArray) -> FloatArray:
    """N and log C that fit best among a few of each: the swing has many local minima in N."""
    exponents, dampings = np.linspace(0.7, 1.3, 8), np.array([-1.0, 1.0])
    starts = np.array([[e, mean[1] + d] for e in exponents for d in dampings])
    cost = np.sum(residuals(starts) ** 2, axis=1)
    best: FloatArray = starts[int(np.argmin(cost))]
    return best


def _covariance(shape: StillShape, solution: gauss_newton.Solution, inflation: float) -> FloatArray:
    """Node noise in every K_i, and N's uncertainty in all of them."""
    exponent = float(solution.q[0])
    h = 1e-4
    by_exponent = np.log(rigidity(shape, exponent + h) / rigidity(shape, exponent)) / h
    carried = np.vstack([np.column_stack([by_exponent, np.zeros_like(by_exponent)]), np.eye(2)])
    bends = shape.curvature[::-1]
    source = np.where(shape.determined[::-1], np.arange(len(bends)), 0)
    known = np.append(np.maximum.accumulate(source), source.max())
    relative = exponent * shape.curvature_std[::-1] / bends
    from_noise = np.zeros((len(known) + 2, len(known) + 2))
    from_noise[:-2, :-2] = np.outer(relative[known], relative[known]) * (
        known[:, None] == known[None, :]
    )
    return from_noise + inflation * carried @ solution.covariance @ carried.T
