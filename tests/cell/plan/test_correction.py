"""Leave the path, change it, or stop: from frames alone."""

from __future__ import annotations

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.geometry import Cable, Motion, node_arc_lengths
from cell.identify.identified import Identified
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.plan.correction import LEAST, LEAST_FRAMES, Flight
from cell.plan.destination import Destination
from cell.plan.paths import MotionLimits, executed_motion, insertion_path
from cell.plan.response import simulate_response
from drivers.interfaces import Pose

SPACE = ParameterSpace.of(Cable(0.1, 0.0074, 0.016, 0.0001))
MEAN = SPACE.start(3e-5)
ARC_M, LAG_S, NOISE_M = node_arc_lengths(0.1, 11), 0.03, 3e-5
PATH = insertion_path(Pose(0.0, -0.05), 0.02, 0.05, MotionLimits(0.2, 1.0, 10.0), 500.0)
HAND = executed_motion(PATH, LAG_S, settle_s=0.2)
FRAMES_S = np.arange(-0.02, 0.46, 0.005)


@pytest.fixture(scope="module")
def flight() -> Flight:
    """The expected tip comes through the middle of a narrow opening."""
    covariance = 0.01**2 * np.eye(len(MEAN))
    none = np.zeros_like(covariance)
    cable = Identified(SPACE, MEAN, covariance, Noise(3e-5), 3e-5, 1.0, 9, 9, 1, "map", none)
    ahead = simulate_response(cable, HAND, 0.0, float(HAND.t_s[-1]), ARC_M)
    tip_m = ahead.nodes_m[:, 0]
    at = int(np.argmax(tip_m[:, 0] <= -0.13))
    y_m = float(tip_m[at : at + 8, 1].mean())
    hole = Destination(-0.134, -0.13, y_m - 0.002, y_m + 0.002)
    return Flight(ahead, hole, NOISE_M, LAG_S, 1e-4)


def frames(up_m: float) -> np.ndarray:
    """Nodes as seen if the gripper is knocked up 0.3 s after it began to move."""
    u = np.clip((HAND.t_s - 0.3) / 0.02, 0.0, 1.0)
    knocked = Motion(HAND.t_s, HAND.x_m, HAND.y_m + up_m * u * u * (3 - 2 * u), HAND.angle_rad)
    nodes_m = simulate(SPACE.model(MEAN), knocked, FRAMES_S, ARC_M)[0]
    return nodes_m + np.random.default_rng(5).normal(0.0, NOISE_M, nodes_m.shape)


def test_what_passes_is_left(flight: Flight) -> None:
    decision = flight.decide(FRAMES_S, frames(0.0), 0.5)
    assert decision.withheld is None and not decision.hopeless
    assert decision.probability == pytest.approx(1.0, abs=1e-3)


def test_what_can_be_mended_is_changed(flight: Flight) -> None:
    decision = flight.decide(FRAMES_S, frames(0.003), 0.5)
    assert decision.hopeless and decision.tail is not None
    assert decision.tail.probability > 0.9 > LEAST
    after = flight.changed(decision.tail).decide(FRAMES_S, frames(0.003), 0.5)
    assert after.probability is not None and after.probability > 0.8, "the change is expected now"


def test_what_comes_too_late_is_hopeless(flight: Flight) -> None:
    """So short before the opening no change of height brings it through."""
    decision = flight.decide(FRAMES_S, frames(0.004), 0.7)
    assert decision.hopeless and decision.tail is None and decision.withheld is None


def test_without_frames_nothing_is_decided(flight: Flight) -> None:
    nodes_m = frames(0.0)
    nodes_m[LEAST_FRAMES + 3 :] = np.nan  # the first four are from before the gripper moved
    decision = flight.decide(FRAMES_S, nodes_m, 0.5)
    assert decision.withheld == f"the cable is seen in {LEAST_FRAMES - 1} frames"
    assert decision.tail is None and not decision.hopeless


def test_what_is_not_explained_decides_nothing(flight: Flight) -> None:
    nodes_m = frames(0.0)
    nodes_m[:, ::2] += np.random.default_rng(2).normal(0.0, 5e-4, nodes_m[:, ::2].shape)
    decision = flight.decide(FRAMES_S, nodes_m, 0.5)
    assert decision.withheld is not None and "misfit" in decision.withheld
    assert decision.tail is None and not decision.hopeless
