"""`cell handshake` as a process, over every real carrier, and settings that it refuses."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from cell.files.input_error import InputError
from cell.settings import load_settings
from cell.settings.plant import Handshake, Plant, signals_of
from tests.cell.plant.handshake.conftest import FakeCell, Wired, wired_by
from tests.waiting import wait_until
from tools.faults.scripted_plc import SILENCE_S

CONFIG = Path(__file__).parents[4] / "config"


@pytest.fixture(params=["modbus", "controller"])
def wired(request: pytest.FixtureRequest) -> Iterator[Wired]:
    yield (made := wired_by(request.param, SILENCE_S, request))
    made.close()


def with_handshake(path: Path, shipped: str, **handshake: object) -> Path:
    settings = yaml.safe_load((CONFIG / shipped).read_text(encoding="utf-8"))
    settings["plant"] = {"handshake": handshake}
    path.write_text(yaml.safe_dump(settings), encoding="utf-8")
    return path


def test_the_command_serves_until_it_is_ended(
    runs: Path, fake: FakeCell, tmp_path: Path, wired: Wired
) -> None:
    said = wired.said.model_dump(exclude_defaults=True)
    config = with_handshake(tmp_path / "line.yaml", "fake.yaml", **said)
    command = [sys.executable, "-m", "cell", "handshake", "--config", str(config)]
    process = subprocess.Popen([*command, "--runs", str(runs)])
    try:
        wait_until(lambda: _listens(wired))
        plc = wired.plc()
        plc.connect()
        assert plc.cycle() == "done"
    finally:
        process.send_signal(signal.SIGTERM)
    assert process.wait(20.0) == 0
    if wired.tells_at_end:
        assert plc.read()["fault"] and not plc.read()["ready"]


def _listens(wired: Wired) -> bool:
    try:
        wired.plc()
    except AssertionError:
        return False
    return True


@pytest.mark.parametrize(
    ("handshake", "wrong"),
    [
        ({"inputs": {"stop": {"number": 0}}}, "has stop and start at number 0"),
        ({"inputs": {"stop": {"number": -1}}}, "plant.handshake.inputs.stop.number"),
        ({"inputs": {"stop": 3}}, "plant.handshake.inputs.stop"),
        ({"carrier": "controller", "port": 1502}, "has port, which only the carrier modbus has"),
        ({"host": "127.0.0.2"}, "has host, which only the carrier controller has"),
        (
            {"carrier": "controller", "outputs": {"fault": {"number": 18}}},
            "has fault at number 18; a controller has 0 to 7 standard, 8 to 15",
        ),
        ({"carrier": "profinet"}, "carrier"),
        ({"carrier": "controller"}, "plant.handshake.host: is missing: arm.kind is 'sim'"),
    ],
)
def test_settings_that_cannot_be_meant_are_refused(
    tmp_path: Path, handshake: dict[str, object], wrong: str
) -> None:
    with pytest.raises(InputError) as raised:
        load_settings(with_handshake(tmp_path / "line.yaml", "fake.yaml", **handshake))
    assert wrong in str(raised.value)


def test_the_arms_controller_has_the_signals_unless_another_is_named(tmp_path: Path) -> None:
    from cell.settings.check import controller_of

    for named, host in (({}, "192.168.3.10"), ({"host": "plc-io"}, "plc-io")):
        config = with_handshake(tmp_path / "line.yaml", "line3.yaml", carrier="controller", **named)
        assert controller_of(load_settings(config)) == host


PAGE = (Path(__file__).parents[4] / "docs" / "howto" / "plc.md").read_text(encoding="utf-8")


def test_the_settings_that_are_shown_are_accepted() -> None:
    blocks = re.findall(r"(?m)^    plant:\n(?:     .*\n)+", PAGE)
    plain = [yaml.safe_load(textwrap.dedent(b))["plant"] for b in blocks]
    shown = [Plant.model_validate(section) for section in plain if "handshake" in section]
    carriers = [plant.handshake.carrier for plant in shown if plant.handshake is not None]
    assert carriers == ["modbus", "controller"]


def test_the_tables_have_the_numbers_of_the_settings() -> None:
    rows = re.findall(r"(?m)^\| (\d+) \| `(\w+)` \|", PAGE)
    said = Handshake()
    wanted = [(str(at.number), name) for name, at in signals_of(said.inputs)]
    assert rows == wanted + [(str(at.number), name) for name, at in signals_of(said.outputs)]
