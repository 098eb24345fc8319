from dataclasses import replace

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.geometry import Cable, Motion
from cell.cable.gripper_motions import GripperMotions
from cell.cable.solver import Solver
from cell.identify.identified import Identified
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.plan.choose import (
    SMALL_CHANGE,
    ChoiceOptions,
    Forecast,
    choose,
    deviates,
    enough_frames,
    expected_change,
    forecast,
)
from cell.plan.destination import Destination
from cell.plan.paths import MotionLimits, executed_motion, insertion_path
from drivers.interfaces import Pose
from tools.worlds.made_studies import moved

OFFSETS_M = np.array([0.0, 0.01, 0.02])
SPACE = ParameterSpace.of(Cable(0.1, 0.0074, 0.016, 0.0001))


def identified(std: float) -> Identified:
    mean = SPACE.start(3e-5)
    covariance = std**2 * np.eye(len(mean))
    none = np.zeros_like(covariance)
    return Identified(SPACE, mean, covariance, Noise(5e-5), 5e-5, 1.0, 250, 250, 2, "map", none)


@pytest.fixture(scope="module")
def motions() -> list[Motion]:
    paths = [insertion_path(Pose(0, 0), o, 0.05, MotionLimits(), 500.0) for o in OFFSETS_M]
    return [executed_motion(path, 0.03, settle_s=0.1) for path in paths]


@pytest.fixture(scope="module")
def expected(motions: list[Motion]) -> Forecast:
    return forecast(identified(0.01), OFFSETS_M, motions)


def hole_around(expected: Forecast, index: int, half_height_m: float) -> Destination:
    """A destination whose opening the tip of one offset meets in the middle."""
    opening, depth = -0.13, 0.004
    tip = expected.tip_m[index]
    at = int(np.argmax(tip[:, 0] <= opening))
    y = float(tip[at, 1])
    return Destination(opening - depth, opening, y - half_height_m, y + half_height_m)


def test_the_offset_that_meets_the_hole_is_chosen(expected: Forecast) -> None:
    for index in range(3):
        choice = choose(expected, identified(0.01), hole_around(expected, index, 0.004))
        assert choice.chosen
        assert choice.best.offset_m == OFFSETS_M[index]
        assert choice.best.probability == 1.0
        assert choice.best.margin_m > 0.0
        np.testing.assert_array_equal(choice.tip_m, expected.tip_m[index])
        assert sum(o.probability > 0.5 for o in choice.table) == 1


def test_uncertain_parameters_lower_the_probability(expected: Forecast) -> None:
    hole = hole_around(expected, 1, 0.004)
    sure, unsure = (choose(expected, identified(std), hole) for std in (0.01, 0.3))
    assert unsure.best.margin_std_m > 5.0 * sure.best.margin_std_m
    assert unsure.best.probability < 0.9
    assert not unsure.chosen
    assert unsure.reason is not None
    assert "10 mm" in unsure.reason


def test_none_passes_gives_the_reason_and_the_nearest(expected: Forecast) -> None:
    hole = hole_around(expected, 2, 0.002)
    far = replace(hole, y_min_m=hole.y_min_m - 0.1, y_max_m=hole.y_max_m - 0.1)
    choice = choose(expected, identified(0.01), far)
    assert not choice.chosen
    assert choice.best.offset_m == 0.02
    assert choice.best.margin_m < -0.05
    assert choice.reason is not None
    assert "no offset passes" in choice.reason


def test_probability_agrees_with_simulating_the_samples(
    expected: Forecast, motions: list[Motion]
) -> None:
    """The linear spread of tips against cables drawn from the posterior and really simulated."""
    wide = identified(0.05)
    hole = hole_around(expected, 1, 0.002)
    options = ChoiceOptions(samples=256, repeatability_m=0.0)
    probability = choose(expected, wide, hole, options).table[1].probability
    models = wide.models(np.random.default_rng(0).normal(size=(128, len(wide.mean))))
    tips = simulate(models, motions[1], expected.t_s, np.array([0.1]), solver=Solver())[:, :, 0]
    simulated = float(np.mean(hole.margin_m(tips) > 0.0))
    assert 0.2 < simulated < 0.98
    assert probability == pytest.approx(simulated, abs=0.12)


def test_last_moment_change_of_parameters_needs_no_simulation(
    expected: Forecast, motions: list[Motion]
) -> None:
    later = replace(identified(0.01), mean=expected.mean + 0.01)
    exact = forecast(later, OFFSETS_M, motions)
    moved = expected.moved_to(later.mean)
    changed = np.abs(exact.tip_m - expected.tip_m).max()
    assert changed > 2e-4
    assert np.abs(moved.tip_m - exact.tip_m).max() < 0.05 * changed


def test_longer_steps_and_segments_are_good_enough_for_slopes(
    expected: Forecast, motions: list[Motion]
) -> None:
    step = 1e-3 * np.eye(len(expected.mean))
    models = [SPACE.model(q) for q in np.vstack([expected.mean + step, expected.mean - step])]
    tips = simulate(models, motions[1], expected.t_s, np.array([0.1]))[:, :, 0]
    exact = (tips[: len(step)] - tips[len(step) :]) / 2e-3
    found = np.moveaxis(expected.sensitivity[1], -1, 0)
    assert np.abs(found - exact).max() < 0.01 * np.abs(exact).max()
    (tip,) = simulate(SPACE.model(expected.mean), motions[1], expected.t_s, np.array([0.1]))
    np.testing.assert_allclose(expected.tip_m[1], tip[:, 0], atol=1e-9)


def test_what_was_before_the_paths_is_simulated_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The history of the hold counts once, not once per offset."""
    paths = [insertion_path(Pose(0, -0.05), o, 0.05, MotionLimits(), 500.0) for o in OFFSETS_M]
    before_s = np.arange(-1.5, -0.3, 0.002)
    history = moved(before_s, (0.0, -0.05), 0.3, begin_s=-1.4)
    motions = [executed_motion(p, 0.03, settle_s=0.1, history=history) for p in paths]
    lanes_before = []

    def noted(self, order, steps):
        if steps.start_s < -0.01:
            lanes_before.extend(set(order))
        return at_steps(self, order, steps)

    at_steps = GripperMotions.at_steps
    monkeypatch.setattr(GripperMotions, "at_steps", noted)
    found = forecast(identified(0.01), OFFSETS_M, motions)
    # once at full steps, and each of the neighbours for the slopes
    assert len(lanes_before) == 1 + 1 + len(found.mean)
    tips = simulate(SPACE.model(found.mean), motions, found.t_s, np.array([0.1]))[:, :, 0]
    np.testing.assert_allclose(found.tip_m, tips, atol=1e-7)


def test_one_motion_per_offset(motions: list[Motion]) -> None:
    with pytest.raises(ValueError, match="3 offsets but 2 motions"):
        forecast(identified(0.01), OFFSETS_M, motions[:2])


def test_what_the_model_misses_lowers_the_probability_and_is_the_reason(expected: Forecast) -> None:
    """5 mm at the tip are 10 mm in the forecast: ± 4 mm lets pass at most 2 Φ(0.4) − 1."""
    hole = hole_around(expected, 1, 0.004)
    exact = replace(identified(1e-4), model_error_m=0.0)
    right = choose(expected, exact, hole)
    wrong = choose(expected, replace(exact, model_error_m=5e-3), hole)
    assert right.chosen and right.best.probability == 1.0
    assert not wrong.chosen
    assert wrong.best.probability < 0.32
    assert "misses this cable's tip by 5.00 mm while it swings" in str(wrong.reason)
    assert wrong.model_misses


@pytest.mark.parametrize("dimensions", [9, 63, 64, 104])
def test_there_are_enough_deviates_for_as_many_parameters_as_a_model_has(dimensions: int) -> None:
    """The paper's method has one for every node, of which there may be a hundred."""
    drawn = deviates(dimensions, ChoiceOptions().samples)
    assert len(drawn) == (64 if dimensions <= 32 else 2 * dimensions)
    np.testing.assert_allclose(drawn.T @ drawn / len(drawn), np.eye(dimensions), atol=1e-9)


MEAN = SPACE.start(3e-5)
HOLE = Destination(-0.135, -0.130, -0.005, 0.005)
CERTAIN = ChoiceOptions(repeatability_m=1e-9, samples=512)


def cable(std: float) -> Identified:
    """A cable of which one coordinate is so uncertain; the model lacks nothing."""
    covariance = np.diag([std**2, *np.full(len(MEAN) - 1, 1e-12)])
    none = np.zeros_like(covariance)
    return Identified(SPACE, MEAN, covariance, Noise(5e-5), 0.0, 1.0, 250, 250, 2, "map", none)


def straight(height_m: float) -> Forecast:
    """One offset whose tip passes level at a height, and by as much higher as the coordinate is."""
    t_s = np.linspace(0.0, 1.0, 101)
    tip_m = np.column_stack([-0.1 - 0.05 * t_s, np.full(101, height_m)])
    slopes = np.zeros((1, 101, 2, len(MEAN)))
    slopes[0, :, 1, 0] = 1.0
    one = np.ones(1)
    return Forecast(0.0 * one, 0.0 * one, one, 0.0 * one, t_s, MEAN, tip_m[None], slopes)


def change(height_m: float, std_m: float, options: ChoiceOptions = CERTAIN) -> float:
    asked = straight(height_m), cable(std_m), HOLE, options
    return expected_change(choose(*asked), *asked)


def test_what_passes_by_far_does_not_change() -> None:
    assert change(0.0, 1e-3) == 0.0


@pytest.mark.parametrize("height_m", [0.0045, 0.005, 0.0055])
def test_a_known_cable_passes_or_does_not(height_m: float) -> None:
    """With probability p it will prove to pass: |known − p| is 2 p (1 − p) in the mean."""
    chance = choose(straight(height_m), cable(1e-3), HOLE, CERTAIN).best.probability
    assert change(height_m, 1e-3) == pytest.approx(2.0 * chance * (1.0 - chance), abs=0.02)


def test_of_what_is_not_the_cables_more_frames_tell_nothing() -> None:
    shaken = replace(CERTAIN, repeatability_m=1e-3)
    assert 0.1 < choose(straight(0.005), cable(1e-6), HOLE, shaken).best.probability < 0.9
    assert change(0.005, 1e-6, shaken) < 1e-3


def test_a_cable_to_be_rejected_is_worth_all_frames() -> None:
    asked = straight(0.02), cable(1e-6), HOLE, CERTAIN
    assert expected_change(choose(*asked), *asked) < SMALL_CHANGE
    assert not enough_frames(choose(*asked), *asked)


def test_enough_where_nothing_would_change_else_not() -> None:
    for std_m, enough in ((1e-4, True), (2e-3, False)):
        asked = straight(0.002), cable(std_m), HOLE, CERTAIN
        assert choose(*asked).chosen
        assert enough_frames(choose(*asked), *asked) is enough
