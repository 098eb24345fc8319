"""The smooth part of a residual: noise if the model is right, and what a claim may leave of it."""

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.effects import library
from cell.cable.solver import Solver
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.identify.whitener import Whitener
from cell.lab.data.noise_model import NoiseModel
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.fitting import fit_model
from cell.lab.fit.heldout import heldout
from cell.lab.search.extension import cold_start
from cell.lab.verdict.check_statistics import parameter_constancy_of
from cell.lab.verdict.smooth_part import (
    FastPart,
    SmoothPart,
    _coordinates,
    _slow_level,
    smooth_part,
    without_systematic_error,
)
from tests.cell.lab.conftest import LONG, coloured, fits_of
from tools.worlds.breadth_world import World, hypercube


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
    study = make_study(seed=seed, ar1=colour)
    rng = np.random.default_rng(seed)

    def with_gaps(trial):
        seen = rng.uniform(size=trial.markers.xy_m.shape[:2]) >= lost
        return np.where(seen[..., None], trial.markers.xy_m, np.nan)

    part = smooth_part(*fitted(study.with_places(with_gaps)))
    level = 0.0 if colour == 0.0 else 0.15  # as well as the colour is known
    assert abs(part.excess) < 4.0 * np.sqrt(2.0 / part.count) + level


def test_a_wrong_models_smooth_residual_is_not_though_all_of_it_may_be(make_study):
    mass = library()["tip_mass"].active(mass_kg=1.2e-5)
    prepared, fit = fitted(make_study([mass], seed=8, noise_m=2e-4, **LONG))
    weighed = heldout(prepared, fit)
    assert weighed.chi2 < 1.1 * weighed.count
    assert smooth_part(prepared, fit).excess > 0.4


def test_what_a_coarse_mesh_leaves_is_not_taken_for_a_misfit(make_study):
    study = make_study(seed=2, noise_m=3e-5)
    prepared, fit = fitted(study, Solver(segments=12, step_s=2e-3))
    coarse, finer = smooth_part(prepared, fit), without_systematic_error(prepared, fit)
    assert coarse.excess > 0.5
    assert finer.excess < 0.4 * coarse.excess


def test_a_misfit_stays_one_on_a_finer_mesh(make_study):
    mass = library()["tip_mass"].active(mass_kg=1.2e-5)
    prepared, fit = fitted(make_study([mass], seed=8, noise_m=2e-4))
    coarse, finer = smooth_part(prepared, fit), without_systematic_error(prepared, fit)
    assert finer.excess == pytest.approx(coarse.excess, rel=0.1)


def test_nothing_is_said_where_the_study_states_its_noise(make_study):
    study = replace(make_study(seed=2), noise_std_m=2e-4)
    assert smooth_part(*fitted(study)) is None


def test_the_chance_of_an_excess_allows_for_how_well_the_noise_is_known():
    sure, unsure = SmoothPart(630.0, 630, 18_000, 1e6), SmoothPart(630.0, 630, 18_000, 150.0)
    assert sure.p_value_of(0.2) < 1e-3 < 0.05 < unsure.p_value_of(0.2)
    assert sure.p_value == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("lost", [0.0, 0.05])
@pytest.mark.parametrize("told", [0.5, 0.6, 0.7])
def test_the_level_of_slow_noise_is_seen_in_the_fast(told, lost):
    """Noise of correlation 0.6 that was taken for another: six trials of it tell."""
    rng = np.random.default_rng(7)
    whiteners, fast, slow = [], [], []
    for _ in range(6):
        noise_m = 1e-4 * coloured(rng, (200, 15, 2), 0.6)
        noise_m[rng.uniform(size=noise_m.shape[:2]) < lost] = np.nan
        whiteners.append(Whitener(noise_m, Noise(1e-4, told)))
        white = whiteners[-1](np.zeros((1, *noise_m.shape)))[0]
        fast.append(FastPart.of(whiteners[-1], white))
        slow.append(_coordinates(whiteners[-1], white[:, None])[:, 0])
    rest = NoiseModel(Noise(1e-4, told), 1e-3)
    level, dof = _slow_level(rest, fast, rest.slow_dof)
    seen = np.concatenate(slow)
    expected = ((1.0 - told) / 0.4) ** 2 * (1.0 - 0.6**2) / (1.0 - told**2)
    assert level == pytest.approx(expected, rel=4.0 * np.sqrt(2.0 / dof) + 0.02)
    assert np.mean(seen**2) == pytest.approx(level, rel=0.2)


def test_noise_of_markers_seen_in_every_second_frame_has_the_level_of_its_rest():
    """Cameras that take turns see no marker in two frames in a row: a division by zero."""
    noise_m = 1e-4 * np.random.default_rng(7).normal(size=(200, 4, 2))
    noise_m[::2, ::2] = noise_m[1::2, 1::2] = np.nan
    noise = Noise(1e-4, 0.0)
    whitener, rest = Whitener(noise_m, noise), NoiseModel(noise, 1e-3)
    fast = FastPart.of(whitener, whitener(np.zeros((1, *noise_m.shape)))[0])
    assert fast.pairs == 0
    assert _slow_level(rest, [fast], rest.slow_dof) == (1.0, rest.slow_dof)


@pytest.mark.parametrize(("angle_rad", "noise_m"), [(0.012, 1e-4), (0.02, 2e-4)])
def test_what_a_clamp_askew_leaves_beside_natural_curvature_is_told_from_noise(
    make_study, angle_rad, noise_m
):
    angle = library()["grip_angle"].active(angle_rad=angle_rad)
    study = make_study([angle], seed=1, noise_m=noise_m, hold_s=0.4)
    prepared = PreparedStudy.of(study)
    right, wrong = (
        ParameterSpace.of(study.cable, effects=(library()[name],))
        for name in ("grip_angle", "natural_curvature")
    )
    told = [
        parameter_constancy_of(prepared, fit_model(prepared, space, cold_start(prepared, space)))
        for space in (right, wrong)
    ]
    assert told[0].p_value > 0.01
    assert told[1].p_value < 1e-6


@pytest.mark.parametrize("seed", [2, 3, 4, 5])
def test_trials_of_a_right_model_ask_for_nothing(make_study, seed):
    asked = parameter_constancy_of(*fitted(make_study(seed=seed)))
    assert asked.p_value > 1e-3
    assert 10 < asked.count < 40  # four trials, each of nine parameters but for what is shared


def test_a_noisy_log_of_the_hand_makes_no_misfit_of_few_large_errors():
    """The log's noise moves each trial along few directions, so its χ² varies more than noise's."""
    conditions = hypercube(300, 1600)[40]  # log_m 37 µm, a third of what the camera errs by
    world = World.of(conditions, 16)
    study = world.study(world.clean(), 16)
    fits = fits_of(study)
    part = parameter_constancy_of(fits.prepared, fits.base.fit)
    assert part is not None and part.effective_dof is not None
    assert part.effective_dof < 0.3 * part.count
    assert part.p_value > 0.01
    assert replace(part, effective_dof=None, dof=1e3).p_value < 1e-3, "were they independent"
