"""Markers whose arc length is uncertain: how they move with it, and that residuals allow for it."""

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.model import CableModel
from cell.identify.marker_shift import carried_m, derivative_along
from cell.identify.noise import Noise
from cell.identify.whitener import Whitener
from cell.study.data import Markers, Trial
from cell.study.hand_drift import HandDrift
from tools.worlds.made_studies import CABLE, moved

ARCS_M = np.array([0.095, 0.07, 0.04, 0.0])
STD_M = 5e-4


@pytest.fixture(scope="module")
def trial() -> Trial:
    """A swing without noise."""
    t = np.arange(0.0, 0.8, 0.002)
    hand = moved(t, (0.0, -0.05), 0.25, begin_s=0.1, angle_rad=0.2)
    t_s = np.arange(0.0, 0.8, 0.01)
    points = simulate(MODEL, hand, t_s, ARCS_M)[0]
    return Trial("swing", "fit", "equilibrium", hand, Markers(t_s, points))


MODEL = CableModel(CABLE, np.full(4, 2.5e-5), 1.0, 1e-7)


@pytest.mark.parametrize("lost", [None, "rows", "laser"])
def test_slopes_are_those_of_the_cable(trial, lost):
    farther_m = np.minimum(ARCS_M + 1e-4, CABLE.free_length_m)
    moved = simulate(MODEL, trial.grip, trial.markers.t_s, farther_m)[0]
    true = (moved - trial.markers.xy_m) / (farther_m - ARCS_M)[:, None]
    seen = trial.markers.xy_m.copy()
    if lost == "rows":
        seen[10:12, 1] = np.nan
    if lost == "laser":
        seen[..., 0] = np.nan
    shown = Trial("swing", "fit", "equilibrium", trial.grip, Markers(trial.markers.t_s, seen))
    found = derivative_along(shown, ARCS_M)
    axes = [1] if lost == "laser" else [0, 1]
    assert np.sqrt(np.mean((found - true)[..., axes] ** 2)) < 0.02
    assert np.max(np.abs((found - true)[..., axes])) < 0.15
    if lost == "laser":
        assert np.all(found[..., 0] == 0.0)


def test_arc_lengths_that_are_wrong_do_not_spoil_the_slopes(trial):
    """The spline through misplaced markers is stretched; no cable is."""
    wrong_m = ARCS_M + np.array([-1e-3, 1e-3, -1e-3, 0.0])
    right, found = derivative_along(trial, ARCS_M), derivative_along(trial, wrong_m)
    assert np.linalg.norm(found, axis=2) == pytest.approx(1.0)
    assert np.sqrt(np.mean((found - right) ** 2)) < 0.003


def test_many_markers_show_the_slopes_though_the_hand_is_wrong(trial):
    """A camera's scale or a wrong angle of the clamp kinked the spline beside the gripper."""
    arcs_m = np.array([0.095, 0.08, 0.065, 0.05, 0.035, 0.02])
    markers = simulate(MODEL, trial.grip, trial.markers.t_s, arcs_m)[0]
    right = Trial("swing", "fit", "equilibrium", trial.grip, Markers(trial.markers.t_s, markers))
    turned = replace(trial.grip, angle_rad=trial.grip.angle_rad + 0.1)
    wrong = replace(right, grip=turned, markers=replace(right.markers, xy_m=1.02 * markers))
    found = derivative_along(wrong, arcs_m)
    assert np.max(np.abs(found - derivative_along(right, arcs_m))) < 1e-3


def whitener(trial: Trial, noise: Noise, std_m: float) -> Whitener:
    return Whitener(trial.markers.xy_m, noise, std_m * derivative_along(trial, ARCS_M))


@pytest.mark.parametrize(
    "noise", [Noise(1e-4), Noise(1e-4, 0.5, 3e-5), Noise(1e-4, 0.6, white=0.3)]
)
def test_noise_and_shifts_of_markers_are_white_together(trial, noise):
    """As by the inverse root of their covariance."""
    plain, shifted = Whitener(trial.markers.xy_m, noise), whitener(trial, noise, STD_M)
    slopes = STD_M * derivative_along(trial, ARCS_M)
    error_m = 1e-4 * np.random.default_rng(0).normal(size=slopes.shape)
    predicted_m = (trial.markers.xy_m - error_m)[None]
    found = shifted(predicted_m)[0].reshape(4, -1)
    before = plain(predicted_m)[0].reshape(4, -1)
    moved = plain((trial.markers.xy_m - slopes)[None])[0].reshape(4, -1)
    for row, was, h in zip(found, before, moved, strict=True):
        covariance = np.eye(len(h)) + np.outer(h, h)
        assert row @ row == pytest.approx(was @ np.linalg.solve(covariance, was), rel=1e-9)


def test_a_shift_is_hardly_a_misfit_and_a_jump_is(trial):
    noise, slopes = Noise(1e-5), derivative_along(trial, ARCS_M)
    shift_m = STD_M * np.array([1.0, -1.5, 0.5, 1.0])[:, None] * slopes
    free = whitener(trial, noise, STD_M)
    along = free((trial.markers.xy_m + shift_m)[None])[0]
    assert along @ along == pytest.approx(1.0 + 1.5**2 + 0.5**2 + 1.0, rel=0.01)
    across = np.stack([-slopes[..., 1], slopes[..., 0]], axis=-1)
    aside = free((trial.markers.xy_m + STD_M * across)[None])[0]
    assert aside @ aside > 1e5


def test_errors_are_told_beside_the_likeliest_shift(trial):
    noise, rng = Noise(1e-5), np.random.default_rng(1)
    slopes = derivative_along(trial, ARCS_M)
    error_m = noise.std_m * rng.normal(size=slopes.shape)
    predicted_m = trial.markers.xy_m - error_m - 1.3 * STD_M * slopes
    free = whitener(trial, noise, STD_M)
    residual_m = free.residual_m(predicted_m)
    assert np.sqrt(np.mean(residual_m**2)) == pytest.approx(noise.std_m, rel=0.1)
    assert free.error_m(free(predicted_m[None])[0]) == pytest.approx(residual_m, abs=1e-12)


DRIFT = HandDrift(0.1, 0.35, (1e-2, 1e-2))


def carried(trial: Trial, noise: Noise, std_m: float) -> tuple[Whitener, np.ndarray]:
    """What whitens for drift and shifts, and the shapes of the drift."""
    shapes_m = carried_m(replace(trial, hand_drift=DRIFT))
    assert shapes_m is not None
    slopes = std_m * derivative_along(trial, ARCS_M)
    return Whitener(trial.markers.xy_m, noise, slopes, shapes_m), shapes_m


@pytest.mark.parametrize("noise", [Noise(1e-4), Noise(1e-4, 0.6, 3e-5, white=0.3)])
def test_noise_shifts_and_drift_are_white_together(trial, noise):
    """As by the inverse root of their covariance."""
    free, shapes_m = carried(trial, noise, STD_M)
    error_m = 1e-4 * np.random.default_rng(0).normal(size=trial.markers.xy_m.shape)
    predicted_m = (trial.markers.xy_m - error_m)[None]
    found, before = free(predicted_m)[0], whitener(trial, noise, STD_M)(predicted_m)[0]
    moved = whitener(trial, noise, STD_M)(trial.markers.xy_m - shapes_m)
    covariance = np.eye(len(before)) + moved.T @ moved
    assert found @ found == pytest.approx(before @ np.linalg.solve(covariance, before), rel=1e-9)


def test_errors_are_told_beside_the_likeliest_drift(trial):
    noise, rng = Noise(1e-5), np.random.default_rng(1)
    free, shapes_m = carried(trial, noise, 0.0)
    drift_m = np.einsum("k,ktmc->tmc", rng.normal(size=len(shapes_m)), shapes_m)
    assert np.abs(drift_m).max() > 5.0 * noise.std_m
    error_m = noise.std_m * rng.normal(size=drift_m.shape)
    predicted_m = trial.markers.xy_m - error_m - drift_m
    residual_m = free.residual_m(predicted_m)
    assert np.sqrt(np.mean(residual_m**2)) == pytest.approx(noise.std_m, rel=0.1)
    assert free.error_m(free(predicted_m[None])[0]) == pytest.approx(residual_m, abs=1e-12)


def test_a_turn_about_an_axle_carries_all_markers(trial):
    drift = HandDrift(0.1, 0.35, turn_std_rad=1e-4, axle_m=(0.1, 0.02))
    before, _ = carried_m(replace(trial, hand_drift=drift))
    c, s = np.cos(1e-4), np.sin(1e-4)
    away = trial.markers.xy_m[0] - [0.1, 0.02]
    turned = away @ np.array([[c, s], [-s, c]])
    np.testing.assert_allclose(before[0], turned - away, atol=1e-9)
    clamp, _ = carried_m(replace(trial, hand_drift=replace(drift, clamp_turns=False)))
    hand = np.array([trial.grip.x_m[0], trial.grip.y_m[0]])
    np.testing.assert_allclose(clamp[0], np.tile(drift.turned_m(1e-4, hand), (4, 1)), atol=1e-12)
