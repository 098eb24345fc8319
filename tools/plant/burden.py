"""What a plant that misbehaves costs a cycle: nothing, or it is said here.

    python -m tools.plant.burden [--cycles 10] [--items 10000] [--stalled 50]

The simulated cell makes the same cycles at the speed of reality three times: alone, beside the OPC
UA server with so many monitored items, and with clients that do not read: those of OPC UA halted
with all their items, and so many of the link.  Printed are the times of the steps that compute, the
wait, each as a ratio of the same cycle alone, and how soon the status is answered.
"""

from __future__ import annotations

import argparse
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

from cell.plant.client import Client
from cell.plant.messages import PROTOCOL
from cell.plant.wire import line_of, socket_of
from cell.run.plans import INSERTING
from tools.plant.adapter_kills import CONFIG, Made, made, service
from tools.plant.around import NAME, Plant, Program

#: Steps that compute: the others take the time of their motions.
COMPUTING = tuple(step.name for step in INSERTING.steps if step.computes and not step.once)
#: The status is asked for so often, s.
_ASK_S = 0.1


@dataclass
class Measured:
    """Cycles, and how long answers to `status` took, s."""

    cycles: list[Made] = field(default_factory=list)
    answers_s: list[float] = field(default_factory=list)

    def of(self, what: str) -> np.ndarray:
        """The wait, or a step's time, of each cycle, s."""
        results = [c.result for c in self.cycles]
        if what == "wait":
            return np.array([r["wait_s"] or np.nan for r in results])
        return np.array([r["seconds"].get(what, np.nan) for r in results])


@contextmanager
def asked(runs: Path, answers_s: list[float]) -> Iterator[None]:
    """Somebody asks for the status all the time."""
    over = threading.Event()
    client = Client(runs, timeout_s=60.0)

    def ask() -> None:
        while not over.wait(_ASK_S):
            begun_s = time.perf_counter()
            client.status()
            answers_s.append(time.perf_counter() - begun_s)

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def stalled(runs: Path) -> socket.socket:
    """A program that follows the cell and never reads."""
    raw = socket.socket(socket.AF_UNIX)
    raw.connect(str(socket_of(runs)))
    raw.sendall(line_of("greeting", {"protocol": PROTOCOL}) + line_of("follow", None))
    return raw


def measure(folder: Path, config: Path, cycles: int, items: int, halted: int | None) -> Measured:
    """Cycles of a service.

    items   monitored at the OPC UA server; 0 = there is none
    halted  stalled clients of the link, beside that of OPC UA; None = nobody is halted
    """
    runs, found = folder / "runs", Measured()
    with ExitStack() as stack:
        stack.enter_context(service(config, runs, folder / "log"))
        client = Client(runs, timeout_s=60.0).connect(300.0)
        messages = client.follow()
        made(client, messages, lambda step: None)  # the first one compiles
        if items:
            plant = Plant(folder / "plant", config, runs, adapters=("opcua",))
            stack.enter_context(plant)
            at = [str(plant.ports["opcua"]), "--name", NAME, "--clients", "5", "--items"]
            command = [sys.executable, "-m", "tools.plant.opcua_clients", *at, str(items)]
            clients = Program(command)
            stack.callback(clients.end)
            clients.until("subscribed")
            if halted is not None:
                clients.process.send_signal(signal.SIGSTOP)
                for _ in range(halted):
                    stack.enter_context(stalled(runs))
        with asked(runs, found.answers_s):
            found.cycles += [made(client, messages, lambda step: None) for _ in range(cycles)]
        client.close()
    return found


def told(name: str, alone: Measured, found: Measured) -> None:
    """Ratios of the same cycles."""
    ms = 1e3 * np.quantile(found.answers_s, [0.5, 0.99])
    print(f"{name}: status within {ms[0]:.1f} ms, 99 % within {ms[1]:.1f} ms", flush=True)
    for what in ("wait", *COMPUTING):
        before, after = alone.of(what), found.of(what)
        middle = 1e3 * np.nanmedian(after)
        print(f"  {what:18s} {middle:7.1f} ms, {np.nanmedian(after / before):.2f} × alone")
    differ = [d for d in map(Made.differs, found.cycles, alone.cycles) if d]
    print(f"  {len(found.cycles) - len(differ)} of {len(found.cycles)} cycles ended as alone")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--cycles", type=int, default=10)
    parser.add_argument("--items", type=int, default=10_000)
    parser.add_argument("--stalled", type=int, default=50)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        content = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))
        content["world"]["real_time_factor"] = 1.0
        content["recording"] = None
        config = folder / "cell.yaml"
        config.write_text(yaml.safe_dump(content), encoding="utf-8")
        alone = measure(folder / "alone", config, given.cycles, 0, None)
        told("alone", alone, alone)
        found = measure(folder / "items", config, given.cycles, given.items, None)
        told(f"{given.items} monitored items", alone, found)
        found = measure(folder / "halted", config, given.cycles, given.items, given.stalled)
        told(f"{given.items} items of halted clients, {given.stalled} of the link", alone, found)


if __name__ == "__main__":
    main()
