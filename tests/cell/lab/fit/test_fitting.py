"""Fits on trials and their weight on those held out."""

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.effects import library
from cell.cable.geometry import Motion
from cell.identify import gauss_newton
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.fitting import fit_model
from cell.lab.fit.heldout import heldout
from cell.lab.search.extension import cold_start
from tests.cell.lab.conftest import LONG


def test_a_held_out_trial_that_the_model_cannot_follow_is_impossible_not_nan(make_study):
    study = make_study(seed=2)
    prepared = PreparedStudy.of(study)
    space = ParameterSpace.of(study.cable)
    fit = fit_model(prepared, space, cold_start(prepared, space))
    last = study.trials[-1]
    t_s = last.grip.t_s
    thrown = Motion(t_s, 40.0 * np.sin(60.0 * t_s), last.grip.y_m, 30.0 * np.sin(40.0 * t_s))
    thrown_off = replace(study, trials=(*study.trials[:-1], replace(last, grip=thrown)))
    weighed = heldout(replace(prepared, study=thrown_off), fit)
    assert weighed is not None
    assert weighed.log_likelihood == -np.inf
    assert weighed.rms_m == np.inf
    assert heldout(prepared, fit).rms_m < 1.1e-4


def test_a_long_way_gone_coarsely_ends_where_a_fine_one_does(make_study, monkeypatch):
    study = make_study([library()["tip_mass"].active(mass_kg=3e-5)], seed=8, **LONG)
    prepared, space = PreparedStudy.of(study), ParameterSpace.of(study.cable)
    start = cold_start(prepared, space)
    fine = fit_model(prepared, space, start)
    prepared = replace(prepared, slope_solver=replace(prepared.solver, step_s=3e-3))
    simulated = []
    predict_all = PreparedStudy.predict_all

    def counted(self, trials, models, initial_states=None):
        simulated.append((self.solver.step_s, len(models)))
        return predict_all(self, trials, models, initial_states)

    monkeypatch.setattr(PreparedStudy, "predict_all", counted)
    found = fit_model(prepared, space, start, from_far=True)
    assert found.objective == pytest.approx(fine.objective, rel=1e-4)
    apart = (found.q - fine.q) @ np.linalg.solve(fine.covariance, found.q - fine.q)
    assert apart < 0.1**2 * len(fine.q) * max(1.0, fine.chi2 / fine.solution.residual.size)
    from_afar = [models for step_s, models in simulated if step_s < 2e-3]
    assert len(from_afar) < len(simulated) / 2
    assert set(from_afar) == {1}


@pytest.mark.parametrize("passes", [3, 12])
def test_a_coarse_fit_that_gains_no_more_is_gone_on_with_or_said_to_be_unfinished(
    make_study, monkeypatch, passes
):
    """Such fits were called settled 40 above a minimum one step away, and effects lost by it."""
    study = make_study([library()["tip_mass"].active(mass_kg=3e-5)], seed=8, **LONG)
    prepared, space = PreparedStudy.of(study), ParameterSpace.of(study.cable)
    start = cold_start(prepared, space)
    options = gauss_newton.Options(max_iterations=12)
    fine = fit_model(prepared, space, start, options=options)
    prepared = replace(prepared, slope_solver=replace(prepared.solver, step_s=3e-3))
    minimise, stages = gauss_newton.minimise, []

    def stuck_at_first(problem, begin, options, *jacobian):
        stages.append(options.max_iterations)
        if len(stages) > 1:
            return minimise(problem, begin, options, *jacobian)
        early = minimise(problem, begin, replace(options, max_iterations=3))
        return replace(early, iterations=passes, converged_or_idle=True, converged=False)

    monkeypatch.setattr(gauss_newton, "minimise", stuck_at_first)
    found = fit_model(prepared, space, start, options=options, from_far=True)
    assert stages == [12, 1 + 12 - passes]
    arrived = found.objective == pytest.approx(fine.objective, rel=1e-4)
    assert arrived or found.predicted_objective < found.objective - 10.0
