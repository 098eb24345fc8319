"""The smooth part of a residual: noise if the model is right, and what a claim may leave of it."""

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.effects import library
from cell.cable.solver import Solver
from cell.identify.parameters import ParameterSpace
from cell.lab.explore import cold_start
from cell.lab.fitting import fit_model, heldout
from cell.lab.prepared import PreparedStudy
from cell.lab.smooth_part import SmoothPart, of_a_finer_model, smooth_part
from cell.study.data import Markers


def fitted(study, solver=None):
    prepared = PreparedStudy.of(study)
    if solver is not None:
        prepared = replace(prepared, solver=solver)
    space = ParameterSpace.of(study.cable)
    return prepared, fit_model(prepared, space, cold_start(prepared, space))


@pytest.mark.parametrize("seed", [2, 3, 4])
@pytest.mark.parametrize("colour", [0.0, 0.8])
@pytest.mark.parametrize("lost", [0.0, 0.05])
def test_a_right_models_smooth_residual_is_noise(make_study, seed, colour, lost):
    study = make_study(seed=seed, colour=colour)
    rng = np.random.default_rng(seed)

    def with_gaps(trial):
        seen = rng.uniform(size=trial.markers.xy_m.shape[:2]) >= lost
        xy_m = np.where(seen[..., None], trial.markers.xy_m, np.nan)
        return replace(trial, markers=Markers(trial.markers.t_s, xy_m))

    part = smooth_part(*fitted(replace(study, trials=tuple(with_gaps(t) for t in study.trials))))
    level = 0.0 if colour == 0.0 else 0.15  # as well as the colour is known
    assert abs(part.excess) < 4.0 * np.sqrt(2.0 / part.count) + level


def test_a_wrong_models_smooth_residual_is_not_though_all_of_it_may_be(make_study):
    mass = library()["tip_mass"].active(mass_kg=1.2e-5)
    prepared, fit = fitted(make_study([mass], seed=8, noise_m=2e-4))
    weighed = heldout(prepared, fit)
    assert weighed.chi2 < 1.1 * weighed.count
    assert smooth_part(prepared, fit).excess > 0.4


def test_what_a_coarse_mesh_leaves_is_not_taken_for_a_misfit(make_study):
    study = make_study(seed=2, noise_m=3e-5)
    prepared, fit = fitted(study, Solver(segments=12, step_s=2e-3))
    coarse, finer = smooth_part(prepared, fit), of_a_finer_model(prepared, fit)
    assert coarse.excess > 0.5
    assert finer.excess < 0.4 * coarse.excess


def test_a_misfit_stays_one_on_a_finer_mesh(make_study):
    mass = library()["tip_mass"].active(mass_kg=1.2e-5)
    prepared, fit = fitted(make_study([mass], seed=8, noise_m=2e-4))
    coarse, finer = smooth_part(prepared, fit), of_a_finer_model(prepared, fit)
    assert finer.excess == pytest.approx(coarse.excess, rel=0.1)


def test_nothing_is_said_where_the_study_states_its_noise(make_study):
    study = replace(make_study(seed=2), noise_std_m=2e-4)
    assert smooth_part(*fitted(study)) is None


def test_the_chance_of_an_excess_allows_for_how_well_the_noise_is_known():
    sure, unsure = SmoothPart(630.0, 630, 18_000, 1e6), SmoothPart(630.0, 630, 18_000, 150.0)
    assert sure.chance_of(0.2) < 1e-3 < 0.05 < unsure.chance_of(0.2)
    assert sure.p_value == pytest.approx(0.5, abs=0.01)
