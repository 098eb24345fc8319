"""Kills every adapter, and the pages, in every step of a cycle, which must end as without it.

    python -m tools.plant.adapter_kills [--only mqtt] [--steps lower execute] [--quick]

The simulated cell runs as a service with OPC UA, MQTT, the handshake and `cell serve`, with a
viewer of the live page: once untouched, and once with a kill (SIGKILL) in each cycle.  Outcome,
chosen offset, margin and steps of the n-th cycle must be the same.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from cell.plant.client import Client
from cell.plant.messages import MessageKind, Notice, Request, Status
from cell.run.machine import MachineEvent
from cell.run.plans import INSERTING
from tools.plant.around import ADAPTERS, Plant
from tools.plant.viewer import Viewer
from tools.processes import running
from tools.shipped_settings import FAKE, with_entries

#: Number of cycles beyond the kills: not every cycle has every step.
SPARE = 3
#: Entries of a result that must not depend on kills.
SAME = ("cycle", "outcome", "offset_m", "margin_m", "reason")


@dataclass(frozen=True)
class MadeCycle:
    """A cycle: its result, and its steps in their order."""

    result: dict[str, Any]
    steps: tuple[str, ...]

    def differs(self, reference: MadeCycle) -> str:
        """Names of the entries that differ from a reference; empty = none."""
        names = [n for n in SAME if self.result.get(n) != reference.result.get(n)]
        names += ["steps"] if self.steps != reference.steps else []
        return ", ".join(names)


def quick(config: Path, recording: dict[str, int] | None = None) -> Path:
    """Write settings of the simulated cell with fewer, smaller pictures, and these recordings."""
    view = {"metres_per_pixel": 0.00032, "origin_column_px": 625, "origin_row_px": 93.75}
    changes = {
        "camera.frame_rate_hz": 100.0,
        "camera.width_px": 800,
        "camera.height_px": 640,
        "camera.view": view,
        "motion.hold_s": 0.4,
        "motion.offsets.step_m": 0.004,
        "recording": recording,
    }
    config.write_text(with_entries(FAKE, changes), encoding="utf-8")
    return config


def service(config: Path, runs: Path, log: Path) -> AbstractContextManager[object]:
    """Run a cell as a service that waits for starts."""
    words = ("run", "-c", str(config), "--cycles", "forever", "--runs", str(runs))
    return running("cell", *words, log=log)


def made(
    client: Client,
    messages: Iterator[Notice | Status],
    at_step: str = "",
    kill: Callable[[], object] = lambda: None,
) -> MadeCycle:
    """Run one cycle from Idle; when a step begins, kill."""
    for message in messages:
        waits = message.data if isinstance(message, Notice) else vars(message)
        if "start" in waits.get("waiting_for", ()):
            break
    answer = client.send(Request(MachineEvent.START, "tool"))
    assert answer.accepted, answer
    steps: list[str] = []
    for message in messages:
        if isinstance(message, Status):
            raise RuntimeError("the cell was lost")
        if message.kind is MessageKind.STEP:
            steps.append(message.data["step"])
            if steps[-1] == at_step:
                kill()
        if message.kind is MessageKind.RESULT:
            return MadeCycle(dict(message.data), tuple(steps))
    raise RuntimeError("the client was closed")


#: Steps in which adapters are killed: those that every cycle has.
STEPS = [s.name for s in INSERTING.steps if s not in INSERTING.resetting and not s.once]


def assigned(
    planned: list[tuple[str, str]], cycles: list[MadeCycle]
) -> list[tuple[str, str] | None]:
    """Assign a planned kill to each cycle that has its step; rare steps first."""
    count = Counter(step for cycle in cycles for step in set(cycle.steps))
    open_kills = sorted(planned, key=lambda kill: count[kill[1]])
    kills = []
    for cycle in cycles:
        chosen = next((kill for kill in open_kills if kill[1] in cycle.steps), None)
        if chosen is not None:
            open_kills.remove(chosen)
        kills.append(chosen)
    return kills


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--only", nargs="*", default=list(ADAPTERS), help="these adapters")
    parser.add_argument("--steps", nargs="*", default=STEPS, choices=STEPS, help="in these steps")
    parser.add_argument("--quick", action="store_true", help="fewer and smaller pictures")
    options = parser.parse_args()
    adapters = [adapter for adapter in ADAPTERS if adapter in options.only]
    planned, done, wrong = list(product(adapters, options.steps)), 0, 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = quick(folder / "quick.yaml") if options.quick else FAKE
        with service(config, folder / "untouched" / "runs", folder / "log"):
            client = Client(folder / "untouched" / "runs", timeout_s=60.0).connect(120.0)
            messages = client.follow()
            count = len(planned) + SPARE
            untouched = [made(client, messages) for _ in range(count)]
        runs = folder / "killed" / "runs"
        with ExitStack() as stack:
            stack.enter_context(service(config, runs, folder / "log"))
            plant = stack.enter_context(
                Plant(folder / "plant", config, runs, adapters=options.only)
            )
            viewer = Viewer(plant.ports["serve"])
            if "serve" in options.only:
                stack.enter_context(viewer).wait()
            client = Client(runs, timeout_s=60.0).connect(120.0)
            messages = client.follow()
            for chosen, meant in zip(assigned(planned, untouched), untouched, strict=True):
                if chosen is None:
                    made(client, messages)
                    continue
                adapter, step = chosen
                victim = plant.running[adapter].process
                differs = made(client, messages, step, victim.kill).differs(meant)
                victim.wait(10.0)
                done += 1
                wrong += bool(differs)
                print(f"{adapter:9s} killed in {step:20s} {differs or 'as without'}", flush=True)
                plant.start(adapter)
                plant.wait_for(adapter)
                if adapter == "serve":
                    viewer.wait()
    print(f"{done - wrong} of {len(planned)} cycles ended as they would have")
    return int(done - wrong < len(planned))


if __name__ == "__main__":
    raise SystemExit(main())
