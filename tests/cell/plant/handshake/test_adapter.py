"""The adapter over every carrier: a scripted PLC that misbehaves, and losses at either end."""

from __future__ import annotations

from pathlib import Path

import pytest

from cell.plant.handshake.adapter import HandshakeAdapter
from cell.run.machine import CellState, Event
from tests.cell.plant.handshake.conftest import FakeCell, Wired, wait_until
from tools.faults.scripted_plc import HABITS, play


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
    assert (Event.CLEAR, "plc") in asked and (Event.RESET, "plc") in asked


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
    plc.wire.mend()
    plc.say(start=True)
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
    assert [request.command for request in fake.asked] == [Event.START, Event.STOP, Event.RESET]


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
