"""A real broker, a cell that only publishes, the adapter as a process, and a receiver."""

from __future__ import annotations

import getpass
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import paho.mqtt.client as paho
import pytest
from paho.mqtt.enums import CallbackAPIVersion

from cell.plant.link import Link
from cell.plant.messages import CommandReply, MessageKind, Status
from cell.run.machine import CellState
from tests.waiting import free_port, wait_until

BEGUN = Status(run="", sequence=0, state=CellState.IDLE, since_s=0.0, line="L1")
FAKE = Path(__file__).parents[4] / "config" / "fake.yaml"


class Broker:
    """Debian's mosquitto at a loopback port; it writes its sessions down after every change."""

    def __init__(self, program: str, folder: Path) -> None:
        self.port = free_port()
        self._program, self._folder = program, folder
        self._process: subprocess.Popen[bytes] | None = None
        self.lines: list[str] = ["allow_anonymous true"]

    def start(self) -> None:
        self._folder.mkdir(exist_ok=True)
        said = [
            f"listener {self.port} 127.0.0.1",
            f"user {getpass.getuser()}",
            "persistence true",
            f"persistence_location {self._folder}/",
            "autosave_on_changes true",
            "autosave_interval 1",
            "max_queued_messages 0",
            *self.lines,
        ]
        file = self._folder / "mosquitto.conf"
        file.write_text("\n".join(said) + "\n")
        with (self._folder / "log").open("ab") as log:
            self._process = subprocess.Popen(
                [self._program, "-c", str(file)], stdout=log, stderr=log
            )
        wait_until(self._answers)

    def _answers(self) -> bool:
        assert self._process is not None
        assert self._process.poll() is None, self.log()
        with socket.socket() as tried:
            return tried.connect_ex(("127.0.0.1", self.port)) == 0

    def log(self) -> str:
        return (self._folder / "log").read_text()

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    program = shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin:/usr/bin:/usr/local/bin")
    if program is None:
        pytest.skip("mosquitto is not installed")
    made = Broker(program, tmp_path / "broker")
    yield made
    made.kill()


@pytest.fixture
def link(tmp_path: Path) -> Iterator[Link]:
    refused = CommandReply(False, CellState.IDLE, "this cell only publishes")
    with Link(tmp_path / "runs", BEGUN, lambda _: refused) as opened:
        yield opened


class Receiver:
    """A program of the plant with a session that the broker keeps; it goes on trying."""

    def __init__(self, broker: Broker, topics: str) -> None:
        self._broker = broker
        self.heard: list[paho.MQTTMessage] = []
        self.subscribed = 0
        self._client = paho.Client(
            CallbackAPIVersion.VERSION2, client_id="receiver", clean_session=False
        )
        self._client.reconnect_delay_set(1, 1)
        self._client.on_message = lambda _, __, message: self.heard.append(message)
        self._client.on_connect = lambda *_: self._client.subscribe(topics, qos=1)
        self._client.on_subscribe = lambda *_: self._count()
        self._client.connect("127.0.0.1", broker.port)
        self._client.loop_start()
        wait_until(lambda: self.subscribed > 0)

    def _count(self) -> None:
        self.subscribed += 1

    def say(self, topic: str, payload: bytes) -> None:
        self._client.publish(topic, payload, qos=1)

    def of(self, part: str) -> list[paho.MQTTMessage]:
        return [message for message in list(self.heard) if part in message.topic]

    def wait_for(self, part: str, count: int) -> None:
        """Until so many have come; each may take long, as each is written to a slow disk thrice."""
        for number in range(len(self.of(part)) + 1, count + 1):
            wait_until(
                lambda number=number: len(self.of(part)) >= number,
                why=lambda: f"{len(self.of(part))} of {count} came; {self._broker.log()}",
            )

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


@pytest.fixture
def receiver(broker: Broker) -> Iterator[Callable[[str], Receiver]]:
    made: list[Receiver] = []

    def begin(topics: str) -> Receiver:
        made.append(Receiver(broker, topics))
        return made[-1]

    yield begin
    for each in made:
        each.close()


class Adapter:
    """`cell mqtt` as a process."""

    def __init__(self, config: Path, runs: Path) -> None:
        self._command = [sys.executable, "-m", "cell", "mqtt", "--config", str(config)]
        self._command += ["--runs", str(runs)]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        self._process = subprocess.Popen(self._command)

    def end(self, number: int) -> int:
        if self._process is None:
            return 0
        self._process.send_signal(number)
        return self._process.wait(20.0)


@pytest.fixture
def adapter(broker: Broker, tmp_path: Path) -> Iterator[Callable[..., Adapter]]:
    made: list[Adapter] = []

    def begin(**said: Any) -> Adapter:
        entries = {"broker": "127.0.0.1", "port": broker.port, "line": "L1", "retry_s": 0.2} | said
        lines = "".join(f"    {key}: {value}\n" for key, value in entries.items())
        config = tmp_path / "cell.yaml"
        config.write_text(f"{FAKE.read_text()}\nplant:\n  mqtt:\n{lines}")
        made.append(Adapter(config, tmp_path / "runs"))
        made[-1].start()
        return made[-1]

    yield begin
    for each in made:
        each.end(signal.SIGKILL)


def result(link: Link, cycle: int) -> None:
    """A cycle of the cell, as far as it is published."""
    from cell.records.result import Outcome, Result

    link.publish(MessageKind.CYCLE, {"cycle": cycle, "part": None, "product": None})
    link.publish(MessageKind.STEP, {"step": "grasp", "cycle": cycle})
    ended = Result(cycle, Outcome.INSERTED, f"runs/{cycle}", margin_m=0.001)
    link.publish(MessageKind.RESULT, ended.to_json())
