from __future__ import annotations

import numpy as np
import pytest

from drivers.emulators.ur_arm import Joints
from drivers.emulators.ur_script import (
    DONE,
    READY,
    ControlScript,
    Registers,
    ScriptError,
)
from drivers.ur_pose import pose_of

DT = 0.002


class ScriptRun:
    def __init__(self, offset: int = 0) -> None:
        self.offset, self.registers, self.joints = offset, Registers(), Joints()
        self.seen: list[tuple] = []
        self.script = ControlScript(
            self.registers,
            self.joints,
            lambda register, hz: self.seen.append(("watch", register, hz)),
            lambda what: self.seen.append(("note", what)),
            offset,
        )

    def command(self, number: int, *values: float) -> None:
        self.registers.int_in[self.offset] = number
        for i, value in enumerate(values):
            self.registers.double_in[self.offset + i] = value

    def cycles(self, count: int = 1) -> bool:
        return all(self.script.cycle(DT) for _ in range(count))

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
    bench.command(35, 20.0)
    bench.cycles(5)
    assert bench.answer == DONE
    # once, however long it stands there
    assert bench.seen == [("watch", bench.offset, 20.0)]
    bench.command(0)
    bench.cycles()
    assert bench.answer == READY


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


def test_the_tool_moves_with_its_frame(bench) -> None:
    before, tool = bench.joints.tool(), np.eye(4)
    tool[2, 3] = 0.1
    bench.command(29, *pose_of(tool))
    bench.until(DONE)
    assert bench.joints.tool() == pytest.approx(before @ tool)


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
