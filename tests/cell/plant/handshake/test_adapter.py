"""The adapter over every carrier: a scripted PLC that misbehaves, and losses at either end."""

from __future__ import annotations

from pathlib import Path

import pytest

from cell.plant.handshake.adapter import HandshakeAdapter
from cell.run.machine import CellState, MachineEvent
from cell.settings.plant import Handshake
from tests.cell.plant.handshake.conftest import FakeCarrier, FakeCell, FakeWire, Wired
from tests.waiting import wait_until
from tools.faults.scripted_plc import HABITS, Plc, places, play


def test_a_plc_that_misbehaves_gets_one_cycle_for_each_start(
    fake: FakeCell, adapter: HandshakeAdapter, wired: Wired
) -> None:
    told: list[str] = []

    def log(**entry: object) -> None:
        told.append(str(entry["told"]))

    play(wired.plc(), len(HABITS), log)
    assert len(told) == fake.starts == len(HABITS)
    assert told == ["done", "done", "rejected", "done", "done", "rejected", "fault", "fault"]
    assert CellState.SUSPENDED in fake.states
    asked = [(request.command, request.by) for request in fake.asked]
    assert (MachineEvent.CLEAR, "plc") in asked and (MachineEvent.RESET, "plc") in asked


def test_a_plc_that_is_lost_starts_nothing_when_it_comes_back(
    fake: FakeCell,
    adapter: HandshakeAdapter,
    wired: Wired,
    caplog: pytest.LogCaptureFixture,
) -> None:
    plc = wired.plc()
    plc.connect()
    caplog.clear()
    plc.wire.part()
    wait_until(lambda: "the PLC is away: " in caplog.text)
    plc.mend(start=True)
    plc.wait(lambda heard: not heard["fault"])
    plc.quiet()
    assert fake.starts == 0
    plc.say(start=False)
    assert plc.cycle() == "done"
    assert "the PLC is there again" in caplog.text


def test_a_stop_stops_and_needs_an_acknowledgement(
    fake: FakeCell, adapter: HandshakeAdapter, wired: Wired
) -> None:
    plc = wired.plc()
    plc.connect()
    plc.begin()
    plc.say(start=False, stop=True)
    plc.wait(lambda heard: heard["fault"])
    plc.say(stop=False, start=True)
    plc.quiet()
    plc.say(start=False, acknowledge=True)
    plc.wait(lambda heard: heard["ready"])
    assert [request.command for request in fake.asked] == [
        MachineEvent.START,
        MachineEvent.STOP,
        MachineEvent.RESET,
    ]


def test_a_cell_that_is_away_is_a_fault_and_is_not_started_when_it_comes(
    runs: Path, adapter: HandshakeAdapter, wired: Wired
) -> None:
    plc = wired.plc()
    plc.say(part_present=True, upstream_ready=True, downstream_ready=True)
    plc.wait(lambda heard: heard["fault"] and not heard["ready"])
    plc.say(start=True)
    with FakeCell(runs) as fake:
        plc.wait(lambda heard: not heard["fault"])
        plc.quiet()
        assert fake.starts == 0
        plc.say(start=False)
        assert plc.cycle() == "done"
    plc.wait(lambda heard: heard["fault"] and not heard["busy"])


def test_a_start_that_waited_while_the_adapter_was_halted_starts_nothing(
    fake: FakeCell, runs: Path
) -> None:
    """The PLC's start moved the arm when the adapter went on, however late."""
    wired_up = FakeWire(60.0)  # a PLC that may be silent for long, so its silence tells nothing
    said = Handshake.model_validate({"silence_s": 60.0, **places()})
    adapter = HandshakeAdapter(FakeCarrier(said, wired_up), runs, "plc")
    plc = Plc(wired_up)

    def looks() -> None:
        for _ in range(3):
            adapter.poll()

    plc.say(part_present=True, upstream_ready=True, downstream_ready=True)
    looks()
    adapter._polled_s -= 1.5  # halted for so long
    looks()  # the start arrives after the first look
    plc.say(start=True)
    looks()
    assert fake.starts == 0
    plc.say(start=False)
    looks()
    adapter._no_edges_until_s -= 1.1  # another second has passed
    looks()
    plc.say(start=True)
    looks()
    assert fake.starts == 1
    adapter.close()
