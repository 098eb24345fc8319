"""A plant around a cell: broker, adapters and clients, each a process, on loopback."""

from __future__ import annotations

import getpass
import shutil
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from cell.computer.watched import cpu_s
from cell.plant.children import command_of
from cell.plant.link import Link
from cell.plant.messages import CommandReply, MessageKind, Status
from cell.run.machine import CellState
from tools.processes import Program, free_port, going_on, listens, wait_until
from tools.shipped_settings import with_entries

#: All adapters; `serve` are the pages.
ADAPTERS = ("opcua", "mqtt", "handshake", "serve")
#: Name of the unit, `plant.opcua.name`.
UNIT = "Cell"
#: Duration of a step of the invented cycles of `published`, s.
_STEP_S = 0.25


class Plant:
    """Broker, adapters and clients within a `with`, for a cell that may start later.

    base      settings of the cell; a section `plant` is added to a copy in `folder`
    adapters  names of those that run
    clients   of OPC UA, each subscribed to all variables, every 100 ms
    viewers   of the live page, one of which reads nothing
    """

    def __init__(
        self,
        folder: Path,
        base: Path,
        runs: Path,
        *,
        adapters: Sequence[str] = ADAPTERS,
        clients: int = 0,
        viewers: int = 0,
    ) -> None:
        self._folder, self._runs = folder, runs
        self._names, self._clients, self._viewers = adapters, clients, viewers
        self.ports = {name: free_port() for name in ADAPTERS}
        self.config = folder / "plant.yaml"
        folder.mkdir(parents=True, exist_ok=True)
        section = {
            "opcua": {"port": self.ports["opcua"], "folder": str(folder / "opcua"), "name": UNIT},
            "mqtt": {"broker": "127.0.0.1", "port": self.ports["mqtt"], "retry_s": 0.5},
            "handshake": {"port": self.ports["handshake"]},
        }
        self.config.write_text(with_entries(base, {"plant": section}), encoding="utf-8")
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
            for name, count, module, adapter, begun in (
                ("clients", self._clients, "opcua_clients", "opcua", "subscribed"),
                ("viewers", self._viewers, "viewer", "serve", "they look"),
            ):
                if count:
                    at = [str(self.ports[adapter]), f"--{name}", str(count)]
                    self.running[name] = Program(
                        [sys.executable, "-m", f"tools.plant.{module}", *at]
                    )
                    self.running[name].until(begun)
            self._opened = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def start(self, adapter: str) -> None:
        """Start an adapter, as the service does."""
        command = command_of(adapter, self.config, self._runs)
        if adapter == "serve":
            command += ["--port", str(self.ports[adapter])]
        self.running[adapter] = Program(command)

    def wait_for(self, adapter: str) -> None:
        """Wait until an adapter works."""
        program = self.running[adapter]
        if adapter == "mqtt":
            program.until("broker: connected")
        else:
            wait_until(lambda: listens(self.ports[adapter]), program)

    def cpu_s(self) -> Mapping[str, float]:
        """CPU time of each program so far, s."""
        return {name: cpu_s(program.process.pid) for name, program in self.running.items()}

    def _broker(self) -> Program:
        path = "/usr/sbin:/usr/local/sbin:/usr/bin:/usr/local/bin"
        program = shutil.which("mosquitto", path=path)
        if program is None:
            raise RuntimeError("mosquitto is not installed")
        config_file = self._folder / "mosquitto.conf"
        lines = [f"listener {self.ports['mqtt']} 127.0.0.1", f"user {getpass.getuser()}"]
        config_file.write_text("\n".join([*lines, "allow_anonymous true"]) + "\n", encoding="utf-8")
        broker = Program(["nice", "-n", "19", program, "-c", str(config_file)])
        wait_until(lambda: listens(self.ports["mqtt"]), broker)
        return broker


@contextmanager
def published(runs: Path) -> Iterator[None]:
    """Open the link of an invented cell, and publish notices of its cycles."""
    refused = CommandReply(False, CellState.EXECUTE, "this cell only publishes")
    begun = Status(run="", sequence=0, state=CellState.EXECUTE, since_s=time.time())
    with Link(runs, begun, lambda _: refused) as link:

        def publish(over: threading.Event) -> None:
            number = 0
            while not over.wait(_STEP_S):
                number += 1
                cycle = number // 20
                link.publish(MessageKind.STEP, {"step": f"step {number % 20}", "cycle": cycle})
                if number % 20 == 0:
                    result = {"cycle": cycle, "outcome": "inserted", "margin_m": 1e-3}
                    link.publish(MessageKind.RESULT, result)

        with going_on(publish):
            yield
