"""A fitted model on the held-out trials: error, likelihood, and uncertainty from the fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.cable.model import CableModel
from cell.identify.gaussian import marginal_chi2, parameters_root
from cell.identify.parameters import difference_points
from cell.lab.data.prepared import PreparedStudy, once_per_study
from cell.lab.fit.fitting import Fit, best_initial_state, extended, rms_of
from cell.study.data import Markers, Trial


@dataclass(frozen=True, eq=False)
class Heldout:
    """A fitted model on trials that it was not fitted to.

    rms_m            per coordinate, over all of them; forces included (scaled by their noise)
    markers_rms_m    of the markers alone
    chi2             of the residuals, given the covariance of the prediction: about `count` if the
                     model is right
    log_likelihood   of the trials given the fit (natural logarithm, without a common constant)
    predicted_m      per trial (times, markers, 2)
    """

    rms_m: float
    markers_rms_m: float
    chi2: float
    count: int
    log_likelihood: float
    predicted_m: dict[str, FloatArray]


@dataclass(frozen=True, eq=False)
class HeldoutRows:
    """Whitened residuals of held-out trials, and their derivatives by the uncertain parameters.

    predicted_m    per trial (times, markers, 2)
    residual       (rows,) of all trials
    by_parameters  (rows, p) change per unit of the fit's coordinates
    by_states      (rows, unknowns) change by a standard deviation of each unknown of the trials'
                   initial states
    spread         (rows, k) root of the prediction's covariance, parameters and initial states
    initial_states by trial (unknowns,) the likeliest ones
    """

    predicted_m: dict[str, FloatArray]
    residual: FloatArray
    by_parameters: FloatArray
    by_states: FloatArray
    spread: FloatArray
    initial_states: dict[str, FloatArray]


def heldout(prepared: PreparedStudy, fit: Fit) -> Heldout | None:
    """The fit on the `validate` trials; None if there are none.

    Their likelihood integrates over the uncertain parameters (linearised), so that a model is not
    penalised for parameters that its fit trials do not determine.  A model with which a held-out
    trial cannot be simulated has likelihood 0 and infinite errors.
    """
    trials = prepared.study.role("validate")
    if not trials:
        return None
    rows = heldout_rows(prepared, fit)
    count, predicted_m = prepared.count(trials), rows.predicted_m
    if not (np.all(np.isfinite(rows.residual)) and np.all(np.isfinite(rows.by_parameters))):
        return Heldout(np.inf, np.inf, np.inf, count, -np.inf, predicted_m)
    chi2, log_det = marginal_chi2(rows.residual, rows.spread)
    rms_m = rms_of(prepared, trials, [predicted_m[t.name] for t in trials])
    return Heldout(*rms_m, chi2, count, -0.5 * (chi2 + log_det), predicted_m)


@once_per_study
def heldout_rows(prepared: PreparedStudy, fit: Fit) -> HeldoutRows:
    """The `HeldoutRows` of the `validate` trials; not finite where one cannot be simulated."""
    trials = prepared.study.role("validate")
    space, p = fit.space, len(fit.q)
    steps = space.difference_steps(fit.q, fit.covariance)
    lanes = [space.model(q) for q in difference_points(fit.q, steps)]
    states = {t.name: prepared.initial_state(t) for t in trials}
    likeliest = {t.name: best_initial_state(prepared, fit.model, t) for t in trials}
    # then lanes with a perturbed initial state: each lane perturbs one unknown of every trial
    extra = max((state.count for state in states.values()), default=0)
    initial_states = {}
    for name, state in states.items():
        if state.count:
            rows = np.tile(likeliest[name], (len(lanes) + extra, 1))
            rows[len(lanes) + np.arange(state.count), np.arange(state.count)] += state.step
            initial_states[name] = rows
    first = {name: rows[:1] for name, rows in initial_states.items()}
    here = prepared.predict_all(trials, lanes[:1], first)
    predicted = {t.name: points[0] for t, points in zip(trials, here, strict=True)}
    white = [prepared.white(t, points)[0] for t, points in zip(trials, here, strict=True)]
    changed = prepared.white_near(trials, [*lanes, *[fit.model] * extra], initial_states)
    by_parameters = np.asarray((changed[1 : p + 1] - changed[0]).T / steps)
    by_unknown = prepared.by_trial(trials, (changed[p + 1 :] - changed[0]).T)
    by_state = [by_unknown[name][:, : s.count] / s.step * s.std for name, s in states.items()]
    by_states = np.asarray(block_diag(*by_state))
    spread = np.hstack([by_parameters @ parameters_root(fit.covariance), by_states])
    residual = np.concatenate(white)
    return HeldoutRows(predicted, residual, by_parameters, by_states, spread, likeliest)


def heldout_log_lr(prepared: PreparedStudy, fit: Fit, effect: type[Effect]) -> float:
    """Expected ln likelihood ratio of the held-out trials with and without an effect of the fit.

    Only the effect is switched off; the other parameters stay as fitted, within their conditional
    covariance given the effect.
    """
    trials, rows = prepared.study.role("validate"), heldout_rows(prepared, fit)
    space = fit.space
    own = [i for i, name in enumerate(space.names) if name.startswith(f"{effect.name}.")]
    other = [i for i in range(len(fit.q)) if i not in own]
    without = extended(fit, space, effect, np.array([q.default for q in effect.parameters]))
    states = {name: np.tile(values, (2, 1)) for name, values in rows.initial_states.items()}
    white = prepared.white_near(trials, [fit.model, space.model(without)], states)
    covariance, among = fit.covariance, np.ix_(other, own)
    inner = np.linalg.pinv(covariance[np.ix_(own, own)], hermitian=True)
    conditional = covariance[np.ix_(other, other)] - covariance[among] @ inner @ covariance[among].T
    spread = rows.by_parameters[:, other] @ parameters_root(conditional)
    if any(t.bent for t in trials):
        spread = np.hstack([spread, rows.by_states])
    if not all(np.all(np.isfinite(r)) for r in (white[0], rows.by_parameters, spread)):
        return 0.0
    if not np.all(np.isfinite(white[1])):
        return np.inf
    chi2, _ = marginal_chi2(white[1] - white[0], spread)
    return 0.5 * chi2


#: Number of points that show the complete cable.
DRAWN = 21


def predict_cable(
    prepared: PreparedStudy,
    trial: Trial,
    models: Sequence[CableModel],
    initial_states: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Predicted markers (models, times, markers, 2), and points along the cable (…, `DRAWN`, 2).

    In metres; nan where they cannot be simulated.  After the markers come gauges, if there are any.
    """
    study = prepared.study
    drawn = np.linspace(study.cable.length_m, 0.0, DRAWN)
    arcs = np.unique(np.concatenate([study.arc_length_m, drawn]))[::-1]
    t_s = trial.markers.t_s
    gauges = trial.markers.xy_m.shape[1] - len(study.arc_length_m)
    blank = replace(trial, markers=Markers(t_s, np.zeros((len(t_s), len(arcs) + gauges, 2))))
    finer = replace(prepared, study=replace(study, arc_length_m=arcs))
    points = finer.predict(
        blank, models, None if initial_states is None else np.tile(initial_states, (len(models), 1))
    )
    marker_index, drawn_index = (np.searchsorted(-arcs, -s) for s in (study.arc_length_m, drawn))
    marker_index = np.concatenate([marker_index, np.arange(len(arcs), len(arcs) + gauges)])
    return points[:, :, marker_index], points[:, :, drawn_index]
