"""What `cell mqtt` refuses, and how it ends."""

from __future__ import annotations

from pathlib import Path

from typer.testing import CliRunner

from cell.cli import app
from cell.plant.mqtt.outbox import MqttOutbox, outbox_of
from tests.cell.plant.mqtt.conftest import FAKE


def refused(config: Path, runs: Path) -> str:
    done = CliRunner().invoke(app, ["mqtt", "--config", str(config), "--runs", str(runs)])
    assert done.exit_code == 2, done.exception
    return done.stderr


def test_without_a_broker_it_says_which_key_is_missing(tmp_path: Path) -> None:
    assert "plant.mqtt: is missing; name a broker" in refused(FAKE, tmp_path / "runs")


def test_a_second_adapter_of_a_cell_is_refused_and_so_is_a_line_that_is_no_topic(
    tmp_path: Path,
) -> None:
    config = tmp_path / "cell.yaml"
    config.write_text(f"{FAKE.read_text()}\nplant: {{mqtt: {{broker: 127.0.0.1}}}}\n")
    first = MqttOutbox(outbox_of(tmp_path / "runs"), 1000)
    assert "another adapter uses" in refused(config, tmp_path / "runs")
    first.close()
    config.write_text(f"{config.read_text()}ledger: {{line: a/b}}\n")
    assert "give plant.mqtt.line" in refused(config, tmp_path / "runs")
