"""A simulated cell, `cell handshake` and a PLC that misbehaves, three processes: `make handshake`.

Every fifth cycle is aborted, as by a person.  Afterwards what the PLC said and was told is
compared with what the cell did.  Ends with 1 if the cell did anything that it may not.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from cell.plant.client import Client
from cell.plant.messages import MessageKind, Notice, Request, Status
from cell.run.machine import CellState, MachineEvent
from drivers.emulators.launch import EmulatedController
from tools.faults.scripted_plc import (
    HABITS,
    INPUTS,
    SILENCE_S,
    ControllerWire,
    Plc,
    places,
)
from tools.processes import free_port, listens, running, wait_until

CONFIG = Path(__file__).parents[2] / "config" / "fake.yaml"
#: A person aborts every so many-th cycle, while the cable is lowered.
ABORTED_EVERY = 5
#: An opening in which some cables are not inserted: the PLC has to be told that, too.
NARROW_M = [-0.107, -0.105]
#: What the PLC is told of an outcome.
TOLD = {"inserted": "done", "missed": "rejected", "rejected": "rejected", "unfit": "rejected"}
#: The service begins within this, s: on a new computer it compiles.
_BEGIN_S = 180.0


@dataclass(frozen=True)
class HandshakeFindings:
    """What the cell did, compared with what the PLC requested.

    wrong  one sentence for everything that it may not do
    """

    cycles: int
    starts: int
    outcomes: dict[str, int]
    suspensions: int
    wrong: tuple[str, ...]


def compared(said: Sequence[dict[str, Any]], happened: Sequence[Notice]) -> HandshakeFindings:
    """Compare what the PLC sent and received with what happened in the cell.

    said      lines of the scripted PLC
    happened  in the cell, since before the first of them
    """
    cycles = [entry for entry in said if "told" in entry]
    states = [n for n in happened if n.kind is MessageKind.STATE]
    starts = [n for n in states if n.data["state"] == CellState.STARTING]
    results = [n.data["outcome"] for n in happened if n.kind is MessageKind.RESULT]
    wrong = [*_wrong_starts(said, happened)]
    if len(starts) != len(cycles):
        wrong.append(f"{len(cycles)} cycles were wanted, and {len(starts)} made")
    for number, (cycle, outcome) in enumerate(zip(cycles, results, strict=False), 1):
        if cycle["told"] != TOLD.get(outcome, "fault"):
            wrong.append(f"cycle {number} was {outcome}, and the PLC was told {cycle['told']}")
    if len(results) != len(cycles):
        wrong.append(f"{len(cycles)} outcomes were told, and there were {len(results)}")
    suspensions = sum(n.data["state"] == CellState.SUSPENDED for n in states)
    return HandshakeFindings(
        len(cycles), len(starts), dict(Counter(results)), suspensions, tuple(wrong)
    )


def _wrong_starts(said: Sequence[dict[str, Any]], happened: Sequence[Notice]) -> Iterator[str]:
    """Starts without what they need, and what moves after a fault that nobody acknowledged."""
    faulted = False
    for notice in happened:
        match notice.kind:
            case MessageKind.FAULT:
                faulted = True
            case MessageKind.ACKNOWLEDGED:
                faulted = False
            case MessageKind.STATE if notice.data["state"] in (
                CellState.STARTING,
                CellState.RESETTING,
            ):
                state = notice.data["state"]
                if faulted:
                    yield f"{state} after a fault without an acknowledgement"
                if state != CellState.STARTING:
                    continue
                before = [e["said"] for e in said if "said" in e and e["time_s"] <= notice.time_s]
                now = before[-1] if before else dict.fromkeys(INPUTS, False)
                for name in ("start", "part_present", "upstream_ready", "downstream_ready"):
                    if not now[name]:
                        yield f"a start without {name}"
                if now["stop"]:
                    yield "a start while stop is on"


class Follower:
    """Collects the notices of a cell, and aborts some of its cycles, in a thread."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self.happened: list[Notice] = []
        self.is_idle = threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    def end(self) -> None:
        self._client.close()
        self._thread.join()

    def _follow(self) -> None:
        cycle = 0
        for message in self._client.follow():
            if isinstance(message, Status):
                state: object = message.state
            else:
                self.happened.append(message)
                state = message.data.get("state")
                if message.kind is MessageKind.CYCLE:
                    cycle += 1
                lowers = message.kind is MessageKind.STEP and message.data["step"] == "lower"
                if lowers and cycle % ABORTED_EVERY == 0:
                    self._client.send(Request(MachineEvent.ABORT, "trial", "a person aborts it"))
            if state == CellState.IDLE:
                self.is_idle.set()


def trial(carrier: str, cycles: int, host: str, folder: Path) -> HandshakeFindings:
    """Run `cycles` cycles over one carrier of the handshake, in the given folder."""
    controller = carrier == "controller"
    port = free_port()
    handshake = {"carrier": carrier, "silence_s": SILENCE_S, **places()}
    handshake |= {"host": host} if controller else {"port": port}
    settings = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))
    settings |= {"plant": {"handshake": handshake}, "recording": None}
    settings["destination"]["y_m"] = NARROW_M
    config, runs = folder / "cell.yaml", folder / "runs"
    config.write_text(yaml.safe_dump(settings), encoding="utf-8")
    given = ["-c", str(config)]
    with ExitStack() as stack:
        stack.enter_context(EmulatedController(host) if controller else nullcontext())
        if controller:
            Plc(ControllerWire(host)).say()  # the PLC has power: a stop would stop
        run = ("cell", "run", *given, "--cycles", "forever", "--runs", str(runs))
        stack.enter_context(running(*run, log=folder / "cell.log"))
        client = Client(runs).connect(wait_s=_BEGIN_S)
        follower = Follower(client)
        assert follower.is_idle.wait(_BEGIN_S), "the cell is not ready"
        serve = ("cell", "-v", "handshake", *given, "--runs", str(runs))
        stack.enter_context(running(*serve, log=folder / "handshake.log"))
        if not controller:
            wait_until(lambda: listens(port))
        place = f"controller:{host}" if controller else f"modbus:{port}"
        plc = [sys.executable, "-m", "tools.faults.scripted_plc", place, str(cycles)]
        done = subprocess.run(plc, stdout=subprocess.PIPE, text=True)
        follower.end()
        said = [json.loads(line) for line in done.stdout.splitlines()]
        (folder / "plc.jsonl").write_text(done.stdout, encoding="utf-8")
        found = compared(said, follower.happened)
        if done.returncode != 0:
            found = HandshakeFindings(**{**vars(found), "wrong": (*found.wrong, "the PLC gave up")})
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cycles", type=int, default=50)
    parser.add_argument("--carrier", choices=["modbus", "controller"], action="append")
    parser.add_argument("--host", default="127.0.0.79", help="address of the emulated controller")
    parser.add_argument("--keep", type=Path, help="folder for records and logs; else removed")
    arguments = parser.parse_args()
    failed = False
    print(f"habits: {', '.join(HABITS)}", flush=True)
    for carrier in arguments.carrier or ["modbus", "controller"]:
        with tempfile.TemporaryDirectory() as temporary:
            folder = arguments.keep / carrier if arguments.keep else Path(temporary)
            folder.mkdir(parents=True, exist_ok=True)
            found = trial(carrier, arguments.cycles, arguments.host, folder)
        outcomes = ", ".join(f"{count} {name}" for name, count in sorted(found.outcomes.items()))
        print(
            f"{carrier:10s} {found.cycles} cycles wanted, {found.starts} made: {outcomes}; "
            f"{found.suspensions} suspensions; {len(found.wrong)} wrong",
            flush=True,
        )
        for sentence in found.wrong:
            print(f"  {sentence}", flush=True)
        failed |= bool(found.wrong) or found.cycles != arguments.cycles
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
