"""A model fitted to many cables at once: shared effects; EI(s), N and viscosity of each cable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc as chi2_sf

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.identify import gauss_newton
from cell.identify.fit import variance_inflation
from cell.identify.noise import across
from cell.identify.parameters import ParameterSpace
from cell.lab.data.noise_model import noise_model_of
from cell.lab.data.prepared import ERROR_RATIO, PreparedStudy, arcs_are_uncertain
from cell.lab.data.work import Work
from cell.lab.fit.corrections import lines_of
from cell.lab.fit.fitting import space_with
from cell.study.data import Study, Trial

#: Standard deviation of a marker's constant error along the cable in all its images, m.
BIAS_M = 5e-5
#: Its error of 0.02 mm is of the size of the bias; half the cost of the lab's solver.
SOLVER = Solver(segments=24, step_s=1.5e-3)
PASSES = gauss_newton.Options(tolerance=0.3, max_iterations=10, least_gain=1e-3, updates=3)


def prepared_cycle(study: Study, work: Work | None = None) -> PreparedStudy:
    """The prepared study of a cycle; simulations count as `work`.  Raises NoiseUnknownError."""
    noise_model = noise_model_of(study)
    noise = replace(noise_model.noise, bias_m=BIAS_M)
    return PreparedStudy(study, noise_model, noise, {}, SOLVER, work or Work()).rewhitened()


def along_lines(fit: SharedFit) -> list[PreparedStudy] | None:
    """The cables with uncertain marker arc lengths, as shifts along a fitted model's centreline.

    returns  None if the model does not explain the cables (the measured line is more accurate then)
             or if there is no further cable with such markers
    """
    if fit.rms_m > ERROR_RATIO * fit.noise_m:
        return None
    cables, changed = [], False
    for i, cable in enumerate(fit.cables):
        if not cable.lines and arcs_are_uncertain(cable.study):
            lines = lines_of(cable, fit.model(i), {})
            cable, changed = cable.rewhitened(lines=lines), True
        cables.append(cable)
    return cables if changed else None


def simulated_s(cable: PreparedStudy) -> float:
    """Work of one simulation of a cable in all its trials, s."""
    spans = (float(t.markers.t_s[-1] - t.markers.t_s[0]) for t in cable.study.trials)
    return Work.cost(cable.solver) * sum(spans)


@dataclass(frozen=True, eq=False)
class SharedFit:
    """A model class fitted to several cables.

    space      of one cable: first its own coordinates, then those that all share
    own        number of a cable's own coordinates
    common     (m,) which coordinates of `space` are shared
    q          (cables, own)
    theta      (m,) shared coordinates
    solution   joint: q of every cable, then theta
    rows       of the solution's residual, per cable
    inflation  variance factor for residuals larger or more autocorrelated than the noise
    """

    cables: tuple[PreparedStudy, ...]
    space: ParameterSpace
    own: int
    common: NDArray[np.int64]
    q: FloatArray
    theta: FloatArray
    solution: gauss_newton.Solution
    rows: tuple[slice, ...]
    inflation: float

    @property
    def chi2(self) -> float:
        """Square of all white residuals, and the prior's term."""
        return self.solution.objective

    @property
    def chi2_by_cable(self) -> FloatArray:
        """(cables,) square of the white residuals."""
        return np.array([float(np.sum(self.solution.residual[r] ** 2)) for r in self.rows])

    @property
    def noise_m(self) -> float:
        """Mean noise of the cables, m."""
        return float(np.mean([c.noise.std_m for c in self.cables]))

    @property
    def rms_m(self) -> float:
        """Residual per coordinate, in units of each cable's noise, times the mean noise, m."""
        count = sum(w.count for c in self.cables for w in c.whiteners.values())
        return self.noise_m * float(np.sqrt(self.chi2_by_cable.sum() / count))

    def coordinates(self, i: int) -> FloatArray:
        """(p,) of a cable, its own and the shared ones."""
        q = self.space.mean.copy()
        q[: self.own], q[self.common] = self.q[i], self.theta
        return q

    def model(self, i: int) -> CableModel:
        """The model of one cable."""
        return self.space.model(self.coordinates(i))

    def natural(self, theta: FloatArray | None = None) -> FloatArray:
        """Natural values of a cable's parameters, its own at their mean, the shared ones at theta.

        theta  None = as fitted
        """
        q = self.space.mean.copy()
        q[self.common] = self.theta if theta is None else theta
        return np.asarray(self.space.natural(q))

    @property
    def shared_values(self) -> FloatArray:
        """Natural values of all parameters of the shared effects, those not fitted included."""
        return self.natural()[self.own :]

    @property
    def end_std_m(self) -> float:
        """Standard deviation of the observed position of an end along its cable: rms of all, m.

        From the bias of images, and an uncertain arc length of the marker there.
        """
        stds = [c.study.arc_length_std_m for c in self.cables]
        squares = [0.0 if s is None else float(s[0]) ** 2 for s in stds]
        return float(np.sqrt(BIAS_M**2 + np.mean(squares)))

    @cached_property
    def end_offset_m(self) -> FloatArray:
        """(cables,) mean offset of a cable's observed end from the fitted one, along it, m."""
        offsets = np.empty(len(self.cables))
        for i, cable in enumerate(self.cables):
            predicted = cable.predict_all(cable.study.trials, [self.model(i)])
            along_m = [
                np.sum((trial.markers.xy_m[:, 0] - points[0, :, 0]) * along_end(trial), axis=1)
                for trial, points in zip(cable.study.trials, predicted, strict=True)
            ]
            offsets[i] = np.nanmean(np.concatenate(along_m))
        return offsets

    @cached_property
    def _information(self) -> tuple[FloatArray, FloatArray]:
        """(cables, m, m) Fisher information of each cable on theta, and (cables, m) its score."""
        m, jacobian = len(self.theta), self.solution.jacobian
        precision = self.space.precision[: self.own, : self.own]
        information, scores = np.zeros((len(self.cables), m, m)), np.zeros((len(self.cables), m))
        for i, rows in enumerate(self.rows):
            a = jacobian[rows, i * self.own : (i + 1) * self.own]
            b = jacobian[rows, len(self.cables) * self.own :]
            r = self.solution.residual[rows]
            inner = a.T @ a + precision
            offset = self.q[i] - self.space.mean[: self.own]
            information[i] = b.T @ b - b.T @ a @ np.linalg.solve(inner, a.T @ b)
            scores[i] = -(b.T @ r - b.T @ a @ np.linalg.solve(inner, a.T @ r + precision @ offset))
        return information, scores

    @property
    def covariance(self) -> FloatArray:
        """(m, m) of theta."""
        information = self._information[0].sum(axis=0) + self._weak
        return np.asarray(self.inflation * np.linalg.inv(information))

    @property
    def by_cable(self) -> tuple[FloatArray, FloatArray]:
        """(cables, m) theta estimated from each cable alone, (cables, m) standard deviations."""
        information, scores = self._information
        covariances = [np.linalg.inv(t + self._weak) for t in information]
        values = np.array([self.theta + v @ p for v, p in zip(covariances, scores, strict=True)])
        return values, np.sqrt(self.inflation * np.array([np.diag(v) for v in covariances]))

    def without(self, i: int) -> FloatArray:
        """(m,) theta from all cables but one, to first order, within its bounds."""
        information, scores = self._information
        remaining = information.sum(axis=0) - information[i] + self._weak
        theta = self.theta - np.linalg.solve(remaining, scores[i])
        return np.clip(theta, self.space.low[self.common], self.space.high[self.common])

    @property
    def _weak(self) -> FloatArray:
        return np.asarray(self.space.precision[np.ix_(self.common, self.common)])


def along_end(trial: Trial) -> FloatArray:
    """(T, 2) unit tangents at the tip, from the measured markers."""
    normal = across(trial.markers.xy_m)[:, 0]
    return np.stack([normal[:, 1], -normal[:, 0]], axis=1)


@dataclass(frozen=True)
class Spread:
    """Spread of an amplitude between cables.

    tau      standard deviation between cables, in excess of their uncertainties
    q        Cochran's Q with its degrees of freedom and p-value
    """

    tau: float
    q: float
    dof: int
    p_value: float

    @staticmethod
    def of(values: FloatArray, std: FloatArray) -> Spread:
        """The spread of the cables' own values.

        source  restricted maximum likelihood by fixed-point iteration: Viechtbauer 2005, J. Educ.
                Behav. Stat. 30, 261; Q: Cochran 1954, Biometrics 10, 101
        """
        v, dof = std**2, len(values) - 1
        if dof < 1:
            return Spread(0.0, 0.0, 0, 1.0)
        w = 1.0 / v
        q = float(np.sum(w * (values - np.average(values, weights=w)) ** 2))
        tau2 = max(0.0, (q - dof) / float(w.sum() - (w**2).sum() / w.sum()))
        for _ in range(100):
            w = 1.0 / (v + tau2)
            mean = np.average(values, weights=w)
            fit = float(np.sum(w**2 * ((values - mean) ** 2 - v)) / np.sum(w**2) + 1.0 / w.sum())
            if abs(max(0.0, fit) - tau2) < 1e-9 * float(v.mean()):
                break
            tau2 = max(0.0, fit)
        return Spread(float(np.sqrt(tau2)), q, dof, float(chi2_sf(dof, q)))


def fit_shared(
    cables: Sequence[PreparedStudy],
    base: ParameterSpace,
    q: FloatArray,
    effects: Sequence[type[Effect]] = (),
    values: FloatArray | None = None,
    *,
    options: gauss_newton.Options = PASSES,
) -> SharedFit:
    """Fit all cables at once.

    base     parameters of one cable without the shared effects, with their prior
    q        (cables, own) where to start, in coordinates of `base`
    effects  shared by all cables
    values   (parameters of `effects`) natural values to start from
    raises   ValueError: a cable cannot be simulated at the start
    """
    space = space_with(base, (*base.effects, *effects)) if effects else base
    own = len(base.names)
    common = np.array(
        [i for i in range(own, len(space.names)) if space.high[i] > space.low[i]], dtype=np.int64
    )
    start = space.mean.copy()
    if values is not None:
        natural = space.natural(start)
        natural[own:] = values
        start = space.coordinates(natural)
    sizes = [sum(c.whiteners[t.name].rows for t in c.study.trials) for c in cables]
    rows = [slice(*ends) for ends in pairwise(np.cumsum([0, *sizes]).tolist())]
    problem = _joint_problem(cables, space, own, common, start, rows)
    begin_at = np.concatenate([q[:, :own].ravel(), start[common]])
    solution = gauss_newton.minimise(problem, begin_at, options)
    whiteners = [c.whiteners[t.name] for c in cables for t in c.study.trials]
    return SharedFit(
        tuple(cables),
        space,
        own,
        common,
        solution.q[: len(q) * own].reshape(len(q), own),
        solution.q[len(q) * own :],
        solution,
        tuple(rows),
        variance_inflation(solution.residual, whiteners, len(solution.q)),
    )


def _joint_problem(
    cables: Sequence[PreparedStudy],
    space: ParameterSpace,
    own: int,
    common: NDArray[np.int64],
    start: FloatArray,
    rows: Sequence[slice],
) -> gauss_newton.LeastSquaresProblem:
    """Least-squares problem of all cables: each cable's own coordinates, then the common ones.

    start  coordinates of parameters that are not fitted
    """
    n, m = len(cables), len(common)

    def residuals(lanes: FloatArray) -> FloatArray:
        out = np.empty((len(lanes), rows[-1].stop))
        for i, (cable, row) in enumerate(zip(cables, rows, strict=True)):
            mine = np.hstack([lanes[:, i * own : (i + 1) * own], lanes[:, n * own :]])
            changed = np.any(mine != mine[0], axis=1)
            needed = np.concatenate([[0], np.flatnonzero(changed)])
            full = np.tile(start, (len(needed), 1))
            full[:, :own] = mine[needed, :own]
            full[:, common] = mine[needed, own:]
            white = cable.all_white(cable.study.trials, [space.model(v) for v in full])
            out[:, row] = white[0]
            out[needed, row] = white
        return out

    precision = np.zeros((n * own + m, n * own + m))
    for i in range(n):
        block = slice(i * own, (i + 1) * own)
        precision[block, block] = space.precision[:own, :own]
    precision[n * own :, n * own :] = space.precision[np.ix_(common, common)]

    def joined(each: FloatArray) -> FloatArray:
        return np.concatenate([np.tile(each[:own], n), each[common]])

    return gauss_newton.LeastSquaresProblem(
        residuals,
        joined(space.mean),
        precision,
        joined(space.step),
        joined(space.low),
        joined(space.high),
    )
