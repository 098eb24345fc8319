from __future__ import annotations

import numpy as np
import pytest

from drivers.emulators.ur_controller import Controller, ControllerOptions, Runtime, Safety
from drivers.ur_pose import pose_of

PROGRAM = "global reg_offset_int = # int register offset\n0\n# RTDE Control script - Main loop #"


@pytest.fixture
def controller() -> Controller:
    it = Controller(ControllerOptions())
    it.upload(PROGRAM)
    ticks(it, 30)
    assert it.runtime is Runtime.PLAYING
    return it


def ticks(controller: Controller, count: int) -> None:
    for _ in range(count):
        controller.tick()


def servo(controller: Controller, dz_m: float = -0.05) -> None:
    goal = controller.joints.tool()
    goal[2, 3] += dz_m
    values = [*pose_of(goal), 0.0, 0.0, 0.002, 0.1, 300.0]
    controller.write({f"input_double_register_{i}": float(v) for i, v in enumerate(values)})
    controller.write({"input_int_register_0": 24})


def events(controller: Controller) -> list[str]:
    return [e.what for e in controller.events]


def moving(controller: Controller) -> bool:
    return bool(np.any(controller.joints.qd_rad_per_s))


def test_a_fed_watchdog_lets_it_move_and_a_hungry_one_stops_it(controller) -> None:
    controller.write({"input_double_register_0": 20.0, "input_int_register_0": 35})
    ticks(controller, 2)
    for _ in range(40):
        servo(controller, -0.0005)
        controller.tick()
    assert controller.runtime is Runtime.PLAYING and moving(controller)
    ticks(controller, 26)  # 52 ms of silence
    assert controller.runtime is Runtime.STOPPED
    assert "program ended: watchdog: no command in time" in events(controller)
    ticks(controller, 50)
    assert not moving(controller)


@pytest.mark.parametrize(
    ("stop", "safety", "bit"),
    [
        (lambda c: c.protective_stop("test"), Safety.PROTECTIVE_STOP, 2),
        (lambda c: c.safeguard_stop(), Safety.SAFEGUARD_STOP, 4),
        (lambda c: c.emergency_stop(), Safety.ROBOT_EMERGENCY_STOP, 6),
    ],
)
def test_safety_stops_bring_the_arm_to_rest_and_keep_it_there(
    controller, stop, safety, bit
) -> None:
    servo(controller)
    ticks(controller, 20)
    assert moving(controller)
    stop(controller)
    ticks(controller, 25)
    assert not moving(controller)
    (bits,) = controller.outputs(["safety_status_bits"])
    assert bits >> bit & 1 and bits >> 10 & 1 and not bits & 1
    assert controller.dashboard("safetymode") == f"Safetymode: {safety}"
    controller.upload(PROGRAM)
    ticks(controller, 50)
    assert controller.runtime is not Runtime.PLAYING
    controller.clear_safety()
    ticks(controller, 50)
    assert controller.runtime is not Runtime.PLAYING  # nobody has started it


def test_a_protective_stop_is_unlocked_only_after_five_seconds(controller) -> None:
    controller.protective_stop("test")
    assert "until 5s" in controller.dashboard("unlock protective stop")
    ticks(controller, 2501)
    assert controller.dashboard("unlock protective stop") == "Protective stop releasing"
    assert controller.safety is Safety.NORMAL
    assert controller.dashboard("play") == "Starting program"


def test_too_fast_a_target_is_a_protective_stop(controller) -> None:
    controller.write({f"input_double_register_{i}": 3.0 for i in range(6)})
    controller.write({"input_double_register_9": 0.03, "input_int_register_0": 11})
    ticks(controller, 10)
    assert controller.safety is Safety.PROTECTIVE_STOP
    assert any("a joint turns at" in e for e in events(controller))


def test_a_runtime_error_ends_the_program(controller) -> None:
    servo(controller, -5.0)
    controller.tick()
    assert controller.runtime is Runtime.STOPPED
    assert any("runtime error: inverse kinematics" in e for e in events(controller))


def test_local_control_and_foreign_programs_are_refused() -> None:
    controller = Controller(ControllerOptions())
    controller.upload("def popup():\n popup('x')\nend")
    controller.remote_control = False
    controller.upload(PROGRAM)
    ticks(controller, 50)
    assert controller.runtime is Runtime.STOPPED
    assert controller.dashboard("is in remote control") == "false"
    assert [e.split(":")[0] for e in events(controller)] == ["program refused", "upload refused"]


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("PolyscopeVersion", "URSoftware 5.12.2.1101534 (Jul 06 2022)"),
        ("get serial number", "20225500001"),
        ("stop", "Stopped"),
        ("pause", "Pausing program"),
        ("play", "Failed to execute: play"),
        ("running", "Program running: true"),
        ("programState", "PLAYING rtde_control"),
        ("robotmode", "Robotmode: RUNNING"),
        ("make coffee", "could not understand: 'make coffee'"),
    ],
)
def test_dashboard_answers_letter_by_letter(controller, line, answer) -> None:
    assert controller.dashboard(line) == answer


def test_time_scale_makes_it_faster() -> None:
    slow, fast = (Controller(ControllerOptions(time_scale=s)) for s in (1.0, 10.0))
    began = slow.time_s
    ticks(slow, 100)
    ticks(fast, 100)
    assert fast.time_s - began == pytest.approx(10.0 * (slow.time_s - began))


def test_a_busy_computer_makes_it_miss_cycles_but_not_lose_time() -> None:
    controller = Controller(ControllerOptions(time_scale=2.0))
    before_s = controller.time_s
    controller.tick()
    controller.miss(50)
    assert controller.time_s - before_s == pytest.approx(51 * 0.004)
    assert "50 cycles missed" in controller.events[-1].what
