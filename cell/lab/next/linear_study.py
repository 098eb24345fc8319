"""The tests of a diagnosis as linear functions of a study's residual, near its fitted model.

A diagnosis looks at a residual through few numbers: the score of each effect on the trials fitted
to, its score on those held out, and what single trials would change in the parameters.  All are
linear in the whitened residual.  So their distribution is known for any hidden effect.
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
from cell.lab.fit.all_trials_fit import AllTrialsFit
from cell.lab.fit.fitting import Fit
from cell.lab.fit.projection import prior_root
from cell.lab.fit.sensitivity import one_sided
from cell.lab.fit.systematic_error import MOTIONS
from cell.lab.verdict.check_statistics import directions_of_trials
from cell.lab.verdict.smooth_part import AllTrialsResidual, all_trials_residual

#: Less of a change than this share is not told from what the fitted parameters do.
LEAST_LEFT = 1e-4


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """An effect in one shape: (amplitudes, rows) whitened change of all trials by each amplitude.

    alone      the same with nothing refitted; None = as `rows`
    shapes     (shape parameters, rows) change by each shape parameter at the hidden size
    collinear  share of the hidden effect's change, of what no fitted parameter imitates, that
               these imitate: a correlation, 0 … 1
    """

    effect: type[Effect]
    rows: FloatArray
    collinear: float = 1.0
    alone: FloatArray | None = None
    shapes: FloatArray | None = None

    @property
    def of_parameters(self) -> FloatArray:
        """(parameters, rows) by each amplitude and shape parameter."""
        return self.rows if self.shapes is None else np.vstack([self.rows, self.shapes])


@dataclass(frozen=True, eq=False)
class LinearStudy:
    """A study linearised at its baseline, which is fitted to all trials.

    slopes  (rows, free) derivatives of the residual in the free coordinates
    fitted  (rows,) whether a value is of a trial that the diagnosis fits to
    inner, inner_all  (free, free) information on the coordinates, with the prior's, by the trials
            fitted to, and by all
    """

    all_trials: AllTrialsFit
    residual: AllTrialsResidual
    slopes: FloatArray
    fitted: NDArray[np.bool_]
    inner: FloatArray
    inner_all: FloatArray

    @staticmethod
    def of(prepared: PreparedStudy, fit: Fit) -> LinearStudy:
        """Near a baseline fitted to a study.

        raises  ValueError: a trial cannot be simulated
        """
        left = all_trials_residual(prepared, fit)
        if left is None:
            raise ValueError(
                f"study {prepared.study.name}: a trial cannot be simulated with the fitted model, "
                "so its power cannot be told; leave the trial out"
            )
        whole = left.whole
        solution = whole.fit.solution
        slopes = solution.jacobian[:, solution.free]
        ends = whole.systematic_error.ends
        roles = [t.role == "fit" for t in prepared.study.trials]
        fitted = np.repeat(roles, np.diff(np.concatenate([[0], ends])))
        known = _prior(whole.fit)[np.ix_(solution.free, solution.free)]
        of_fitted = slopes[fitted]
        return LinearStudy(
            whole,
            left,
            slopes,
            fitted,
            of_fitted.T @ of_fitted + known,
            slopes.T @ slopes + known,
        )

    def project_out_fitted(self, rows: FloatArray) -> FloatArray:
        """(n, rows) without what the coordinates imitate in the trials fitted to; 0 elsewhere."""
        inside = np.where(self.fitted, rows, 0.0)
        return np.where(self.fitted, inside - self._answer(inside) @ self.slopes.T, 0.0)

    def project_out_all(self, rows: FloatArray) -> FloatArray:
        """(n, rows) without what the coordinates imitate in all trials."""
        moved = np.linalg.solve(self.inner_all, self.slopes.T @ rows.T).T
        return np.asarray(rows - moved @ self.slopes.T)

    def heldout(self, rows: FloatArray) -> FloatArray:
        """(n, rows) change of the held-out trials once the others were fitted; 0 elsewhere."""
        inside = np.where(self.fitted, rows, 0.0)
        return np.where(self.fitted, 0.0, rows - self._answer(inside) @ self.slopes.T)

    def gls_weighted(self, held: FloatArray) -> FloatArray:
        """(n, rows) changes of held-out trials by the inverse of what is uncertain of them."""
        return np.where(self.fitted, 0.0, self.project_out_all(held))

    def heldout_scores(self, weighed: FloatArray) -> FloatArray:
        """(n, rows) functions of the whole residual that are (n, rows) of the held-out one."""
        return weighed - np.where(self.fitted, self._answer(weighed) @ self.slopes.T, 0.0)

    def raw_m(self, held: FloatArray) -> FloatArray:
        """(n, values) of changes (n, rows), m, as they were before they were whitened."""
        parts = self.all_trials.systematic_error.by_trial(held)
        raw = [
            np.stack([np.nan_to_num(whitener.error_m(row)).ravel() for row in part])
            for whitener, part in zip(self.residual.whiteners, parts, strict=True)
        ]
        return np.concatenate(raw, axis=1)

    def _answer(self, inside: FloatArray) -> FloatArray:
        """(n, free) by which the coordinates follow changes of the trials fitted to."""
        return np.asarray(np.linalg.solve(self.inner, self.slopes.T @ inside.T).T)

    def nearest_shape(self, effect: type[Effect], hidden: FloatArray) -> Sensitivities | None:
        """An effect in the shape that imitates a hidden change (rows,) best; None if it cannot."""
        (found,) = self.all_trials.sensitivities([effect])
        unlike = self.project_out_all(hidden[None])[0]
        best: Sensitivities | None = None
        for amplitudes in found.rows[..., : len(hidden)]:
            size = np.linalg.norm(amplitudes, axis=1)
            usable = amplitudes[size > 0.0] / size[size > 0.0, None]
            left = self.project_out_all(usable)
            seen = np.linalg.norm(left, axis=1) > LEAST_LEFT
            if not seen.any():
                continue
            answer = np.linalg.lstsq(left[seen].T, unlike, rcond=1e-8)[0]
            imitated = answer @ left[seen]
            if one_sided(effect) and answer[0] < 0.0:
                imitated = np.zeros_like(unlike)
            size_of = float(np.linalg.norm(imitated)) / max(float(np.linalg.norm(unlike)), 1e-300)
            if best is None or size_of > best.collinear:
                best = Sensitivities(effect, usable[seen], size_of)
        return best

    def scores_of_trials(self, other: FloatArray | None, p: float) -> tuple[FloatArray, float]:
        """Functions (n, rows) of the residual that single trials' own parameters would explain.

        other    (amplitudes, rows) of an effect whose values per trial are tested as well
        returns  with the sum of their squares of which half has a p-value of `p`
        """
        asked = self.slopes if other is None else np.column_stack([self.slopes, other.T])
        known, count = asked.T @ asked, self.slopes.shape[1]
        known[:count, :count] = self.inner_all
        ends = self.all_trials.systematic_error.ends
        parts = directions_of_trials(asked, np.linalg.inv(known), ends)
        directions = np.asarray(block_diag(*[part.T for part in parts]))
        functions = self.project_out_all(directions)
        return functions, self.residual.half_shows_from(functions @ functions.T, directions, p)

    def covariance(self, functions: FloatArray) -> FloatArray:
        """(n, n) of functions (n, rows) of the residual, by noise and the gripper log."""
        found = functions @ functions.T
        errs = self.all_trials.systematic_error
        for hands, part in zip(
            errs.by_trial(errs.gripper_motions), errs.by_trial(functions), strict=True
        ):
            moved = part @ hands.T
            found = found + moved @ moved.T / MOTIONS
        return np.asarray(found)


def _prior(fit: Fit) -> FloatArray:
    """(q, q) information of the prior; of a trial's beginning that has none, its usual spread."""
    root, p = prior_root(fit), len(fit.q)
    known = root.T @ root
    spread = np.concatenate([np.full(p, np.inf), fit.initial_state_std])
    return np.asarray(known + np.diag(np.where(np.diag(known) > 0.0, 0.0, spread**-2.0)))


def rivals_of(
    linear: LinearStudy, hidden: FloatArray, effects: Iterable[type[Effect]]
) -> list[Sensitivities]:
    """Effects in the shapes nearest to a hidden change (rows,), the most collinear first."""
    found = [s for e in effects if (s := linear.nearest_shape(e, hidden)) is not None]
    return sorted(found, key=lambda s: -s.collinear)


def own_sensitivities(
    linear: LinearStudy,
    effect: type[Effect],
    which: int,
    hidden: FloatArray,
    alone: FloatArray,
    shapes: FloatArray,
) -> Sensitivities | None:
    """Sensitivities of a hidden effect: its change (rows,), and slopes of its other parameters.

    which   number of the amplitude that is hidden, among the effect's amplitudes
    hidden  what a refit leaves of the change; alone: the change itself
    shapes  (shape parameters, rows) changes by a little of each of them
    returns  None where nothing of it is left given the parameters
    """
    (found,) = linear.all_trials.sensitivities([effect])
    others = np.delete(found.rows[0][:, : len(hidden)], which, axis=0)
    rows, direct = np.vstack([hidden, others]), np.vstack([alone, others])
    size = np.linalg.norm(rows, axis=1)
    rows, direct = (r[size > 0.0] / size[size > 0.0, None] for r in (rows, direct))
    left = np.linalg.norm(linear.project_out_all(rows), axis=1)
    if not size[0] > 0.0 or left[0] < LEAST_LEFT:
        return None
    rows, direct = rows[left > LEAST_LEFT], direct[left > LEAST_LEFT]
    return Sensitivities(effect, rows, alone=direct, shapes=_not_imitated(linear, rows, shapes))


def _not_imitated(linear: LinearStudy, rows: FloatArray, shapes: FloatArray) -> FloatArray:
    """Unit changes by shape parameters that neither parameters nor others (n, rows) imitate."""
    kept, known = [], list(linear.project_out_all(rows))
    for shape in shapes[np.linalg.norm(shapes, axis=1) > 0.0]:
        unit = shape / np.linalg.norm(shape)
        left = linear.project_out_all(unit[None])[0]
        left = left - np.linalg.lstsq(np.array(known).T, left, rcond=None)[0] @ np.array(known)
        if np.linalg.norm(left) > LEAST_LEFT:
            kept.append(unit)
            known.append(left)
    return np.array(kept).reshape(-1, rows.shape[1])
