"""All ways of a plan are checked before anything moves: no cable is stranded by a later refusal."""

from dataclasses import replace
from pathlib import Path

import pytest

from cell.plan.measuring import Measuring, Move
from cell.records.result import Outcome
from cell.run.plans import INSERTING, measuring
from cell.settings import load_settings
from cell.wiring.build import cell_with, twin_devices
from cell.wiring.twins import build_twins
from drivers.interfaces import Pose

FAKE = Path(__file__).parents[3] / "config" / "fake.yaml"


@pytest.fixture
def settings():
    return load_settings(FAKE)


def ran(settings, plan, runs: Path):
    """Result of a cycle with this plan, and the world in which it was."""
    twins = build_twins(settings, 1, 1)
    cell = cell_with(settings, twin_devices(twins), runs, lambda number, step: None)
    try:
        # What is tested ends before anything has to be computed.
        resetting = tuple(step for step in plan.resetting if step.name != "warm_up")
        return cell.run_cycle(1, replace(plan, resetting=resetting)), twins.world
    finally:
        cell.close()


def through(*places: tuple[float, float]) -> Measuring:
    """A measuring motion from the first place to the others."""
    start, *goals = (Pose(x, y, 0.0) for x, y in places)
    return Measuring("made", start, 0.2, tuple(Move(goal, 1.0) for goal in goals), 0.5)


@pytest.mark.parametrize(
    ("motion", "way", "point"),
    [
        (through((0.05, 0.0), (0.0, 0.0)), "go to start", "x = 0.02"),
        (through((0.0, 0.0), (0.0, -0.15), (0.0, 0.0)), "go through", "y = -0.10"),
    ],
)
def test_a_motion_that_leaves_the_limits_is_refused_before_the_grip(
    settings, tmp_path: Path, motion: Measuring, way: str, point: str
) -> None:
    result, world = ran(settings, measuring(motion), tmp_path)
    assert result.outcome is Outcome.FAILED and result.fault is not None
    assert result.fault.step == "check_paths"
    assert f"on the way '{way}' point" in result.fault.cause and point in result.fault.cause
    assert result.fault.remedy == "nothing was moved"
    assert world.gripper_rest_from_s() == 0.0
    assert "grasp" not in result.seconds


def test_every_offset_of_an_insertion_is_checked_before_the_grip(settings, tmp_path: Path) -> None:
    limits = settings.limits.model_copy(update={"y_m": (-0.07, 0.02)})
    result, world = ran(settings.model_copy(update={"limits": limits}), INSERTING, tmp_path)
    assert result.fault is not None and result.fault.step == "check_paths"
    assert "on the way 'go in" in result.fault.cause
    assert world.gripper_rest_from_s() == 0.0
