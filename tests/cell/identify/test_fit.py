from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.cable.geometry import Cable, Connector, node_arc_lengths
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.identify.fit import (
    FitError,
    FitOptions,
    fit,
    predict,
    still_noise,
    variance_inflation,
)
from cell.identify.gripper_errors import GripperLogErrors
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.identify.whitener import Whitener
from cell.study.data import Markers
from cell.study.folder import read_study

PRACTICE = Path(__file__).parents[4] / "shared/data/practice"
NODES_M = node_arc_lengths(0.1)
EXACT_HAND = FitOptions(gripper_errors=GripperLogErrors(samples=0))


def varied(flat_cable: Cable) -> CableModel:
    s = np.linspace(0.0, 1.0, 13)
    return CableModel(flat_cable, 2.8e-5 * np.exp(0.15 * np.cos(5.0 * s)), 1.06, 1.4e-7)


@pytest.mark.parametrize("study", ["none_a", "none_b"])
def test_practice_studies_are_predicted_to_their_noise(study: str) -> None:
    """Foreign 60-segment simulator; noise 0.1 mm white, and 0.05 mm of colour 0.4."""
    if not PRACTICE.exists():
        pytest.skip("the practice studies are not beside this project")
    data = read_study(PRACTICE / study)
    noise_m, exponent, viscosity = {
        "none_a": (1e-4, 1.0, 1.7630722678734512e-07),
        "none_b": (5e-5, 0.932982097004498, 2.1583786981333388e-07),
    }[study]
    found = fit(data.role("fit")[:1], data.arc_length_m, ParameterSpace.of(data.cable))
    assert found.noise.std_m == pytest.approx(noise_m, rel=0.06)
    assert found.values[-2] == pytest.approx(exponent, abs=0.002)
    assert found.values[-1] == pytest.approx(viscosity, rel=0.01)
    square, count = 0.0, 0
    for trial in data.role("validate"):
        error = predict(trial, [found.model], data.arc_length_m, Solver())[0] - trial.markers.xy_m
        square, count = square + float(np.nansum(error**2)), count + int(np.isfinite(error).sum())
    assert np.sqrt(square / count) == pytest.approx(noise_m, rel=0.015)


def test_parameters_of_a_finer_world_are_found(measure, flat_cable: Cable) -> None:
    truth = varied(flat_cable)
    world = measure(truth, seed=3)
    found = fit([world.trial], NODES_M, ParameterSpace.of(flat_cable))
    bends = np.linspace(0.0, 0.06, 13)
    error = np.log(found.model.rigidity_at(bends) / truth.rigidity_at(bends))
    assert np.abs(error).max() < 0.05
    assert np.all(np.abs(error) < 4.0 * found.rigidity_log_std(bends))
    assert found.values[-2] == pytest.approx(truth.exponent, abs=0.003)
    assert found.values[-1] == pytest.approx(truth.viscosity_n_m2_s, rel=0.02)
    assert found.residual_rms_m == pytest.approx(5e-5, rel=0.05)
    assert found.inflation < 1.5


def test_a_cable_with_a_connector_is_found_where_it_is_stated_only(
    measure, flat_cable: Cable
) -> None:
    """The connector is as heavy as the cable, and the outer two markers are on it."""
    cable = replace(flat_cable, connector=Connector(7e-4, 0.02, 3e-8))
    truth = replace(varied(flat_cable), cable=cable)
    world = measure(truth, seed=6)
    arcs_m = node_arc_lengths(cable.length_m)
    assert np.count_nonzero(arcs_m > cable.free_length_m) == 2
    found = fit([world.trial], arcs_m, ParameterSpace.of(cable))
    bends = np.linspace(0.0, 0.06, 13)
    error = np.log(found.model.rigidity_at(bends) / truth.rigidity_at(bends))
    assert np.all(np.abs(error) < 4.0 * found.rigidity_log_std(bends))
    assert found.residual_rms_m == pytest.approx(5e-5, rel=0.05)

    bare = world.trial.markers.xy_m[:, arcs_m <= flat_cable.free_length_m]
    trial = replace(world.trial, markers=Markers(world.trial.markers.t_s, bare))
    unsaid = fit([trial], arcs_m[arcs_m <= 0.1], ParameterSpace.of(flat_cable))
    assert unsaid.residual_rms_m > 2.0 * found.residual_rms_m


def test_unseen_frames_and_markers_are_skipped(measure, flat_cable: Cable) -> None:
    world = measure(varied(flat_cable), seed=4)
    markers = world.trial.markers.xy_m.copy()
    markers[60:90] = np.nan
    markers[::7] = np.nan
    markers[:, 4] = np.nan
    trial = replace(world.trial, markers=Markers(world.trial.markers.t_s, markers))
    found = fit([trial], NODES_M, ParameterSpace.of(flat_cable))
    assert found.frames_total == len(markers)
    assert found.frames_used == np.isfinite(markers[:, 0, 0]).sum()
    assert found.values[-1] == pytest.approx(1.4e-7, rel=0.03)


def test_more_frames_from_a_previous_fit_take_few_passes_and_agree(
    measure, flat_cable: Cable
) -> None:
    world = measure(varied(flat_cable), seed=5)
    t_s = world.trial.markers.t_s
    most = t_s < t_s[-1] - 0.15
    early = replace(world.trial, markers=Markers(t_s[most], world.trial.markers.xy_m[most]))
    space = ParameterSpace.of(flat_cable)
    cold = fit([world.trial], NODES_M, space)
    warm = fit([world.trial], NODES_M, space, previous=fit([early], NODES_M, space))
    assert warm.iterations <= 2
    std = np.sqrt(np.diag(cold.covariance))
    np.testing.assert_allclose((warm.mean - cold.mean) / std, 0.0, atol=0.2)


def test_one_marker_at_the_tip_is_enough_for_a_swing(measure, flat_cable: Cable) -> None:
    world = measure(CableModel(flat_cable, np.array([3e-5]), 1.0, 1.2e-7), seed=6)
    markers = Markers(world.trial.markers.t_s, world.trial.markers.xy_m[:, :1])
    found = fit([replace(world.trial, markers=markers)], NODES_M[:1], ParameterSpace.of(flat_cable))
    assert found.values[-1] == pytest.approx(1.2e-7, rel=0.05)


def test_uncertain_hand_widens_the_intervals(measure, flat_cable: Cable) -> None:
    world = measure(varied(flat_cable), seed=7)
    space = ParameterSpace.of(flat_cable)
    exact = fit([world.trial], NODES_M, space, options=EXACT_HAND)
    tilted = FitOptions(gripper_errors=GripperLogErrors(samples=15, offset_rad=2e-3))
    wide = fit([world.trial], NODES_M, space, options=tilted)
    assert not exact.gripper_covariance.any()
    np.testing.assert_array_equal(exact.mean, wide.mean)
    np.testing.assert_allclose(wide.covariance - exact.covariance, wide.gripper_covariance)
    assert np.sqrt(wide.covariance[0, 0] / exact.covariance[0, 0]) > 1.2


def test_physics_that_the_model_lacks_inflates_the_variance(measure, flat_cable: Cable) -> None:
    """A cable in a draught of its own kind: the gripper log is 20 ms late."""
    world = measure(varied(flat_cable), seed=8)
    late = replace(world.trial.grip, t_s=world.trial.grip.t_s + 0.02)
    found = fit([replace(world.trial, grip=late)], NODES_M, ParameterSpace.of(flat_cable))
    assert found.inflation > 10.0
    assert found.residual_rms_m > 2.0 * found.noise.std_m


def test_what_cannot_be_fitted_is_said(measure, flat_cable: Cable) -> None:
    world = measure(varied(flat_cable), seed=9)
    space = ParameterSpace.of(flat_cable)
    t_s, xy_m = world.trial.markers.t_s, world.trial.markers.xy_m
    blind = replace(world.trial, markers=Markers(t_s, np.full_like(xy_m, np.nan)))
    with pytest.raises(FitError, match="no marker is seen"):
        fit([blind], NODES_M, space)
    swinging = replace(world.trial, markers=Markers(t_s[60:], xy_m[60:]))
    with pytest.raises(FitError, match="still frames"):
        fit([swinging], NODES_M, space)
    assert fit([swinging], NODES_M, space, noise=Noise(5e-5)).frames_used == len(t_s) - 60


def test_still_noise_across_the_cable_leaves_out_what_is_along_it(
    measure, flat_cable: Cable
) -> None:
    world = measure(varied(flat_cable), seed=10, noise_m=2e-5)
    markers = world.trial.markers.xy_m.copy()
    along = np.gradient(world.clean_m, axis=1)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    rng = np.random.default_rng(0)
    markers += 2e-4 * rng.normal(size=(len(markers), 1, 1)) * along
    trial = replace(world.trial, markers=Markers(world.trial.markers.t_s, markers))
    assert still_noise([trial]).std_m > 1e-4
    assert still_noise([trial], across_only=True).std_m == pytest.approx(2e-5, rel=0.3)


def test_a_first_frame_in_which_nothing_is_seen_does_not_hide_the_others(
    measure, flat_cable: Cable
) -> None:
    trial = measure(varied(flat_cable), seed=10, noise_m=2e-5).trial
    markers = trial.markers.xy_m.copy()
    markers[0] = np.nan
    markers[1, 3] = np.nan
    gappy = replace(trial, markers=Markers(trial.markers.t_s, markers))
    whole = still_noise([trial], across_only=True)
    assert still_noise([gappy], across_only=True).std_m == pytest.approx(whole.std_m, rel=0.1)


@pytest.mark.parametrize("short", [2, 12, 30])
def test_a_short_trial_does_not_hide_that_errors_last_for_many_frames(short: int) -> None:
    """As many frames at a time err alike, whatever other trials there are."""

    def erring(frames: int) -> tuple[np.ndarray, Whitener]:
        slow = np.cos(2.0 * np.pi * np.arange(frames) / 160.0)
        return np.tile(slow, 6), Whitener(np.zeros((frames, 3, 2)), Noise(1e-4))

    (long_error, long), (short_error, brief) = erring(400), erring(short)
    alone = variance_inflation(long_error, [long], 8)
    errors = np.concatenate([long_error, short_error])
    assert alone > 20.0
    assert variance_inflation(errors, [long, brief], 8) == pytest.approx(alone, rel=0.2)
    errors = np.concatenate([short_error, long_error])
    assert variance_inflation(errors, [brief, long], 8) == pytest.approx(alone, rel=0.2)
