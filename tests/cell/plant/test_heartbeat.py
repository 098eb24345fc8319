"""A cell that is halted says nothing: who follows it is told once, and when it is there again."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from cell.plant.client import Client
from cell.plant.messages import PROTOCOL, Notice, Status
from cell.plant.mqtt.adapter import OutboxFeeder
from cell.plant.mqtt.outbox import MqttOutbox
from cell.plant.wire import LinkError, line_of, socket_of
from cell.settings.plant import OpcUa
from cell.web.watching import CellWatch
from tests.cell.plant.opcua.conftest import NAME, FakeCell, Seen, Site, served, settings_with
from tests.waiting import free_port, wait_until

#: A cell in a process of its own; a line on its standard input is a notice.
CELL = """
import sys
from pathlib import Path
from cell.plant import server
from cell.plant.link import Link
from cell.plant.messages import MessageKind, Status
from cell.run.machine import CellState
server.HEARTBEAT_S = 0.1
with Link(Path(sys.argv[1]), Status('', 0, CellState.IDLE, 0.0), None) as link:
    print(flush=True)
    for line in sys.stdin:
        link.publish(MessageKind.PRODUCT, {'product': line.strip()})
"""


def halted(stat: Path) -> bool:
    """Whether a thread is halted, by the third field of its line in /proc (proc(5))."""
    return stat.read_text().rpartition(")")[2].split()[0] == "T"


class Cell:
    """The process."""

    def __init__(self, runs: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", CELL, str(runs)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        assert self.process.stdout is not None
        self.process.stdout.readline()

    def publish(self, product: str) -> None:
        assert self.process.stdin is not None
        print(product, file=self.process.stdin)

    def halt(self) -> None:
        """Returns when every thread stands: the signal reaches one of them, which tells the others.

        Until a core is free for that one, the others go on.
        """
        self.process.send_signal(signal.SIGSTOP)
        threads = Path(f"/proc/{self.process.pid}/task")
        wait_until(lambda: all(halted(t / "stat") for t in threads.iterdir()))

    def go_on(self) -> None:
        self.process.send_signal(signal.SIGCONT)


class Follower:
    """Follows in a thread; `heard` is what it was told, in its order."""

    def __init__(self, runs: Path) -> None:
        self.heard: list[str] = []
        self.client = Client(
            runs,
            timeout_s=0.2,
            on_lost=lambda: self.heard.append("lost"),
            on_there=lambda: self.heard.append("there"),
        )
        self._thread = threading.Thread(target=self._follow)
        self._thread.start()

    def _follow(self) -> None:
        for message in self.client.follow():
            self.heard.append(told(message))

    def close(self) -> None:
        self.client.close()
        self._thread.join()


def told(message: Notice | Status) -> str:
    return "status" if isinstance(message, Status) else str(message.data["product"])


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Cell]:
    begun = Cell(tmp_path / "runs")
    yield begun
    begun.process.kill()
    begun.process.communicate()


@pytest.fixture
def follower(cell: Cell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Follower]:
    monkeypatch.setattr("cell.plant.client.SILENCE_S", 1.0)
    follower = Follower(tmp_path / "runs")
    wait_until(lambda: follower.heard == ["status"])
    yield follower
    follower.close()


def test_a_halted_cell_is_lost_once_and_is_there_again_without_any_news(
    cell: Cell, follower: Follower
) -> None:
    cell.halt()
    wait_until(lambda: follower.heard == ["status", "lost"])
    time.sleep(0.7)  # it is looked for again meanwhile, and does not answer
    cell.go_on()
    wait_until(lambda: follower.heard == ["status", "lost", "there"])
    cell.publish("long")
    wait_until(lambda: follower.heard == ["status", "lost", "there", "long"])


def test_who_asks_a_halted_cell_is_told_why_there_is_no_answer(cell: Cell, tmp_path: Path) -> None:
    cell.halt()
    with pytest.raises(LinkError, match=r"says nothing for 0\.2 s: it is halted, or this computer"):
        Client(tmp_path / "runs", timeout_s=0.2).status()


def test_what_happened_meanwhile_is_told_first(cell: Cell, follower: Follower) -> None:
    cell.publish("long")
    wait_until(lambda: follower.heard[-1] == "long")
    cell.halt()
    cell.publish("short")
    wait_until(lambda: follower.heard[-1] == "lost")
    cell.go_on()
    wait_until(lambda: follower.heard[-1] == "short")
    assert [h for h in follower.heard if h != "there"] == ["status", "long", "lost", "short"]


def test_who_comes_back_to_a_quiet_cell_is_told_that_it_is_there(
    cell: Cell, tmp_path: Path
) -> None:
    there = threading.Event()
    client = Client(tmp_path / "runs", on_there=there.set)
    run = client.status().run
    thread = threading.Thread(target=lambda: list(client.follow((run, 0))))
    thread.start()
    assert there.wait(20.0)
    client.close()
    thread.join()


def test_signs_of_life_come_while_nothing_happens(cell: Cell, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as raw:
        raw.settimeout(20.0)
        raw.connect(str(socket_of(tmp_path / "runs")))
        raw.sendall(line_of("greeting", {"protocol": PROTOCOL}) + line_of("follow", None))
        heard = b""
        while heard.count(b'{"alive":null}\n') < 3:
            heard += raw.recv(65536)
    assert heard.count(b"\n") - heard.count(b'{"alive":null}\n') == 2  # greeting and status


def test_a_halted_cell_is_shown_as_lost_by_all_who_show_it(
    cell: Cell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cell.plant.client.SILENCE_S", 1.0)
    runs, port = tmp_path / "runs", free_port()
    settings = settings_with(OpcUa(port=port, folder=tmp_path / "opcua", name=NAME))
    client = Client(runs, on_lost=lambda: watch.lost(), on_there=lambda: watch.reconnected())
    watch = CellWatch(client, settings.model_copy(update={"ledger": None}), runs)
    outbox = MqttOutbox(tmp_path / "outbox", 1000)

    async def shown(seen: Seen) -> None:
        cell.publish("long")  # after it nothing is told any more
        await seen.until("Cell.Connected", True)
        wait_until(lambda: watch.state.connected and taker.is_cell and outbox.count() == 1)
        cell.halt()
        await seen.until("Cell.Connected", False)
        wait_until(lambda: not watch.state.connected and not taker.is_cell)
        cell.go_on()
        await seen.until("Cell.Connected", True)
        assert await seen.read("Cell.State") == "idle"
        wait_until(lambda: watch.state.connected and taker.is_cell)

    with served(settings, runs) as loop, watch, OutboxFeeder(runs, outbox, lambda: None) as taker:
        Site(FakeCell(tmp_path / "none"), port, tmp_path / "opcua", runs, loop).look(shown)
    client.close()
    outbox.close()
