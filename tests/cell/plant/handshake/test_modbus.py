"""The handshake over Modbus: a scripted PLC that misbehaves, and losses at either end."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from pydantic import ValidationError

from cell.plant.handshake.adapter import HandshakeAdapter
from cell.plant.handshake.carrier import CarrierError
from cell.plant.handshake.modbus import ModbusCarrier
from cell.plant.handshake.signals import UNKNOWN, Inputs, Outputs
from cell.run.machine import CellState, Event
from cell.settings.plant.handshake import Handshake
from tests.cell.plant.handshake.conftest import FakeCell, free_port, wait_until
from tests.cell.plant.handshake.scripted_plc import Plc, main

FAKE = Path(__file__).parents[4] / "config" / "fake.yaml"


def test_a_plc_that_misbehaves_gets_one_cycle_for_each_start(
    fake: FakeCell,
    adapter: HandshakeAdapter,
    said: Handshake,
    capsys: pytest.CaptureFixture[str],
) -> None:
    main(said.port, 12)
    told = capsys.readouterr().out.splitlines()
    assert len(told) == fake.starts == fake.ended == 12
    outcomes = [line.split()[-1] for line in told]
    wanted = ["done", "done", "rejected", "done", "done", "rejected", "fault"]
    assert outcomes == [*wanted, "done", "rejected", "done", "done", "rejected"]
    assert CellState.SUSPENDED in fake.states
    asked = [(request.command, request.by) for request in fake.asked]
    assert (Event.CLEAR, "plc") in asked and (Event.RESET, "plc") in asked


def test_bits_have_their_numbers_and_may_be_inverted() -> None:
    places = {"stop": {"number": 40, "inverted": True}, "part_present": None}
    said = Handshake.model_validate(
        {
            "port": free_port(),
            "inputs": places,
            "outputs": {"fault": {"number": 20, "inverted": True}},
        }
    )
    with ModbusCarrier(said) as carrier:
        plc = Plc(said.port)
        with pytest.raises(CarrierError, match="writes nothing for 1 s"):
            carrier.read()
        plc.say(start=True)
        with pytest.raises(CarrierError, match="has not written coil 40 yet"):
            carrier.read()
        plc._client.write_coil(40, True, device_id=1)
        assert carrier.read() == Inputs(start=True, upstream_ready=False, downstream_ready=False)
        plc._client.write_coil(40, False, device_id=1)
        assert carrier.read().stop
        carrier.write(Outputs(ready=True, done=True))
        bits = plc._client.read_discrete_inputs(0, count=21, device_id=1).bits
        assert [number for number in range(21) if bits[number]] == [0, 2, 20]
        carrier.write(UNKNOWN)
        bits = plc._client.read_discrete_inputs(0, count=21, device_id=1).bits
        assert not any(bits[:21])
        assert plc._client.write_coil(500, True, device_id=1).isError()
        plc.close()


def test_a_port_that_is_taken_is_said() -> None:
    said = Handshake(port=free_port())
    with ModbusCarrier(said), pytest.raises(CarrierError, match=f"listen at 127.0.0.1:{said.port}"):
        ModbusCarrier(said).__enter__()


def test_a_plc_that_is_lost_starts_nothing_when_it_comes_back(
    fake: FakeCell, adapter: HandshakeAdapter, said: Handshake, caplog: pytest.LogCaptureFixture
) -> None:
    plc = Plc(said.port)
    plc.connect()
    caplog.clear()
    wait_until(lambda: bool(plc.read()) and "writes nothing for 1.5 s" in caplog.text)
    assert plc.read()["fault"]
    plc.close()
    plc = Plc(said.port)
    plc.say(start=True, part_present=True, upstream_ready=True, downstream_ready=True)
    plc.wait(lambda heard: not heard["fault"])
    plc.quiet()
    assert fake.starts == 0
    plc.say(start=False)
    assert plc.cycle() == "done"
    assert "the PLC is there again" in caplog.text
    plc.close()


def test_a_stop_stops_and_needs_an_acknowledgement(
    fake: FakeCell, adapter: HandshakeAdapter, said: Handshake
) -> None:
    plc = Plc(said.port)
    plc.connect()
    plc.say(start=True)
    plc.wait(lambda heard: heard["busy"])
    plc.say(start=False, stop=True)
    plc.wait(lambda heard: heard["fault"])
    plc.say(stop=False, start=True)
    plc.quiet()
    plc.say(start=False, acknowledge=True)
    plc.wait(lambda heard: heard["ready"])
    assert [request.command for request in fake.asked] == [Event.START, Event.STOP, Event.RESET]
    plc.close()


def test_a_cell_that_is_away_is_a_fault_and_is_not_started_when_it_comes(
    runs: Path, adapter: HandshakeAdapter, said: Handshake
) -> None:
    plc = Plc(said.port)
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
    plc.close()


def test_the_command_serves_until_it_is_ended(runs: Path, fake: FakeCell, tmp_path: Path) -> None:
    settings = yaml.safe_load(FAKE.read_text())
    port = free_port()
    settings["plant"] = {"handshake": {"port": port}}
    config = tmp_path / "line.yaml"
    config.write_text(yaml.safe_dump(settings))
    command = [sys.executable, "-m", "cell", "handshake", "--config", str(config)]
    process = subprocess.Popen([*command, "--runs", str(runs)])
    try:
        wait_until(lambda: _answers(port))
        plc = Plc(port)
        plc.connect()
        plc.close()
    finally:
        process.send_signal(signal.SIGTERM)
    assert process.wait(20.0) == 0


def _answers(port: int) -> bool:
    try:
        Plc(port).close()
    except AssertionError:
        return False
    return True


@pytest.mark.parametrize(
    ("inputs", "wrong"),
    [
        ({"stop": {"number": 0}}, "has stop and start at number 0"),
        ({"stop": {"number": -1}}, "number"),
        ({"stop": 3}, "stop"),
    ],
)
def test_settings_that_cannot_be_meant_are_refused(inputs: dict[str, object], wrong: str) -> None:
    with pytest.raises(ValidationError, match=wrong):
        Handshake.model_validate({"inputs": inputs})
