"""A fit in the form in which a cable's model is kept, with intervals widened by its residual."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from cell.cable.effects import Effect
from cell.identify.fit import frames_detected, variance_inflation
from cell.identify.identified import Identified
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.all_trials_fit import AllTrialsFit
from cell.lab.fit.fitting import Fit, fit_trials
from cell.lab.strength.omitted_effect_bias import omitted_effect_bias


def identified(
    prepared: PreparedStudy, fit: Fit, effects: Iterable[type[Effect]] = ()
) -> Identified:
    """A fit in the form in which models are kept, with intervals widened by its residual.

    effects  that it may lack: where what is left is not noise, its parameters are as uncertain as
             they move with those in that explain it
    """
    trials = fit_trials(prepared)
    whiteners = [prepared.whiteners[t.name] for t in trials]
    solution, p = fit.solution, len(fit.q)
    inflation = variance_inflation(solution.residual, whiteners, len(solution.q))
    # What the data say is worth less by the inflation, what the prior says is not.
    precision = solution.jacobian.T @ solution.jacobian / inflation
    precision[:p, :p] += fit.space.precision
    precision[p:, p:] += np.diag(1.0 / fit.initial_state_std**2)
    noise_only = np.linalg.inv(precision)
    whole = AllTrialsFit(prepared, fit)
    by_hand = whole.systematic_error.covariance(noise_only[:p] @ solution.jacobian.T / inflation)
    unfinished = solution.unfinished[:p, :p]
    missed = omitted_effect_bias(whole, effects)
    return Identified(
        space=fit.space,
        mean=fit.q,
        covariance=np.asarray(noise_only[:p, :p] + by_hand + missed.covariance + unfinished),
        noise=prepared.expected,
        residual_rms_m=fit.rms_m,
        converged=fit.arrived,
        inflation=inflation,
        frames_used=sum(frames_detected(t) for t in trials),
        frames_total=sum(len(t.markers.t_s) for t in trials),
        iterations=fit.solution.iterations,
        method="map",
        gripper_covariance=by_hand,
        lacks=missed.effects,
    )
