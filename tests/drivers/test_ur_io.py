"""Digital inputs and outputs of an emulated controller, and what becomes of a connection."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from drivers.emulators.launch import EmulatedController
from drivers.rtde_client import RtdeClient
from drivers.ur_io import UrIo
from tests.waiting import wait_until

STANDARD = ["standard_digital_output_mask", "standard_digital_output"]


@pytest.fixture
def controller(emulated_controller: EmulatedController) -> Iterator[EmulatedController]:
    """One with all inputs and outputs off."""
    with RtdeClient(emulated_controller.host) as client:
        groups = ("standard", "configurable", "tool")
        names = [f"{group}_digital_output" for group in groups]
        masks = [f"{name}_mask" for name in names]
        client.write(client.claim([*masks, *names]), [255, 255, 255, 0, 0, 0])
    emulated_controller.request("inputs", bits=0)
    wait_until(lambda: outputs_of(emulated_controller) == set())
    yield emulated_controller
    emulated_controller.request("hold_outputs", mask=0)


class Told:
    """What is told of the inputs, and of losses."""

    def __init__(self) -> None:
        self.inputs: frozenset[int] | None = None
        self.lost: list[str] = []

    def take(self, inputs: frozenset[int]) -> None:
        self.inputs = inputs

    def lose(self, why: str) -> None:
        self.inputs = None
        self.lost.append(why)


def outputs_of(controller: EmulatedController) -> set[int]:
    bits = controller.request("outputs")["bits"]
    return {number for number in range(18) if bits >> number & 1}


def io_of(host: str, ours: set[int], told: Told, silence_s: float = 1.0) -> UrIo:
    return UrIo(host, ours, told.take, told.lose, silence_s)


def test_standard_configurable_and_tool_bits_have_the_controllers_numbers(controller) -> None:
    told = Told()
    with io_of(controller.host, {0, 7, 8, 15, 16, 17}, told) as io:
        for number in (0, 7, 8, 15, 16, 17):
            controller.request("inputs", bits=1 << number)
            wait_until(lambda number=number: told.inputs == {number})
            io.set({number})
            wait_until(lambda number=number: outputs_of(controller) == {number})
    assert told.lost == []


def test_outputs_of_others_are_left_alone_and_ours_stay_at_the_end(controller) -> None:
    told = Told()
    with RtdeClient(controller.host) as other:
        recipe = other.claim(STANDARD)
        other.write(recipe, [0b1001, 0b1001])
        wait_until(lambda: outputs_of(controller) == {0, 3})
        with io_of(controller.host, {8, 9}, told) as io:
            io.set({8})
            wait_until(lambda: outputs_of(controller) == {0, 3, 8})
            other.write(recipe, [0b1000, 0b0000])
            wait_until(lambda: outputs_of(controller) == {0, 8})
            io.set({9})  # and ends at once
    assert outputs_of(controller) == {0, 9}
    assert told.lost == []


def test_outputs_that_somebody_has_are_waited_for(controller) -> None:
    told = Told()
    with RtdeClient(controller.host) as other:
        other.claim(STANDARD)
        with io_of(controller.host, {2}, told) as io:
            io.set({2})
            wait_until(lambda: len(told.lost) > 1)
            assert controller.host in told.lost[0] and "is in use by another client" in told.lost[0]
            assert told.inputs is None
            other.close()
            wait_until(lambda: told.inputs == frozenset())
            assert outputs_of(controller) == {2}


def test_an_output_that_does_not_follow_is_said_and_inputs_do_not_count(controller) -> None:
    told = Told()
    controller.request("hold_outputs", mask=0b100)
    with io_of(controller.host, {1, 2}, told) as io:
        wait_until(lambda: told.inputs is not None)
        io.set({1, 2})
        wait_until(lambda: bool(told.lost))
        assert "digital output 2 does not follow" in told.lost[0]
        assert told.inputs is None
        controller.request("hold_outputs", mask=0)
        wait_until(lambda: told.inputs is not None)
        assert outputs_of(controller) == {1, 2}


@pytest.mark.parametrize("loss", ["drop", "freeze", "power_cycle"])
def test_after_a_loss_the_outputs_are_set_again(controller, loss: str) -> None:
    told = Told()
    with io_of(controller.host, {4}, told, silence_s=0.3) as io:
        io.set({4})
        wait_until(lambda: told.inputs is not None)
        seconds = {"drop": {}, "freeze": {"seconds": 0.6}, "power_cycle": {"seconds": 0.3}}
        controller.request(loss, **seconds[loss])
        wait_until(lambda: bool(told.lost))
        controller.request("inputs", bits=0b10)
        wait_until(lambda: told.inputs == {1})
        assert outputs_of(controller) == {4}


def test_nobody_there_is_said_and_does_not_keep_the_end(free_loopback) -> None:
    told, host = Told(), free_loopback()
    with io_of(host, {0}, told):
        wait_until(lambda: bool(told.lost))
        begun_s = time.monotonic()
    assert time.monotonic() - begun_s < 3.0
    assert told.lost[0].startswith(f"{host}: ") and "refused" in told.lost[0]


def test_an_arm_that_is_moved_by_ur_rtde_is_not_disturbed(controller) -> None:
    rtde_control = pytest.importorskip("rtde_control", reason="ur-rtde has no wheel here")
    told = Told()
    with io_of(controller.host, {0, 8, 16}, told) as io:
        wait_until(lambda: told.inputs is not None)
        control = rtde_control.RTDEControlInterface(controller.host)
        try:
            joints = controller.request("state")["q_rad"]
            io.set({0, 8, 16})
            assert control.moveJ([joints[0] + 0.05, *joints[1:]], 1.0, 1.0)
            assert controller.request("state")["q_rad"][0] == pytest.approx(
                joints[0] + 0.05, abs=1e-3
            )
            wait_until(lambda: outputs_of(controller) == {0, 8, 16})
            assert control.isConnected()
        finally:
            control.stopScript()
            control.disconnect()
    assert told.lost == []
