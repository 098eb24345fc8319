"""Who is let in: certificates, passwords, and what the settings refuse."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from pydantic import ValidationError
from typer.testing import CliRunner

from cell.cli import app
from cell.plant.link import Link
from cell.plant.mqtt.adapter import password_of, tls_of
from cell.plant.mqtt.outbox import MqttOutbox, outbox_of
from cell.settings.plant import Mqtt, MqttTls
from tests.cell.plant.mqtt.conftest import FAKE, Adapter, Broker, result
from tests.waiting import wait_until


@pytest.mark.parametrize(
    ("said", "wrong"),
    [
        ({"broker": "10.0.0.1", "user": "a"}, "would send a password to 10.0.0.1 unencrypted"),
        ({"broker": "localhost", "password_file": "x"}, "has a password_file and no user"),
        ({"broker": "10.0.0.1", "tls": {"key": "k.pem"}}, "has a key and no certificate"),
        ({"broker": "10.0.0.1", "prefix": "a/#"}, "prefix"),
        ({"broker": "10.0.0.1", "password": "secret"}, "password"),
    ],
)
def test_what_would_be_unsafe_or_impossible_is_refused(said: dict[str, object], wrong: str) -> None:
    with pytest.raises(ValidationError, match=wrong):
        Mqtt.model_validate(said)


def test_a_password_comes_from_the_environment_or_a_file_that_nobody_else_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert password_of(Mqtt(broker="localhost")) is None
    monkeypatch.delenv("CELL_MQTT_PASSWORD", raising=False)
    with pytest.raises(ValueError, match="environment variable CELL_MQTT_PASSWORD"):
        password_of(Mqtt(broker="localhost", user="a"))
    monkeypatch.setenv("CELL_MQTT_PASSWORD", "p")
    assert password_of(Mqtt(broker="localhost", user="a")) == "p"
    file = tmp_path / "password"
    said = Mqtt(broker="localhost", user="a", password_file=file)
    with pytest.raises(ValueError, match="cannot be read"):
        password_of(said)
    file.write_text("secret\n")
    file.chmod(0o644)
    with pytest.raises(ValueError, match=r"others may use .* `chmod 600"):
        password_of(said)
    file.chmod(0o600)
    assert password_of(said) == "secret"


def test_files_of_certificates_that_are_none_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"plant\.mqtt\.tls\.ca: .*none\.pem"):
        tls_of(MqttTls(ca=tmp_path / "none.pem"))


def certificates(folder: Path) -> None:
    """A CA, and a certificate of it for this computer."""
    made = [
        "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2 -subj /CN=ca "
        "-keyout ca.key -out ca.pem",
        "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2 -subj /CN=line "
        "-addext subjectAltName=IP:127.0.0.1 -addext basicConstraints=critical,CA:FALSE "
        "-CA ca.pem -CAkey ca.key -keyout own.key -out own.pem",
    ]
    for command in made:
        subprocess.run(["openssl", *command.split()], cwd=folder, check=True, capture_output=True)


def test_a_broker_with_a_certificate_lets_in_a_cell_with_one(
    broker: Broker, link: Link, adapter: Callable[..., Adapter], tmp_path: Path
) -> None:
    certificates(tmp_path)
    broker.lines += [
        f"{k} {tmp_path}/{f}"
        for k, f in (("cafile", "ca.pem"), ("certfile", "own.pem"), ("keyfile", "own.key"))
    ]
    broker.lines += ["require_certificate true"]
    broker.start()
    adapter(
        tls=f"{{ca: {tmp_path}/ca.pem, certificate: {tmp_path}/own.pem, key: {tmp_path}/own.key}}"
    )
    result(link, 1)
    log = tmp_path / "broker" / "log"
    wait_until(lambda: "as cell-L1" in log.read_text())


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
