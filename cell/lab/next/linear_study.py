"""The tests of a diagnosis as linear functions of a study's residual, near its fitted model.

A diagnosis uses few statistics of a residual: the score of each effect on the fitted trials, its
score on the held-out ones, and the parameter changes of single trials.  All are linear in the
whitened residual.  So their distribution is known for any hidden effect.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.fitting import Fit
from cell.lab.fit.projection import is_distinct, prior_root
from cell.lab.fit.sensitivity import one_sided
from cell.lab.fit.systematic_error import MOTIONS, AllTrialsFit
from cell.lab.verdict.check_statistics import directions_of_trials
from cell.lab.verdict.smooth_part import AllTrialsResidual, all_trials_residual


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """An effect in one shape: (amplitudes, rows) whitened change of all trials by each amplitude.

    alone      the same without a refit; None = as `rows`
    shapes     (shape parameters, rows) change by each shape parameter at the hidden size
    collinear  correlation, 0 … 1, with the hidden effect's change, projected off the parameters
    """

    effect: type[Effect]
    rows: FloatArray
    collinear: float = 1.0
    alone: FloatArray | None = None
    shapes: FloatArray | None = None

    @property
    def of_parameters(self) -> FloatArray:
        """(parameters, rows) change by each amplitude and shape parameter."""
        return self.rows if self.shapes is None else np.vstack([self.rows, self.shapes])


@dataclass(frozen=True, eq=False)
class LinearStudy:
    """A study linearised at its baseline, which is fitted to all trials.

    slopes  (rows, free) derivatives of the residual in the free coordinates
    fitted  (rows,) whether a value belongs to a fitted trial
    inner, inner_all  (free, free) information on the coordinates, the prior's included, from the
            fitted trials and from all trials
    """

    all_trials: AllTrialsFit
    residual: AllTrialsResidual
    slopes: FloatArray
    fitted: NDArray[np.bool_]
    inner: FloatArray
    inner_all: FloatArray

    @staticmethod
    def of(prepared: PreparedStudy, fit: Fit) -> LinearStudy:
        """The study linearised near a fitted baseline.

        raises  ValueError: a trial cannot be simulated
        """
        residual = all_trials_residual(prepared, fit)
        if residual is None:
            raise ValueError(
                f"study {prepared.study.name}: a trial cannot be simulated with the fitted model, "
                "so its power cannot be told; leave the trial out"
            )
        all_trials = residual.all_trials
        solution = all_trials.fit.solution
        slopes = solution.jacobian[:, solution.free]
        ends = all_trials.systematic_error.ends
        roles = [t.role == "fit" for t in prepared.study.trials]
        fitted = np.repeat(roles, np.diff(np.concatenate([[0], ends])))
        prior = _prior(all_trials.fit)[np.ix_(solution.free, solution.free)]
        of_fitted = slopes[fitted]
        return LinearStudy(
            all_trials,
            residual,
            slopes,
            fitted,
            of_fitted.T @ of_fitted + prior,
            slopes.T @ slopes + prior,
        )

    def project_out_fitted(self, rows: FloatArray) -> FloatArray:
        """(n, rows) projected off the coordinates in the fitted trials; 0 elsewhere."""
        inside = np.where(self.fitted, rows, 0.0)
        return np.where(self.fitted, inside - self._shift(inside) @ self.slopes.T, 0.0)

    def project_out_all(self, rows: FloatArray) -> FloatArray:
        """(n, rows) projected off the coordinates in all trials."""
        shift = np.linalg.solve(self.inner_all, self.slopes.T @ rows.T).T
        return np.asarray(rows - shift @ self.slopes.T)

    def heldout(self, rows: FloatArray) -> FloatArray:
        """(n, rows) change of the held-out trials after a fit to the others; 0 elsewhere."""
        inside = np.where(self.fitted, rows, 0.0)
        return np.where(self.fitted, 0.0, rows - self._shift(inside) @ self.slopes.T)

    def gls_weighted(self, held: FloatArray) -> FloatArray:
        """(n, rows) changes of held-out trials times the inverse of their covariance."""
        return np.where(self.fitted, 0.0, self.project_out_all(held))

    def heldout_scores(self, weighted: FloatArray) -> FloatArray:
        """(n, rows) functions of the residual equal to (n, rows) functions of the held-out one."""
        return weighted - np.where(self.fitted, self._shift(weighted) @ self.slopes.T, 0.0)

    def raw_m(self, held: FloatArray) -> FloatArray:
        """(n, values) changes (n, rows) before whitening, m."""
        parts = self.all_trials.systematic_error.by_trial(held)
        raw = [
            np.stack([np.nan_to_num(whitener.error_m(row)).ravel() for row in part])
            for whitener, part in zip(self.residual.whiteners, parts, strict=True)
        ]
        return np.concatenate(raw, axis=1)

    def _shift(self, inside: FloatArray) -> FloatArray:
        """(n, free) shift of the coordinates by changes of the fitted trials."""
        return np.asarray(np.linalg.solve(self.inner, self.slopes.T @ inside.T).T)

    def nearest_shape(self, effect: type[Effect], hidden: FloatArray) -> Sensitivities | None:
        """An effect in the shape that imitates a hidden change (rows,) best; None if it cannot."""
        (sensitivity,) = self.all_trials.sensitivities([effect])
        target = self.project_out_all(hidden[None])[0]
        best: Sensitivities | None = None
        for amplitudes in sensitivity.rows[..., : len(hidden)]:
            size = np.linalg.norm(amplitudes, axis=1)
            usable = amplitudes[size > 0.0] / size[size > 0.0, None]
            orthogonal = self.project_out_all(usable)
            distinct = [is_distinct(*of) for of in zip(orthogonal, usable, strict=True)]
            if not any(distinct):
                continue
            amplitude = np.linalg.lstsq(orthogonal[distinct].T, target, rcond=1e-8)[0]
            imitated = amplitude @ orthogonal[distinct]
            if one_sided(effect) and amplitude[0] < 0.0:
                imitated = np.zeros_like(target)
            share = float(np.linalg.norm(imitated)) / max(float(np.linalg.norm(target)), 1e-300)
            if best is None or share > best.collinear:
                best = Sensitivities(effect, usable[distinct], share)
        return best

    def scores_of_trials(self, other: FloatArray | None, p: float) -> tuple[FloatArray, float]:
        """Functions (n, rows) of the residual: scores of single trials' own parameters.

        other    (amplitudes, rows) of an effect whose values per trial are tested as well
        returns  the functions, and the sum of their squares whose half has a p-value of `p`
        """
        jacobian = self.slopes if other is None else np.column_stack([self.slopes, other.T])
        information, count = jacobian.T @ jacobian, self.slopes.shape[1]
        information[:count, :count] = self.inner_all
        ends = self.all_trials.systematic_error.ends
        parts = directions_of_trials(jacobian, np.linalg.inv(information), ends)
        directions = np.asarray(block_diag(*[part.T for part in parts]))
        functions = self.project_out_all(directions)
        return functions, self.residual.half_shows_from(functions @ functions.T, directions, p)

    def covariance(self, functions: FloatArray) -> FloatArray:
        """(n, n) covariance of functions (n, rows) of the residual, by noise and gripper log."""
        total = functions @ functions.T
        error = self.all_trials.systematic_error
        for motions, part in zip(
            error.by_trial(error.gripper_motions), error.by_trial(functions), strict=True
        ):
            change = part @ motions.T
            total = total + change @ change.T / MOTIONS
        return np.asarray(total)


def _prior(fit: Fit) -> FloatArray:
    """(q, q) information of the prior; for initial states without one, from their usual spread."""
    root, p = prior_root(fit), len(fit.q)
    inner = root.T @ root
    spread = np.concatenate([np.full(p, np.inf), fit.initial_state_std])
    return np.asarray(inner + np.diag(np.where(np.diag(inner) > 0.0, 0.0, spread**-2.0)))


def rivals_of(
    linear: LinearStudy, hidden: FloatArray, effects: Iterable[type[Effect]]
) -> list[Sensitivities]:
    """Effects in the shapes nearest to a hidden change (rows,), the most collinear first."""
    rivals = [s for e in effects if (s := linear.nearest_shape(e, hidden)) is not None]
    return sorted(rivals, key=lambda s: -s.collinear)


def own_sensitivities(
    linear: LinearStudy,
    effect: type[Effect],
    which: int,
    hidden: FloatArray,
    alone: FloatArray,
    shapes: FloatArray,
) -> Sensitivities | None:
    """Sensitivities of a hidden effect: its change (rows,), and slopes of its other parameters.

    which   index of the hidden amplitude among the effect's amplitudes
    hidden  residual of the change after a refit; alone: the change itself
    shapes  (shape parameters, rows) changes by a step of each of them
    returns  None where the parameters imitate it completely
    """
    (sensitivity,) = linear.all_trials.sensitivities([effect])
    other_rows = np.delete(sensitivity.rows[0][:, : len(hidden)], which, axis=0)
    rows, unfitted = np.vstack([hidden, other_rows]), np.vstack([alone, other_rows])
    size = np.linalg.norm(rows, axis=1)
    rows, unfitted = (r[size > 0.0] / size[size > 0.0, None] for r in (rows, unfitted))
    distinct = [is_distinct(*of) for of in zip(linear.project_out_all(rows), rows, strict=True)]
    if not size[0] > 0.0 or not distinct[0]:
        return None
    rows, unfitted = rows[distinct], unfitted[distinct]
    return Sensitivities(effect, rows, alone=unfitted, shapes=_not_imitated(linear, rows, shapes))


def _not_imitated(linear: LinearStudy, rows: FloatArray, shapes: FloatArray) -> FloatArray:
    """Unit changes by shape parameters that neither parameters nor other changes imitate."""
    units, basis = [], list(linear.project_out_all(rows))
    for shape in shapes[np.linalg.norm(shapes, axis=1) > 0.0]:
        unit = shape / np.linalg.norm(shape)
        rest = linear.project_out_all(unit[None])[0]
        rest = rest - np.linalg.lstsq(np.array(basis).T, rest, rcond=None)[0] @ np.array(basis)
        if is_distinct(rest, unit):
            units.append(unit)
            basis.append(rest)
    return np.array(units).reshape(-1, rows.shape[1])
