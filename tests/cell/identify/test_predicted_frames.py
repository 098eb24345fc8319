"""What was simulated before the last frame came is what is found when it has come."""

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.geometry import Cable, Motion, node_arc_lengths
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.identify import fit as fitting
from cell.identify.identified import Identified
from cell.identify.individual import identify, predict_frames
from cell.identify.predicted_frames import PredictedFrames, _later, extended_at_rest
from cell.study.data import Markers, Trial

NODES_M = node_arc_lengths(0.1)
#: Share of the trial's time after which the rest of it is predicted.
SHARE = 0.7


@pytest.fixture(scope="module")
def world(measure, flat_cable: Cable):
    return measure(CableModel(flat_cable, np.array([3e-5]), 1.04, 1.3e-7), seed=21)


@pytest.fixture(scope="module")
def before(world, flat_cable: Cable) -> tuple[Identified, PredictedFrames]:
    """The cable from the first frames, and what these say of all of them."""
    trial = world.trial
    until_s = SHARE * float(trial.markers.t_s[-1])
    frames, log = trial.markers.t_s < until_s, trial.grip.t_s < until_s
    early = Trial(
        trial.name,
        trial.role,
        trial.start,
        Motion(*(getattr(trial.grip, name)[log] for name in ("t_s", "x_m", "y_m", "angle_rad"))),
        Markers(trial.markers.t_s[frames], trial.markers.xy_m[frames]),
    )
    found = identify(early, NODES_M, flat_cable)
    return found, predict_frames(early, trial.markers.t_s, NODES_M, found)


@pytest.fixture
def no_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: object, **kwargs: object) -> None:
        raise AssertionError("simulated after the last frame")

    monkeypatch.setattr(fitting, "simulate", refuse)


def test_frames_that_come_late_are_moved_to_first_order() -> None:
    rng = np.random.default_rng(0)
    t_s = np.cumsum(rng.uniform(0.004, 0.006, 30))
    late_s = rng.uniform(-3e-4, 3e-4, 30)
    markers_m, shift_m = rng.normal(size=(3, 30, 4, 2)), np.array([0.1, -0.2])
    rate = np.gradient(markers_m, t_s, axis=1)
    expected = markers_m + rate * late_s[:, None, None] + shift_m
    np.testing.assert_allclose(_later(markers_m, t_s, late_s, shift_m), expected, atol=1e-12)


def in_deviations(found: Identified, expected: Identified) -> float:
    std = np.sqrt(np.diag(expected.covariance))
    return float(np.abs((found.mean - expected.mean) / std).max())


@pytest.mark.usefixtures("no_simulation")
def test_nothing_is_simulated_after_the_last_frame(world, before, flat_cable: Cable) -> None:
    found = identify(world.trial, NODES_M, flat_cable, previous=before[0], predicted=before[1])
    assert found.iterations == 1
    assert found.frames_used == len(world.trial.markers.t_s)


def test_the_cable_is_that_which_all_frames_show_from_scratch(
    world, before, flat_cable: Cable
) -> None:
    """But for a last step taken linearly, and for what the log's last samples say of the others."""
    early, predicted = before
    for grip, within in ((predicted.grip, 0.1), (world.trial.grip, 0.6)):
        trial = replace(world.trial, grip=grip)
        cold = identify(trial, NODES_M, flat_cable)
        found = identify(trial, NODES_M, flat_cable, previous=early, predicted=predicted)
        assert in_deviations(early, cold) > 0.3, "the last frames tell something"
        assert in_deviations(found, cold) < within
        ratio = np.sqrt(np.diag(found.covariance) / np.diag(cold.covariance))
        np.testing.assert_allclose(ratio, 1.0, atol=0.25)
        assert found.residual_rms_m == pytest.approx(cold.residual_rms_m, rel=0.01)


def test_frames_that_come_a_little_late_are_allowed_for(world, before) -> None:
    predicted = before[1]
    t_s = world.trial.markers.t_s
    late_s = t_s + np.random.default_rng(0).uniform(0.0, 3e-4, len(t_s))
    filmed = predicted.as_filmed(replace(world.trial, markers=Markers(late_s, world.clean_m)))
    assert filmed is not None
    model = before[0].space.model(predicted.lanes[0])
    exact = simulate(model, predicted.grip, late_s, NODES_M[:-1], solver=Solver(segments=30))[0]
    changed = np.abs(exact - predicted.markers_m[0]).max()
    assert changed > 3e-5
    assert np.abs(filmed.markers_m[0] - exact).max() < 0.1 * changed


def test_a_jaw_seen_elsewhere_takes_the_cable_with_it(world, before) -> None:
    grip = world.trial.grip
    moved = replace(world.trial, grip=replace(grip, x_m=grip.x_m + 2e-5, y_m=grip.y_m - 1e-5))
    here, there = before[1].as_filmed(world.trial), before[1].as_filmed(moved)
    assert here is not None
    assert there is not None
    for at_first, then in (
        (here.markers_m, there.markers_m),
        (here.others_m, there.others_m),
    ):
        np.testing.assert_allclose(then - at_first, np.broadcast_to([2e-5, -1e-5], then.shape))


def test_a_hold_that_went_another_way_is_simulated_anew(world, before, flat_cable: Cable) -> None:
    grip = world.trial.grip
    pushed = grip.y_m + 2e-4 * (grip.t_s > 0.9 * grip.t_s[-1])
    another = replace(world.trial, grip=replace(grip, y_m=pushed))
    assert before[1].as_filmed(another) is None
    found = identify(another, NODES_M, flat_cable, previous=before[0], predicted=before[1])
    expected = identify(another, NODES_M, flat_cable, previous=before[0])
    np.testing.assert_array_equal(found.mean, expected.mean)

    late = Markers(world.trial.markers.t_s + 0.003, world.trial.markers.xy_m)
    assert before[1].as_filmed(replace(world.trial, markers=late)) is None
    fewer = Markers(world.trial.markers.t_s[:-1], world.trial.markers.xy_m[:-1])
    assert before[1].as_filmed(replace(world.trial, markers=fewer)) is None


def test_a_cable_that_turns_out_quite_different_is_simulated_anew(
    world, before, flat_cable: Cable
) -> None:
    """The last step is taken linearly, but not any step."""
    mistaken = replace(before[0], mean=before[0].mean + 0.2)
    predicted = predict_frames(world.trial, world.trial.markers.t_s, NODES_M, mistaken)
    found = identify(world.trial, NODES_M, flat_cable, previous=mistaken, predicted=predicted)
    assert found.iterations > 2
    assert in_deviations(found, identify(world.trial, NODES_M, flat_cable)) < 0.1


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_long_last_step_is_still_good_to_a_tenth_of_a_pixel(
    world, before, flat_cable: Cable, sign: float
) -> None:
    grip = before[1].grip  # without what the log's last samples say
    trial = replace(world.trial, grip=grip)
    cold = identify(trial, NODES_M, flat_cable)
    of_frames = cold.covariance - cold.gripper_covariance
    away = np.sqrt(np.diag(of_frames))
    deviations = np.linalg.norm(np.linalg.solve(np.linalg.cholesky(of_frames), away))
    mistaken = replace(cold, mean=cold.mean + sign * 25.0 / deviations * away)
    predicted = predict_frames(trial, trial.markers.t_s, NODES_M, mistaken)
    found = identify(trial, NODES_M, flat_cable, previous=mistaken, predicted=predicted)
    tips = [
        simulate(c.space.model(c.mean), grip, trial.markers.t_s, NODES_M[:1])[0, :, 0]
        for c in (found, cold, mistaken)
    ]
    assert found.iterations == 1
    assert np.abs(tips[2] - tips[1]).max() > 1e-4
    assert np.abs(tips[0] - tips[1]).max() < 2e-6


def test_a_log_is_held_on_at_rest_with_its_noise() -> None:
    t_s = np.arange(0.0, 0.8, 0.002)
    noise = np.random.default_rng(3).normal(0.0, 1e-5, len(t_s))
    y_m = -0.05 * np.clip(t_s / 0.4, 0.0, 1.0) + noise
    held = extended_at_rest(Motion(t_s, np.zeros_like(t_s), y_m, np.zeros_like(t_s)), 2.0)
    assert held.t_s[-1] >= 2.0
    np.testing.assert_allclose(np.diff(held.t_s), 0.002)
    np.testing.assert_array_equal(held.y_m[: len(t_s)], y_m)
    after = held.y_m[len(t_s) :]
    assert np.mean(after) == pytest.approx(-0.05, abs=2e-6)
    assert np.std(after) == pytest.approx(1e-5, rel=0.15)
    assert extended_at_rest(held, 1.0) is held


def test_a_hand_that_settled_does_not_settle_again() -> None:
    t_s = np.arange(0.0, 0.9, 0.002)
    y_m = -0.05 * (1.0 - np.exp(-t_s / 0.06))
    held = extended_at_rest(Motion(t_s, np.zeros_like(t_s), y_m, np.zeros_like(t_s)), 2.0)
    assert np.abs(held.y_m[len(t_s) :] + 0.05).max() < 2e-5  # 0.1 mm where its rest begins
