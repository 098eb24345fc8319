"""Linear tests against fits: what is told without fitting is what fitting finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.effects import library
from cell.lab.data.prepared import PreparedStudy, pooled, with_noise_model
from cell.lab.fit.fitting import fit_model, fit_trials
from cell.lab.fit.heldout import heldout
from cell.lab.fit.projection import nuisance_of
from cell.lab.fit.sensitivity import changes, sensitivities
from cell.lab.next.linear_study import own_sensitivities, rivals_of
from cell.lab.next.simulated import HiddenEffectWorld
from cell.lab.search.fitted_model import POLISH

DRAG = 0.4


@pytest.fixture(scope="module")
def hidden(linear):
    active = library()["air_drag"].active(drag_coefficient=DRAG)
    return changes(linear.all_trials.prepared, linear.all_trials.fit, [active])[0]


@pytest.fixture(scope="module")
def noiseless(fitted):
    """The study without noise, the drag in it; weighed as the study was."""
    base, prepared = fitted.base, fitted.prepared
    active = library()["air_drag"].active(drag_coefficient=DRAG)
    world = HiddenEffectWorld.of(prepared, base.fit, active)
    clean = HiddenEffectWorld.of(prepared, base.fit, None)
    trials = []
    for trial in prepared.study.trials:  # the fit's own mesh, the difference by the finer one
        here = prepared.predict(trial, [base.fit.model])[0]
        seen = here + world.clean_m[trial.name] - clean.clean_m[trial.name]
        seen[~np.isfinite(trial.markers.xy_m)] = np.nan
        trials.append(replace(trial, markers=replace(trial.markers, xy_m=seen)))
    study = replace(prepared.study, trials=tuple(trials))
    there = PreparedStudy.of(replace(study, noise_std_m=1e-4))
    return with_noise_model(there, prepared.noise_model)


def test_what_is_left_of_all_trials_is_what_a_fit_to_them_leaves(fitted, linear, noiseless, hidden):
    base, together = fitted.base.fit, pooled(noiseless)
    weak = replace(base.space, mean=base.q)  # so that the prior asks for nothing else
    fit = fit_model(together, weak, base.q, options=POLISH)
    left = linear.project_out_all(hidden[None])[0]
    assert left @ left == pytest.approx(fit.objective, rel=0.1)


def test_what_is_left_of_the_fitted_and_the_held_out_trials_is_what_a_fit_leaves(
    fitted, linear, noiseless, hidden
):
    base = fitted.base.fit
    weak = replace(base.space, mean=base.q)
    fit = fit_model(noiseless, weak, base.q, options=POLISH)
    left = linear.project_out_fitted(hidden[None])[0]
    assert left @ hidden == pytest.approx(fit.objective, rel=0.1)
    held = linear.heldout(hidden[None])
    expected = heldout(noiseless, fit).chi2
    assert float((linear.gls_weighted(held) @ held.T)[0, 0]) == pytest.approx(expected, rel=0.1)


def test_scores_of_held_out_trials_are_functions_of_the_whole_residual(linear, hidden):
    held = linear.heldout(hidden[None])
    weighed = linear.gls_weighted(held)
    functions = linear.heldout_scores(weighed)
    assert functions @ hidden == pytest.approx((weighed @ held.T)[0], rel=1e-6)


def test_what_parameters_imitate_is_what_the_screen_takes_out(fitted, linear):
    """Of the fitted trials, by the screen's own slopes."""
    base, prepared = fitted.base.fit, fitted.prepared
    (slopes,) = sensitivities(prepared, base, [library()["tip_mass"]])
    kept = nuisance_of(base).remove(slopes.rows[0])
    expected = float(np.sum(kept**2))
    (everywhere,) = linear.all_trials.sensitivities([library()["tip_mass"]])
    rows = everywhere.rows[0][:, : len(linear.fitted)]
    assert float((linear.project_out_fitted(rows) @ rows.T)[0, 0]) == pytest.approx(
        expected, rel=0.05
    )
    assert len(fit_trials(prepared)) < len(prepared.study.trials)


def test_the_like_effect_is_the_most_collinear_and_a_thing_is_like_itself(linear, hidden):
    others = [library()[n] for n in ("linear_air_drag", "tip_mass", "grip_angle")]
    rivals = rivals_of(linear, hidden, [*others, library()["air_drag"]])
    assert rivals[0].effect.name == "air_drag"
    assert rivals[0].collinear > 0.99
    assert rivals[1].effect.name == "linear_air_drag"
    assert all(0.0 <= r.collinear <= 1.0 for r in rivals)


def test_an_effect_of_one_sign_cannot_imitate_the_other(linear, hidden):
    (rival,) = rivals_of(linear, -hidden, [library()["air_drag"]])
    assert rival.collinear == 0.0


def test_a_change_that_parameters_make_is_no_effect_of_its_own(linear):
    by_viscosity = linear.slopes[:, list(linear.all_trials.fit.space.names).index("viscosity")]
    hidden = 1e3 * by_viscosity
    none = np.empty((0, len(hidden)))
    assert own_sensitivities(linear, library()["air_drag"], 0, hidden, hidden, none) is None


def test_a_shape_that_the_amplitude_or_another_imitates_is_asked_once(linear, hidden):
    """Directions that are the same leave no covariance to be inverted."""
    other = linear.all_trials.sensitivities([library()["tip_mass"]])[0].rows[0][:1, : len(hidden)]
    shapes = np.vstack([0.0 * hidden, 2.0 * hidden, other, 3.0 * other])
    own = own_sensitivities(linear, library()["air_drag"], 0, hidden, hidden, shapes)
    assert own is not None
    assert len(own.of_parameters) == 2
    np.testing.assert_allclose(own.shapes, other / np.linalg.norm(other))


def test_the_covariance_of_white_functions_is_theirs_and_the_hand_adds_to_it(linear, hidden):
    functions = np.stack([hidden, linear.project_out_all(hidden[None])[0]])
    found = linear.covariance(functions)
    assert np.all(np.linalg.eigvalsh(found - functions @ functions.T) > -1e-6 * found.max())
