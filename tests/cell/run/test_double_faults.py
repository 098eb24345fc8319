"""Cycles in which two things go wrong at once: none hides the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from cell.records.folder import RecordError
from cell.run.cycle import Cell
from cell.run.findings import Findings
from cell.run.machine import MachineEvent
from cell.run.plans import CONNECT, INSERTING, RESET, Plan, Step
from cell.run.progress import CycleProgress
from cell.run.station import Station
from cell.settings import load_settings
from cell.wiring.build import cell_with, twin_devices
from cell.wiring.twins import build_twins
from drivers.interfaces import DeviceLostError

FAKE = Path(__file__).parents[3] / "config" / "fake.yaml"
LOST = DeviceLostError("camera", "says nothing", "look at its cable")


@pytest.fixture
def begun() -> list[str]:
    return []


@pytest.fixture
def cell(tmp_path: Path, begun: list[str]) -> Cell:
    settings = load_settings(FAKE)
    devices = twin_devices(build_twins(settings, 1, 1))
    return cell_with(settings, devices, tmp_path, lambda number, step: begun.append(step))


def plan_with(act: Callable[[], None]) -> Plan:
    """A plan that connects, and in which this is then done."""

    def acts(station: Station, findings: Findings) -> Findings:
        act()
        return findings

    return replace(
        INSERTING,
        resetting=(CONNECT, RESET),
        starting=(Step("act", acts),),
        execute=(),
        completing=(),
    )


def test_a_device_that_is_lost_as_somebody_stops_is_connected_anew(
    cell: Cell, begun: list[str]
) -> None:
    """Who opens the guard also switches the camera off."""

    def stopped_and_lost() -> None:
        cell.command(MachineEvent.STOP, "guard opened")
        raise LOST

    result = cell.run_cycle(1, plan_with(stopped_and_lost))
    assert result.fault is not None and result.fault.cause == "guard opened"
    cell.acknowledge("Ada", "guard closed")
    begun.clear()
    cell.run_cycle(2, plan_with(stopped_and_lost))
    assert begun[0] == CONNECT.name
    cell.close()


def test_a_full_disk_does_not_hide_the_device_that_failed(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost() -> None:
        def full(progress: CycleProgress) -> None:
            raise RecordError("the record cannot be written: No space left on device")

        monkeypatch.setattr(CycleProgress, "write", full)
        raise LOST

    result = cell.run_cycle(1, plan_with(lost))
    assert result.fault is not None
    assert (result.fault.device, result.fault.cause) == ("camera", "says nothing")
    cell.close()
