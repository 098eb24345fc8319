"""Test whether a residual is within the error that a study states."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtrc as chi2_sf

from cell.identify.gauss_newton import UNSIMULATED
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.all_trials_fit import of_all_trials
from cell.lab.fit.fitting import Fit, errors_m
from cell.lab.fit.heldout import heldout_rows
from cell.lab.search.fitted_model import FittedModel, residuals_m


def chance_of_stated(prepared: PreparedStudy, final: FittedModel, negligible: float) -> float:
    """p-value of the residual under the error of the markers that the study states.

    Fitted, held out (allowing for what the fit leaves uncertain there), and fitted to all trials
    together: a right model can do that.  A mean square of them is worth as many values as their
    correlation leaves independent, along the frames ((1 − ρ²) / (1 + ρ²), of a mean square) and
    between the markers.

    negligible  error over the stated one up to which the p-value is 1: a model errs by as much
    """
    noise_model = prepared.noise_model
    square_m2, again = noise_model.noise.std_m**2, noise_model.noise.ar1**2
    share = (1.0 - again) / (1.0 + again) / noise_model.correlated_channels
    left = [(errors_m(prepared, final.fit), 0.0)]
    if final.heldout is not None:
        if not np.isfinite(final.heldout.rms_m):
            return 0.0
        errors = residuals_m(prepared, final)
        held = [errors[t.name] for t in prepared.study.role("validate")]
        left.append((held, _uncertain_m2(prepared, final.fit)))
        try:
            whole = of_all_trials(prepared, final.fit)
        except UNSIMULATED:
            return 0.0
        left.append((errors_m(whole.prepared, whole.fit), 0.0))
    least = 1.0
    for some, uncertain_m2 in left:
        seen = np.concatenate([e[np.isfinite(e)] for e in some])
        ratio = float(np.mean(seen**2)) / (square_m2 + uncertain_m2)
        independent = share * len(seen)
        chance = float(chi2_sf(independent, independent * ratio))
        if ratio > negligible**2:
            least = min(least, chance)
    return least


def _uncertain_m2(prepared: PreparedStudy, fit: Fit) -> float:
    """Mean square of what a fit leaves uncertain of the held-out trials' markers; 0 if unknown."""
    rows = heldout_rows(prepared, fit)
    if not np.all(np.isfinite(rows.spread)):
        return 0.0
    square, count = 0.0, 0
    parts = np.split(rows.spread, rows.ends[:-1])
    for trial, part in zip(prepared.study.role("validate"), parts, strict=True):
        whitener = prepared.whiteners[trial.name]
        count += whitener.count
        square += sum(float(np.nansum(whitener.error_m(column) ** 2)) for column in part.T)
    return square / max(count, 1)
