"""Differences of simulations with a longer step: used where they are the same, and only there."""

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.effects import library
from cell.cable.solver import Solver
from cell.identify.gauss_newton import jacobian_at
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit import sensitivity
from cell.lab.fit.fitting import HARMLESS, fit_model, fit_trials, problem_of, with_slope_solver
from cell.lab.fit.heldout import heldout
from cell.lab.fit.sensitivity import sensitivities
from cell.lab.verdict.check_statistics import score_tests


@pytest.fixture(scope="module")
def fitted(make_study):
    study = make_study([], seed=3)
    prepared, space = PreparedStudy.of(study), ParameterSpace.of(study.cable)
    return prepared, fit_model(prepared, space, space.start(2.5e-5))


def test_a_longer_step_leaves_slopes_and_what_follows_from_them(fitted):
    prepared, fit = fitted
    coarser, same = with_slope_solver(prepared, fit)
    assert coarser.slope_solver is not None
    assert coarser.slope_solver.step_s > prepared.solver.step_s
    problem = problem_of(prepared, fit.space, fit_trials(prepared))
    exact = jacobian_at(problem, fit.solution.q, fit.solution.covariance)
    off = np.linalg.norm(same.solution.jacobian - exact, axis=0)
    assert np.all(off < HARMLESS * np.sqrt(np.sum(exact**2, axis=0) + np.diag(problem.precision)))
    before, after = heldout(prepared, fit), heldout(coarser, fit)
    assert after.rms_m == before.rms_m
    assert after.log_likelihood == pytest.approx(before.log_likelihood, abs=0.02)
    again = fit_model(coarser, fit.space, fit.space.start(2.5e-5))
    assert np.abs(again.q - fit.q).max() < 0.02 * np.sqrt(np.diag(fit.covariance)).max()


def test_where_a_longer_step_would_do_harm_none_is_taken(fitted):
    prepared, fit = fitted
    rough = replace(prepared, solver=Solver(segments=32, step_s=8e-3))
    fit = fit_model(rough, fit.space, fit.q)
    assert with_slope_solver(rough, fit)[0].slope_solver is None


def test_how_far_a_search_goes_does_not_depend_on_the_step_of_slopes(fitted):
    prepared, fit = fitted
    trials = fit_trials(prepared)
    counted = []
    for study in (prepared, replace(prepared, slope_solver=Solver(32, 3e-3))):
        before = study.work.simulated_s
        study.white_near(trials, [fit.model] * 3)
        counted.append(study.work.simulated_s - before)
    assert counted[0] == counted[1] > 0.0


@pytest.mark.parametrize("times", [0.1, 30.0])
def test_a_slope_is_one_however_strong_an_effect_usually_is(fitted, times):
    """Of a stiff cord half a radian per newton metre was a bend, and its grip was not seen."""
    prepared, fit = fitted
    grip = library()["grip_compliance"]
    strength, time = grip.parameters
    stronger = replace(strength, starts=(times * strength.starts[0],))
    unusual = type("Unusual", (grip,), {"parameters": (stronger, time)})
    usual, other = sensitivities(prepared, fit, [grip, unusual])
    assert np.linalg.norm(usual.rows - other.rows) < 0.05 * np.linalg.norm(usual.rows)


@pytest.mark.parametrize(("change", "name"), [(1.0, "air_drag"), (0.0, "tip_mass")])
def test_a_change_that_no_smaller_effect_makes_smaller_is_kept_and_none_is_asked_for_nothing(
    fitted, monkeypatch, change, name
):
    """A limp cable whips: friction of nothing lets it end elsewhere.  A diagnosis crashed there."""
    prepared, fit = fitted

    def changed(study, fit, active):
        return np.full((len(active), len(fit.solution.residual)), change)

    monkeypatch.setattr(sensitivity, "changes", changed)
    effect = library()[name]
    (found,) = sensitivities(prepared, fit, [effect])
    assert np.any(found.rows) == (change > 0.0)
    assert set(score_tests(prepared, fit, [effect])) == ({name} if change else set())
