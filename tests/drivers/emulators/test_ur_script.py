from __future__ import annotations

import numpy as np
import pytest

from drivers.emulators.ur_arm import Joints
from drivers.emulators.ur_script import (
    DONE,
    READY,
    ControlScript,
    Effects,
    Registers,
    ScriptError,
)
from drivers.ur_pose import pose_of

DT = 0.002


class ScriptRun:
    def __init__(self, offset: int = 0) -> None:
        self.offset, self.registers, self.joints = offset, Registers(), Joints()
        self.seen: list[tuple] = []
        effects = Effects(
            lambda why: self.seen.append(("stop", why)),
            lambda register, hz: self.seen.append(("watch", register, hz)),
            lambda kg: self.seen.append(("payload", kg)),
            lambda what: self.seen.append(("note", what)),
        )
        self.script = ControlScript(self.registers, self.joints, effects, offset)

    def command(self, number: int, *values: float, asynchronous: int = 0) -> None:
        self.registers.int_in[self.offset] = number
        self.registers.int_in[self.offset + 1] = asynchronous
        for i, value in enumerate(values):
            self.registers.double_in[self.offset + i] = value

    def cycles(self, count: int = 1) -> bool:
        return all(self.script.cycle(DT, 1.0) for _ in range(count))

    @property
    def answer(self) -> int:
        return self.registers.int_out[self.offset]

    def until(self, answer: int, limit: int = 3000) -> int:
        for n in range(limit):
            if self.answer == answer:
                return n
            self.cycles()
        raise AssertionError(f"no answer {answer} within {limit} cycles")


@pytest.fixture(params=[0, 24])
def bench(request) -> ScriptRun:
    return ScriptRun(request.param)


def test_handshake_of_a_regular_command(bench) -> None:
    assert bench.answer == READY
    bench.command(17, 1.5)
    bench.cycles(5)
    assert bench.answer == DONE
    assert bench.seen == [("payload", 1.5)]  # once, however long it stands there
    bench.command(0)
    bench.cycles()
    assert bench.answer == READY


def test_a_blocking_move_is_done_on_arrival(bench) -> None:
    goal = bench.joints.tool()
    goal[2, 3] -= 0.02
    bench.command(3, *pose_of(goal), 0.25, 1.2)
    bench.cycles()
    assert bench.answer == READY
    assert bench.until(DONE) > 20
    assert bench.joints.tool() == pytest.approx(goal, abs=1e-6)


def test_an_asynchronous_move_is_done_at_once_and_reports_progress(bench) -> None:
    progress = bench.offset + 2
    goal = bench.joints.q_rad + 0.1
    bench.command(1, *goal, 1.0, 5.0, asynchronous=1)
    bench.cycles(2)
    assert bench.answer == DONE
    assert bench.registers.int_out[progress] & 0x8000
    bench.command(0)
    bench.cycles(500)
    assert not bench.registers.int_out[progress] & 0x8000
    assert bench.joints.q_rad == pytest.approx(goal)


def test_a_servo_goes_on_when_its_command_is_cleared_and_ends_with_servo_stop(bench) -> None:
    goal = bench.joints.tool()
    goal[2, 3] -= 0.01
    bench.command(24, *pose_of(goal), 0.0, 0.0, 0.002, 0.03, 300.0)
    bench.cycles(5)
    assert bench.answer == READY
    bench.command(0)
    bench.cycles(200)
    assert bench.joints.tool() == pytest.approx(goal, abs=1e-5)
    bench.command(16, 5.0)
    bench.until(DONE)
    assert not np.any(bench.joints.qd_rad_per_s)


def test_a_stale_servo_command_moves_a_new_program_too() -> None:
    """Hardware trap 4: the register still holds the old command after an upload."""
    bench = ScriptRun()
    goal = bench.joints.tool()
    goal[2, 3] -= 0.05
    bench.command(24, *pose_of(goal), 0.0, 0.0, 0.002, 0.03, 300.0)
    assert bench.cycles(200)
    assert bench.joints.tool()[2, 3] == pytest.approx(goal[2, 3], abs=1e-4)


def test_answers_of_the_kinematic_commands(bench) -> None:
    out = slice(bench.offset, bench.offset + 6)
    goal = bench.joints.tool()
    goal[2, 3] -= 0.05
    bench.command(46, *pose_of(goal))
    bench.until(DONE)
    q = np.array(bench.registers.double_out[out])
    assert bench.joints.model.forward(q) == pytest.approx(goal, abs=1e-6)
    bench.command(0)
    bench.cycles()
    bench.command(43)
    bench.until(DONE)
    assert bench.registers.double_out[out] == pytest.approx(pose_of(bench.joints.tool()))


def test_watchdog_steady_and_protective_stop(bench) -> None:
    for number, value in ((35, 20.0), (47, 0.0), (31, 0.0)):
        bench.command(number, value)
        bench.until(DONE)
        bench.command(0)
        bench.cycles()
    assert ("watch", bench.offset, 20.0) in bench.seen
    assert bench.registers.int_out[bench.offset + 1] == 1
    assert any(kind == "stop" for kind, *_ in bench.seen)


def test_stop_script_ends_the_program(bench) -> None:
    bench.command(255)
    assert not bench.cycles()


def test_an_unreachable_target_is_a_runtime_error(bench) -> None:
    bench.command(24, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    with pytest.raises(ScriptError, match=r"inverse kinematics: UR5e does not reach x = 2.0000"):
        bench.cycles()


def test_a_command_that_is_not_emulated_is_a_runtime_error(bench) -> None:
    bench.command(18)
    with pytest.raises(ScriptError, match="command 18 is not emulated"):
        bench.cycles()
