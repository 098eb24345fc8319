"""A plant around a cell: broker, adapters and clients, each a process, on loopback."""

from __future__ import annotations

import getpass
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

import yaml

from cell.computer.watched import cpu_s
from cell.plant.children import command_of
from cell.plant.link import Link
from cell.plant.messages import CommandReply, MessageKind, Request, Status
from cell.run.machine import CellState

#: All that there is; `serve` are the pages.
ADAPTERS = ("opcua", "mqtt", "handshake", "serve")
NAME = "Cell"
#: Within so long a program of the plant is there, s.
_BEGIN_S = 120.0
#: A step of the cycle that `published` makes up, s.
_STEP_S = 0.25


def free_port() -> int:
    """A port of loopback that nobody listens at now."""
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        return int(bound.getsockname()[1])


class Program:
    """A process whose lines are read as they come."""

    def __init__(self, command: Sequence[str]) -> None:
        self.command = command
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
        )
        self.lines: list[str] = []
        assert self.process.stdout is not None
        self._reading = threading.Thread(
            target=self._read, args=(self.process.stdout,), daemon=True
        )
        self._reading.start()

    def _read(self, stream: IO[str]) -> None:
        with stream:
            self.lines.extend(iter(stream.readline, ""))

    def until(self, text: str) -> None:
        """Wait until it has said this.  Raises RuntimeError: it has ended, or did not in time."""
        wait_until(lambda: any(text in line for line in self.lines), self)

    def end(self) -> None:
        """Kill it."""
        self.process.kill()
        self.process.wait()
        self._reading.join()


def wait_until(reached: Callable[[], bool], program: Program | None = None) -> None:
    """Wait for a condition.  Raises RuntimeError: a program has ended, or it takes too long."""
    until_s = time.monotonic() + _BEGIN_S
    while not reached():
        ended = program is not None and program.process.poll() is not None
        if ended or time.monotonic() > until_s:
            raise RuntimeError(
                "the plant does not begin"
                if program is None
                else f"{' '.join(program.command)}: {''.join(program.lines)}"
            )
        time.sleep(0.02)


class Plant:
    """Broker, adapters and clients within a `with`, beside a cell that may come later.

    base      settings of the cell; a section `plant` is added to a copy in `folder`
    adapters  which run
    clients   of OPC UA, each subscribed to all that changes, every `interval_ms`
    viewers   of the live page, one of which reads nothing of it
    """

    def __init__(
        self,
        folder: Path,
        base: Path,
        runs: Path,
        *,
        adapters: Sequence[str] = ADAPTERS,
        clients: int = 0,
        interval_ms: float = 100.0,
        viewers: int = 0,
    ) -> None:
        self._folder, self._runs = folder, runs
        self._names, self._clients, self._interval_ms = adapters, clients, interval_ms
        self._viewers = viewers
        self.ports = {name: free_port() for name in ADAPTERS}
        self.config = folder / "plant.yaml"
        folder.mkdir(parents=True, exist_ok=True)
        content = yaml.safe_load(base.read_text(encoding="utf-8"))
        content["plant"] = {
            "opcua": {"port": self.ports["opcua"], "folder": str(folder / "opcua"), "name": NAME},
            "mqtt": {"broker": "127.0.0.1", "port": self.ports["mqtt"], "retry_s": 0.5},
            "handshake": {"port": self.ports["handshake"]},
        }
        self.config.write_text(yaml.safe_dump(content), encoding="utf-8")
        self.running: dict[str, Program] = {}
        self._opened = ExitStack()

    def __enter__(self) -> Plant:
        with ExitStack() as stack:
            stack.callback(lambda: [p.end() for p in reversed(self.running.values())])
            if "mqtt" in self._names:
                self.running["broker"] = self._broker()
            for name in self._names:
                self.start(name)
            for name in self._names:
                self.wait_for(name)
            if self._clients:
                at = [str(self.ports["opcua"]), "--name", NAME, "--clients", str(self._clients)]
                at += ["--interval-ms", str(self._interval_ms)]
                clients = Program([sys.executable, "-m", "tools.plant.opcua_clients", *at])
                self.running["clients"] = clients
                clients.until("subscribed")
            if self._viewers:
                at = [str(self.ports["serve"]), "--viewers", str(self._viewers)]
                viewers = Program([sys.executable, "-m", "tools.plant.viewer", *at])
                self.running["viewers"] = viewers
                viewers.until("they look")
            self._opened = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def start(self, adapter: str) -> None:
        """Begin an adapter, as the service does."""
        command = command_of(adapter, self.config, self._runs)
        if adapter == "serve":
            command += ["--port", str(self.ports[adapter])]
        self.running[adapter] = Program(command)

    def wait_for(self, adapter: str) -> None:
        """Until an adapter does its work."""
        program = self.running[adapter]
        if adapter == "mqtt":
            program.until("broker: connected")
        else:
            wait_until(lambda: listens(self.ports[adapter]), program)

    def cpu_s(self) -> Mapping[str, float]:
        """CPU time that each program has taken so far, s."""
        return {name: cpu_s(program.process.pid) for name, program in self.running.items()}

    def _broker(self) -> Program:
        path = "/usr/sbin:/usr/local/sbin:/usr/bin:/usr/local/bin"
        program = shutil.which("mosquitto", path=path)
        if program is None:
            raise RuntimeError("mosquitto is not installed")
        said = self._folder / "mosquitto.conf"
        lines = [f"listener {self.ports['mqtt']} 127.0.0.1", f"user {getpass.getuser()}"]
        said.write_text("\n".join([*lines, "allow_anonymous true"]) + "\n", encoding="utf-8")
        broker = Program(["nice", "-n", "19", program, "-c", str(said)])
        wait_until(lambda: listens(self.ports["mqtt"]), broker)
        return broker


def listens(port: int) -> bool:
    """Whether somebody listens at a port of loopback."""
    with socket.socket() as tried:
        return tried.connect_ex(("127.0.0.1", port)) == 0


@contextmanager
def published(runs: Path) -> Iterator[None]:
    """The link of a cell that is not there: its notices come as those of cycles would."""
    refused = CommandReply(False, CellState.EXECUTE, "this cell only publishes")

    def refuse(request: Request) -> CommandReply:
        return refused

    over = threading.Event()
    begun = Status(run="", sequence=0, state=CellState.EXECUTE, since_s=time.time())
    with Link(runs, begun, refuse) as link:

        def publish() -> None:
            number = 0
            while not over.wait(_STEP_S):
                number += 1
                link.publish(
                    MessageKind.STEP, {"step": f"step {number % 20}", "cycle": number // 20}
                )
                if number % 20 == 0:
                    result = {"cycle": number // 20, "outcome": "inserted", "margin_m": 1e-3}
                    link.publish(MessageKind.RESULT, result)

        thread = threading.Thread(target=publish, name="published", daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()
