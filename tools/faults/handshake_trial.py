"""A simulated cell, `cell handshake` and a PLC that misbehaves, three processes: `make handshake`.

Every fifth cycle is aborted, as by a person.  Afterwards the signals of the PLC are compared with
the actions of the cell.  Ends with 1 if the cell violated the protocol.
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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

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
from tools.processes import BEGIN_S, free_port, listens, running, wait_until
from tools.shipped_settings import FAKE, with_entries

#: Interval of the cycles that a person aborts, while the cable is lowered.
ABORTED_EVERY = 5
#: An opening in which some cables are not inserted, to test the report of that, too.
NARROW_M = [-0.107, -0.105]
#: Signal to the PLC for an outcome.
REPORTED = {"inserted": "done", "missed": "rejected", "rejected": "rejected", "unfit": "rejected"}


@dataclass(frozen=True)
class HandshakeFindings:
    """Comparison of the cell's actions with the PLC's requests.

    wrong  one sentence for each violation
    """

    cycles: int
    starts: int
    outcomes: dict[str, int]
    suspensions: int
    wrong: tuple[str, ...]


def compared(plc_log: Sequence[dict[str, Any]], happened: Sequence[Notice]) -> HandshakeFindings:
    """Compare the signals of the PLC with the notices of the cell.

    plc_log   lines of the scripted PLC
    happened  notices of the cell, from before the first line on
    """
    cycles = [entry for entry in plc_log if "told" in entry]
    states = [n for n in happened if n.kind is MessageKind.STATE]
    starts = [n for n in states if n.data["state"] == CellState.STARTING]
    results = [n.data["outcome"] for n in happened if n.kind is MessageKind.RESULT]
    wrong = [*_wrong_starts(plc_log, happened)]
    if len(starts) != len(cycles):
        wrong.append(f"{len(cycles)} cycles were wanted, and {len(starts)} made")
    for number, (cycle, outcome) in enumerate(zip(cycles, results, strict=False), 1):
        if cycle["told"] != REPORTED.get(outcome, "fault"):
            wrong.append(f"cycle {number} was {outcome}, and the PLC was told {cycle['told']}")
    if len(results) != len(cycles):
        wrong.append(f"{len(cycles)} outcomes were told, and there were {len(results)}")
    suspensions = sum(n.data["state"] == CellState.SUSPENDED for n in states)
    return HandshakeFindings(
        len(cycles), len(starts), dict(Counter(results)), suspensions, tuple(wrong)
    )


def _wrong_starts(log: Sequence[dict[str, Any]], happened: Sequence[Notice]) -> Iterator[str]:
    """Starts without their conditions, and motions before a fault is acknowledged."""
    faulted = False
    for notice in happened:
        match notice.kind:
            case MessageKind.FAULT:
                faulted = True
            case MessageKind.ACKNOWLEDGED:
                faulted = False
            case MessageKind.STATE:
                state = notice.data["state"]
                if faulted and state in (CellState.STARTING, CellState.RESETTING):
                    yield f"{state} after a fault without an acknowledgement"
                if state != CellState.STARTING:
                    continue
                before = [e["said"] for e in log if "said" in e and e["time_s"] <= notice.time_s]
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
    """Run `cycles` cycles over one carrier of the handshake, in a folder."""
    controller = carrier == "controller"
    port = free_port()
    handshake = {"carrier": carrier, "silence_s": SILENCE_S, **places()}
    handshake |= {"host": host} if controller else {"port": port}
    changes = {"plant": {"handshake": handshake}, "recording": None, "destination.y_m": NARROW_M}
    config, runs = folder / "cell.yaml", folder / "runs"
    config.write_text(with_entries(FAKE, changes), encoding="utf-8")
    options = ["-c", str(config)]
    with ExitStack() as stack:
        stack.enter_context(EmulatedController(host) if controller else nullcontext())
        if controller:
            Plc(ControllerWire(host)).say()  # the PLC has power: a stop would stop
        run = ("cell", "run", *options, "--cycles", "forever", "--runs", str(runs))
        stack.enter_context(running(*run, log=folder / "cell.log"))
        client = Client(runs).connect(wait_s=BEGIN_S)
        follower = Follower(client)
        assert follower.is_idle.wait(BEGIN_S), "the cell is not ready"
        serve = ("cell", "-v", "handshake", *options, "--runs", str(runs))
        stack.enter_context(running(*serve, log=folder / "handshake.log"))
        if not controller:
            wait_until(lambda: listens(port))
        place = f"controller:{host}" if controller else f"modbus:{port}"
        plc = [sys.executable, "-m", "tools.faults.scripted_plc", place, str(cycles)]
        done = subprocess.run(plc, stdout=subprocess.PIPE, text=True)
        follower.end()
        plc_log = [json.loads(line) for line in done.stdout.splitlines()]
        (folder / "plc.jsonl").write_text(done.stdout, encoding="utf-8")
        result = compared(plc_log, follower.happened)
        if done.returncode != 0:
            result = replace(result, wrong=(*result.wrong, "the PLC gave up"))
    return result


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
            findings = trial(carrier, arguments.cycles, arguments.host, folder)
        outcomes = ", ".join(f"{count} {name}" for name, count in sorted(findings.outcomes.items()))
        print(
            f"{carrier:10s} {findings.cycles} cycles wanted, {findings.starts} made: {outcomes}; "
            f"{findings.suspensions} suspensions; {len(findings.wrong)} wrong",
            flush=True,
        )
        for sentence in findings.wrong:
            print(f"  {sentence}", flush=True)
        failed |= bool(findings.wrong) or findings.cycles != arguments.cycles
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
