"""What moves a cable beside the expected is found, and the path that brings it through is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.geometry import Cable, Motion, node_arc_lengths
from cell.identify.identified import Identified
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.plan.correction import Tail, best_tail, decisions_s, moved_by, tail_response
from cell.plan.destination import Destination
from cell.plan.paths import MotionLimits, executed_motion, insertion_path
from cell.plan.response import Response, deviation, simulate_response, time_to_rest_s
from drivers.interfaces import Pose, Trajectory
from tools.worlds.made_studies import moved

SPACE = ParameterSpace.of(Cable(0.1, 0.0074, 0.016, 0.0001))
MEAN = SPACE.start(3e-5)
ARC_M = node_arc_lengths(0.1, 11)
LAG_S, NOISE_M = 0.03, 3e-5
GENTLE = MotionLimits(0.2, 1.0, 10.0)
PATH = insertion_path(Pose(0.0, -0.05), 0.02, 0.05, GENTLE, 500.0)
LOOKED_S = np.arange(0.001, 0.6, 0.005)


def motion(path: Trajectory) -> Motion:
    return executed_motion(path, LAG_S, settle_s=0.2)


END_S = float(motion(PATH).t_s[-1])


def swung(model, hand: Motion, t_s) -> np.ndarray:
    return simulate(model, hand, t_s, ARC_M)[0]


@pytest.fixture(scope="module")
def ahead() -> Response:
    covariance = 0.02**2 * np.eye(len(MEAN))
    none = np.zeros_like(covariance)
    cable = Identified(SPACE, MEAN, covariance, Noise(3e-5), 3e-5, 1.0, 9, 9, 1, "map", none)
    return simulate_response(cable, motion(PATH), 0.0, END_S, ARC_M)


@pytest.fixture(scope="module")
def hole(ahead: Response) -> Destination:
    """Narrow, and the expected tip comes through its middle."""
    tip_m = ahead.nodes_m[:, 0]
    at = int(np.argmax(tip_m[:, 0] <= -0.13))
    y_m = float(tip_m[at : at + 8, 1].mean())
    return Destination(-0.134, -0.13, y_m - 0.002, y_m + 0.002)


def knocked(hand: Motion, at_s: float, up_m: float) -> Motion:
    u = np.clip((hand.t_s - at_s) / 0.02, 0.0, 1.0)
    return replace(hand, y_m=hand.y_m + up_m * u * u * (3.0 - 2.0 * u))


def seen(model, hand: Motion, late_s: float = 0.0) -> np.ndarray:
    noise = np.random.default_rng(5).normal(0.0, NOISE_M, (len(LOOKED_S), 11, 2))
    return swung(model, hand, LOOKED_S - late_s) + noise


def test_an_end_that_is_seen_elsewhere_is_no_motion(ahead: Response) -> None:
    """All pictures show the cable's end 0.1 mm too far along it."""
    nodes_m = seen(SPACE.model(MEAN), motion(PATH))
    along = np.gradient(nodes_m, axis=1)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    wrong = nodes_m - 1e-4 * (ARC_M / ARC_M.max())[:, None] * along
    right, other = (deviation(ahead, LOOKED_S, n, NOISE_M) for n in (nodes_m, wrong))
    assert np.abs(other.tip_m - right.tip_m).max() < 4e-5


CASES = {
    "as expected": (MEAN, 0.0, 0.0, 2e-5),
    "another cable": (MEAN + 0.02, 0.0, 0.0, 5e-5),
    "a knock": (MEAN, 0.002, 0.0, 3e-4),
    "late pictures": (MEAN, 0.0, 0.008, 1e-4),
}


@pytest.mark.parametrize("case", CASES)
def test_the_tip_is_foretold_to_its_end(ahead: Response, case: str) -> None:
    """From the frames of the first 0.6 s, whatever has moved it, and how surely."""
    q, up_m, late_s, within_m = CASES[case]
    hand = knocked(motion(PATH), 0.4, up_m)
    truth = swung(SPACE.model(q), hand, ahead.t_s)[:, 0] - ahead.nodes_m[:, 0]
    found = deviation(ahead, LOOKED_S, seen(SPACE.model(q), hand, late_s), NOISE_M)
    error = np.linalg.norm(found.tip_m - truth, axis=-1)
    assert np.sqrt(np.mean(error**2)) < within_m
    assert found.misfit < 3.0
    spread = np.sqrt(np.mean(np.var(found.tips_m, axis=0), axis=0)).max()
    assert spread > 0.2 * np.sqrt(np.mean(error**2))


def test_frames_in_which_nothing_is_seen_do_not_matter(ahead: Response) -> None:
    nodes_m = seen(SPACE.model(MEAN + 0.02), motion(PATH))
    some = nodes_m.copy()
    some[np.random.default_rng(1).random(len(some)) < 0.1] = np.nan
    whole, part = (deviation(ahead, LOOKED_S, n, NOISE_M) for n in (nodes_m, some))
    assert np.abs(whole.tip_m - part.tip_m).max() < 3e-5


def test_what_no_answer_explains_shows_as_misfit(ahead: Response) -> None:
    wild = seen(SPACE.model(MEAN), motion(PATH))
    wild[:, ::2] += np.random.default_rng(2).normal(0.0, 5e-4, wild[:, ::2].shape)
    assert deviation(ahead, LOOKED_S, wild, NOISE_M).misfit > 5.0


@pytest.mark.parametrize("lasts_s", [0.12, 0.3])
def test_a_change_moves_the_tip_as_foretold(ahead: Response, lasts_s: float) -> None:
    tail = Tail(0.55, 0.003, -0.001, lasts_s, 1.0, 0.0, 0.0, ahead.nodes_m[:, 0])
    real = swung(SPACE.model(MEAN), motion(tail.of(PATH)), ahead.t_s)
    expected = moved_by(ahead, tail, LAG_S).nodes_m
    assert np.abs(real - expected).max() < 0.07 * (0.003 + 0.001)
    assert np.abs(tail_response(ahead, 0.55, lasts_s, LAG_S)[: int(0.55 / 0.005)]).max() == 0.0


@pytest.mark.parametrize(("then_m", "end_s"), [(0.0, 1.3), (-0.003, 1.6)])
def test_a_changed_path_is_the_same_until_then_and_smooth(
    ahead: Response, then_m: float, end_s: float
) -> None:
    tail = Tail(1.0, 0.004, then_m, 0.3, 1.0, 0.0, 0.0, ahead.nodes_m[:, 0])
    changed = tail.of(PATH)
    before = PATH.t_s < 1.0
    np.testing.assert_allclose(changed.y_m[: before.sum()], PATH.y_m[before], atol=1e-12)
    assert changed.t_s[-1] == pytest.approx(end_s)
    assert changed.y_m[-1] == pytest.approx(PATH.y_m[-1] + 0.004 + then_m)
    assert np.abs(np.diff(changed.y_m, 2)).max() < 0.002**2 * 2.0  # less than 2 m/s²


def test_a_knocked_cable_is_brought_through(ahead: Response, hole: Destination) -> None:
    hand, until = knocked(motion(PATH), 0.35, 0.003), LOOKED_S < 0.46
    model = SPACE.model(MEAN)
    beside = deviation(ahead, LOOKED_S[until], seen(model, hand)[until], NOISE_M)
    tail = best_tail(ahead, beside, hole, 0.5, LAG_S, 1e-4)
    assert tail is not None and tail.rise_m < 0.0
    assert tail.before < 0.1 and tail.probability > 0.9
    for path, passes in ((PATH, False), (tail.of(PATH), True)):
        tip_m = swung(model, knocked(motion(path), 0.35, 0.003), ahead.t_s)[:, 0]
        assert (float(hole.margin_m(tip_m[None])[0]) > 0.0) is passes


def test_what_goes_well_is_left_alone(ahead: Response, hole: Destination) -> None:
    wide = replace(hole, y_min_m=hole.y_min_m - 0.01, y_max_m=hole.y_max_m + 0.01)
    beside = deviation(ahead, LOOKED_S, seen(SPACE.model(MEAN), motion(PATH)), NOISE_M)
    tail = best_tail(ahead, beside, wide, 0.64, LAG_S, 1e-4)
    assert tail is None or abs(tail.rise_m) < 1e-3


def test_decisions_come_before_the_mouth_or_not_at_all(ahead: Response, hole: Destination) -> None:
    at_s = decisions_s(ahead, hole)
    through_s = float(ahead.t_s[np.argmax(ahead.nodes_m[:, 0, 0] <= hole.x_max_m)])
    assert 1 <= len(at_s) <= 3 and list(at_s) == sorted(at_s) and at_s[-1] < through_s - 0.1
    assert decisions_s(ahead, replace(hole, x_min_m=-1.1, x_max_m=-1.0)) == ()


def cable(damping: float = 1.0) -> Identified:
    mean = SPACE.start(3e-5)
    values = SPACE.natural(mean)
    mean[SPACE.names.index("viscosity")] += np.log(damping)
    assert values[SPACE.names.index("viscosity")] > 0.0
    none = np.zeros((len(mean), len(mean)))
    return Identified(SPACE, mean, none, Noise(3e-5), 3e-5, 1.0, 9, 9, 1, "map", none)


@pytest.fixture
def jerked() -> Motion:
    return moved(np.arange(0.0, 0.8, 0.002), (0.0, -0.05), 0.3)


def test_a_swing_decays_exponentially(jerked: Motion) -> None:
    """Ten times nearer takes ln 10 time constants, each time."""
    times_s = [time_to_rest_s(cable(), jerked, within_m, 60.0) for within_m in (1e-3, 1e-4, 1e-5)]
    assert 0.5 < times_s[0] < times_s[1] < times_s[2] < 60.0
    assert np.diff(times_s)[1] == pytest.approx(np.diff(times_s)[0], rel=0.15)


def test_the_noise_of_a_log_does_not_swing_on(jerked: Motion) -> None:
    """Its gripper was led to a place half a minute away by a curve that bulged by 0.08 mm."""
    rng = np.random.default_rng(1)
    noisy = replace(jerked, y_m=jerked.y_m + rng.normal(scale=1e-5, size=jerked.y_m.shape))
    told = [time_to_rest_s(cable(), motion, 5e-5, 30.0) for motion in (jerked, noisy)]
    assert told[1] == pytest.approx(told[0], abs=0.5)


def test_twice_the_viscosity_half_the_time(jerked: Motion) -> None:
    light, heavy = (time_to_rest_s(cable(d), jerked, 5e-5, 60.0) for d in (1.0, 2.0))
    assert heavy == pytest.approx(0.5 * light, rel=0.2)


def test_what_swings_longer_than_is_asked_for(jerked: Motion) -> None:
    assert time_to_rest_s(cable(0.01), jerked, 1e-6, 5.0) == pytest.approx(5.0, abs=0.2)


def test_a_cable_that_was_not_moved_rests() -> None:
    still = Motion(np.array([0.0, 1.0]), np.zeros(2), np.zeros(2), np.zeros(2))
    assert time_to_rest_s(cable(), still, 1e-5, 5.0) == 0.0
