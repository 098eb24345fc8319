"""What the controller reports, and what it means for the arm: the gravest first, with a remedy."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from drivers.interfaces import ArmMode
from drivers.ur_robot import Robot

NORMAL, PROTECTIVE, SAFEGUARD, SYSTEM_EMERGENCY, ROBOT_EMERGENCY, EMERGENCY = 0, 2, 4, 5, 6, 7
VIOLATION, FAULT, STOPPED_FOR_SAFETY = 8, 9, 10


def mode(
    *bits: int,
    runtime: int = 2,
    robot: int = 7,
    remote: bool = True,
    slider: float = 1.0,
    scaling: float = 1.0,
    moving: bool = False,
) -> ArmMode:
    it = Robot.__new__(Robot)
    it.receive = SimpleNamespace(
        getSafetyStatusBits=lambda: sum(1 << bit for bit in bits),
        getRobotMode=lambda: robot,
        getRuntimeState=lambda: runtime,
        getTargetSpeedFraction=lambda: slider,
        getSpeedScaling=lambda: scaling,
    )
    it._pendant = SimpleNamespace(is_remote=remote)
    return it.mode(moving)


@pytest.mark.parametrize(
    ("bits", "expected"),
    [
        ((NORMAL,), ArmMode.READY),
        ((PROTECTIVE, STOPPED_FOR_SAFETY), ArmMode.PROTECTIVE_STOP),
        ((SAFEGUARD, STOPPED_FOR_SAFETY), ArmMode.SAFEGUARD_STOP),
        ((SYSTEM_EMERGENCY,), ArmMode.EMERGENCY_STOP),
        ((ROBOT_EMERGENCY, EMERGENCY), ArmMode.EMERGENCY_STOP),
        ((SAFEGUARD, EMERGENCY), ArmMode.EMERGENCY_STOP),
        ((VIOLATION,), ArmMode.PROTECTIVE_STOP),
        ((FAULT,), ArmMode.PROTECTIVE_STOP),
        ((STOPPED_FOR_SAFETY,), ArmMode.PROTECTIVE_STOP),
    ],
)
def test_safety_comes_before_everything_else(bits: tuple[int, ...], expected: ArmMode) -> None:
    assert mode(*bits) is expected
    if expected is not ArmMode.READY:
        assert mode(*bits, runtime=1, robot=3, remote=False, slider=0.1) is expected


def test_power_program_control_and_speed_in_this_order() -> None:
    assert mode(NORMAL, robot=5, runtime=1, remote=False, slider=0.1) is ArmMode.POWER_OFF
    assert mode(NORMAL, runtime=1, remote=False, slider=0.1) is ArmMode.LOCAL_CONTROL
    assert mode(NORMAL, remote=False, slider=0.1) is ArmMode.LOCAL_CONTROL, "though a program runs"
    assert mode(NORMAL, runtime=1, slider=0.1) is ArmMode.STOPPED
    assert mode(NORMAL, slider=0.99) is ArmMode.REDUCED_SPEED


def test_the_controllers_own_limiter_counts_in_motion_only() -> None:
    assert mode(NORMAL, scaling=0.5) is ArmMode.READY
    assert mode(NORMAL, scaling=0.5, moving=True) is ArmMode.REDUCED_SPEED
    assert mode(NORMAL, moving=True) is ArmMode.READY


@pytest.mark.parametrize("one", [m for m in ArmMode if m is not ArmMode.READY])
def test_every_mode_but_ready_has_a_remedy(one: ArmMode) -> None:
    assert one.remedy
