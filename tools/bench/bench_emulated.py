"""Waits of the emulated cell in real time, its emulators on the same cores, and who takes the CPU.

    python -m tools.bench.bench_emulated [--cycles 20] [--seed 1]

Beside every wait stands the longest stall of this computer in that cycle, as another process
measured it, and the CPU time of each process while the hold was filmed, as a share of a core.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from cell.computer.stalls import StallProbe
from cell.records.result import Outcome
from cell.run.plans import HOLD, IDENTIFY
from cell.settings import Settings, load_settings
from cell.simulated.emulated import EmulatedCell
from cell.wiring.build import cell_with, real_devices
from drivers.priority import take_precedence
from tools.bench.bench_wait import cpu_of, processes

CONFIG = Path(__file__).parents[2] / "config" / "emulated.yaml"
HOST = "127.0.0.77"
#: What a hand may wait where two cores also render, stream and see the pictures, s.
MOST_WAITED_S = 0.5


@dataclass(frozen=True)
class Cycle:
    """One cycle.

    wait_s   of the hand for the computer; nan = it did not come so far
    stall_s  longest stall of this computer meanwhile
    shares   CPU time of each process while the hold was filmed, share of a core
    """

    outcome: str
    wait_s: float
    stall_s: float
    shares: dict[str, float]


def emulated_settings(folder: Path) -> Settings:
    """The shipped emulated cell at addresses of its own."""
    content = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))
    content["arm"]["host"] = HOST
    content["camera"]["device"] = f"tcp://{HOST}:5600"
    content["gripper"]["port"] = str(folder / "gripper")
    path = folder / "emulated.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return load_settings(path)


def named(emulated: EmulatedCell, probe_pid: int | None) -> dict[int, str]:
    """The processes that there are, by their numbers; a probe of stalls is left out."""
    known = {
        os.getpid(): "cell",
        emulated.controller.pid: "emulated arm",
        emulated.camera.pid: "emulated camera",
        emulated.gripper.pid: "emulated gripper",
    }
    found = {}
    for pid, command in processes().items():
        ahead = "arm's process" if "ur_child" in command else "computing ahead"
        if pid != probe_pid and "resource_tracker" not in command:
            found[pid] = known.get(pid, ahead)
    return found


def cycles(count: int, seed: int) -> list[Cycle]:
    """Every cycle, told as it comes."""
    found = []
    with tempfile.TemporaryDirectory() as name:
        settings = emulated_settings(Path(name))
        with EmulatedCell(settings, seed) as emulated, StallProbe() as probe:
            take_precedence()
            began: dict[str, tuple[float, dict[str, float]]] = {}

            def on_step(number: int, step: str) -> None:
                if step in (HOLD.name, IDENTIFY.name):
                    spent = {n: cpu_of(p) for p, n in named(emulated, probe.pid).items()}
                    began[step] = time.perf_counter(), spent

            cell = cell_with(settings, real_devices(settings), Path(name) / "runs", on_step)
            for number in range(1, count + 1):
                began.clear()
                probe.take()
                result = cell.run_cycle(number)
                stall_s = probe.take().longest_s
                if result.outcome is Outcome.FAILED:
                    print(f"  {result.fault}")
                    cell.acknowledge()
                wait_s = np.nan if result.wait_s is None else result.wait_s
                found.append(Cycle(result.outcome.value, wait_s, stall_s, shares(began)))
                print(f"  cycle {number:3d}: {told(found[-1])}", flush=True)
            cell.close()
    return found


def shares(began: dict[str, tuple[float, dict[str, float]]]) -> dict[str, float]:
    """CPU time of each process from when the hold began until it was identified."""
    if len(began) < 2:
        return {}
    (t0, before), (t1, after) = began[HOLD.name], began[IDENTIFY.name]
    return {name: (after[name] - before.get(name, 0.0)) / (t1 - t0) for name in after}


def told(cycle: Cycle) -> str:
    most_first = sorted(cycle.shares.items(), key=lambda entry: -entry[1])
    return (
        f"{cycle.outcome}, {cycle.wait_s:.3f} s; computer's stall {cycle.stall_s * 1e3:.0f} ms; "
        f"load {os.getloadavg()[0]:.1f}; cores: "
        + ", ".join(f"{name} {share:.2f}" for name, share in most_first)
    )


def summary(found: list[Cycle]) -> str:
    waits_s = np.array([c.wait_s for c in found])
    outcomes = [c.outcome for c in found]
    counts = ", ".join(f"{outcomes.count(o)} {o}" for o in dict.fromkeys(outcomes))
    cores = np.median([sum(c.shares.values()) for c in found if c.shares])
    return (
        f"  {len(found)} cycles: {counts}; median {np.nanmedian(waits_s):.3f} s, worst "
        f"{np.nanmax(waits_s):.3f} s; {np.count_nonzero(waits_s <= MOST_WAITED_S)} within "
        f"{MOST_WAITED_S:g} s; {cores:.2f} cores while the hold was filmed"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cycles", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    print(summary(cycles(options.cycles, options.seed)))


if __name__ == "__main__":
    main()
