"""Hundreds of cycles through the real clients against the emulators: `make endurance`.

Waits and hold are as short as identification allows; the arm's protocol itself runs in real time.
After every cycle memory, threads and file handles of the cell's two processes (its own and the
arm's child) are counted; the table gives their slope per cycle after the first tenth.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections import Counter
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
from scipy.stats import linregress

from cell.records.result import Outcome
from cell.settings import load_settings
from cell.wiring.build import cell_with, real_devices
from cell.wiring.emulated import EmulatedCell
from tools.faults.short_cycles import short_cycles
from tools.processes import status_of

#: Shortest waits with which a cable can be identified, s.
SHORTEST = {"calm_s": 0.0, "still_s": 0.3, "hold_s": 0.4, "decide_s": 0.3, "settle_s": 0.05}
#: Growth that counts as none over 500 cycles: KiB, threads, handles.
FLAT = (10_240.0, 1.0, 1.0)


@dataclass(frozen=True)
class ResourceUse:
    """Memory, threads and handles of a process."""

    memory_kib: int
    threads: int
    handles: int


def held_by(pid: int) -> ResourceUse:
    status = status_of(pid)
    handles = len(list(Path(f"/proc/{pid}/fd").iterdir()))
    return ResourceUse(int(status["VmRSS"].split()[0]), int(status["Threads"]), handles)


def report(name: str, rows: list[ResourceUse]) -> bool:
    """Print the growth of resources per cycle after the first tenth; returns whether it is flat."""
    later, flat = rows[len(rows) // 10 :], True
    if len(later) < 3:  # too few for a slope
        return True
    columns = zip(*map(astuple, later), strict=True)
    for quantity, unit, most, values in zip(("memory", "threads", "handles"), ("KiB", "", ""), FLAT,
                                        columns, strict=True):  # fmt: skip
        fit = linregress(np.arange(len(values)), values)
        error = float(np.nan_to_num(fit.stderr))  # nan where nothing changes
        holds = 500.0 * (fit.slope - 2.0 * error) <= most
        flat &= bool(holds)
        print(
            f"  {name:6s} {quantity:8s} {values[0]:8d} → {values[-1]:8d} {unit:4s} "
            f"slope {fit.slope:+.4f} ± {2.0 * error:.4f} per cycle  "
            f"{'flat' if holds else 'GROWS'}"
        )
    return flat


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cycles", type=int, default=500)
    parser.add_argument("--host", default="127.0.0.78", help="address of the emulated arm")
    parser.add_argument("--patience-s", type=float, default=0.15, help="with the gripper")
    arguments = parser.parse_args()
    outcomes: Counter[str] = Counter()
    own: list[ResourceUse] = []
    child: list[ResourceUse] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = short_cycles(
            folder, arguments.host, arguments.patience_s, own_patience=True, **SHORTEST
        )
        settings = load_settings(path)
        with EmulatedCell(settings, seed=1) as emulated:
            devices = real_devices(settings)
            cell = cell_with(settings, devices, folder / "runs", lambda number, step: None)
            began_s = time.monotonic()
            for number in range(1, arguments.cycles + 1):
                result = cell.run_cycle(number)
                outcomes[result.outcome.value] += 1
                if result.outcome is Outcome.REJECTED:
                    print(f"cycle {number}: {result.reason}", flush=True)
                if result.outcome is Outcome.FAILED:
                    print(f"cycle {number}: {result.fault}", flush=True)
                    cell.acknowledge()
                own.append(held_by(os.getpid()))
                if devices.arm._child is not None:
                    child.append(held_by(devices.arm._child.process.pid))
                if number % 25 == 0:
                    passed_s = time.monotonic() - began_s
                    print(f"{number:4d} {dict(outcomes)} {own[-1]} {passed_s:.0f} s", flush=True)
            lost = emulated.camera.counts().dropped
            cell.close()
    count = sum(outcomes.values())
    print(f"\n{count} cycles: {dict(outcomes)}; {lost} pictures lost by the camera")
    print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    flat = [report("cell", own), report("child", child)]
    return int(not all(flat) or outcomes["failed"] > 0)


if __name__ == "__main__":
    raise SystemExit(main())
