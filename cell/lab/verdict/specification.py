"""Specification tests of a residual: parameters per trial, wider laws, other effects."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.gaussian import parameters_root
from cell.lab.data.prepared import PreparedStudy, once_per_study
from cell.lab.fit.fitting import Fit
from cell.lab.strength.estimate import LEAST_KNOWN
from cell.lab.verdict.smooth_part import (
    AllTrialsResidual,
    SmoothPart,
    all_trials_residual,
    noise_was_seen,
)

#: Nothing is asked for in directions of an effect that change less than by this share.
LEAST_ASKED = 1e-6


@once_per_study
def parameter_constancy_of(
    prepared: PreparedStudy, fit: Fit, parameters: Fit | None = None
) -> SmoothPart | None:
    """Test of the changes of the model's parameters if each trial had parameters of its own.

    A right model is the same in every trial.  A wrong one must bend for each motion, and does so
    in these few directions: far from noise where all that is smooth still looks like it.

    parameters  the model whose parameters are asked, if it is another: one with an effect more
    """
    if not noise_was_seen(prepared):
        return None
    left, asked = (
        all_trials_residual(prepared, fit),
        all_trials_residual(prepared, parameters or fit),
    )
    if left is None or asked is None:
        return None
    solution = asked.whole.fit.solution
    free = solution.free
    slopes = solution.jacobian[:, free]
    parts = directions_of_trials(
        slopes, solution.covariance[np.ix_(free, free)], left.whole.systematic_error.ends
    )
    bases = dict(zip(left.whiteners, parts, strict=True))
    return left.part(lambda whitener, rows: np.asarray(bases[whitener].T @ rows))


def directions_of_trials(
    slopes: FloatArray, covariance: FloatArray, ends: NDArray[np.intp]
) -> list[FloatArray]:
    """Per trial (rows, directions) orthonormal: by what it shows of parameters of its own.

    slopes      (rows, free) of all trials, which end at `ends`
    covariance  (free, free) of what all trials and the prior leave open
    """
    found = []
    for part in np.split(slopes @ parameters_root(covariance), ends[:-1]):
        units, sizes, _ = np.linalg.svd(part, full_matrices=False)
        found.append(units[:, sizes**2 > LEAST_KNOWN])
    return found


def wider_law_of(prepared: PreparedStudy, fit: Fit, effect: type[Effect]) -> SmoothPart | None:
    """Of what an effect's wider law would explain beside it; None without one.

    If an effect is present, its own law explains everything.  One in the place of another, which no
    library has, leaves a little of it, the same in every trial, and in these few directions.
    """
    left = None if effect.wider is None else all_trials_residual(prepared, fit)
    if effect.wider is None or left is None:
        return None
    directions = _directions(left, left.whole.sensitivities([effect.wider])[0].rows[0])
    return left.judged(directions @ left.every.T) if len(directions) else None


def of_effects(
    prepared: PreparedStudy, fit: Fit, effects: Sequence[type[Effect]]
) -> dict[str, tuple[SmoothPart, float]]:
    """Of what each of some effects would explain beside the model: the plainest of its shapes.

    returns  by name, with the p-value of the plainest of so many; without those that change nothing
             that the parameters do not, and empty where a trial cannot be simulated
    """
    left = all_trials_residual(prepared, fit)
    found: dict[str, tuple[SmoothPart, float]] = {}
    for slopes in [] if left is None else left.whole.sensitivities(effects):
        assert left is not None
        ways = [d for rows in slopes.rows if len(d := _directions(left, rows))]
        parts = [left.judged(directions @ left.every.T) for directions in ways]
        if parts:
            best = min(parts, key=lambda part: part.p_value)
            found[slopes.effect.name] = best, min(1.0, len(parts) * best.p_value)
    return found


def _directions(left: AllTrialsResidual, rows: FloatArray) -> FloatArray:
    """(directions, values) orthonormal, of what changes (n, values) do that nothing fitted does."""
    units, sizes, _ = np.linalg.svd(left.whole.linear.seen(rows).T, full_matrices=False)
    return np.asarray(units[:, sizes > LEAST_ASKED * float(np.linalg.norm(rows))].T)
