"""Kills processes of a running cell while the emulated arm moves: the arm must stop at once."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cell.wiring.emulated import EmulatedCell
from tools.processes import family

STILL_S = 0.2


@dataclass(frozen=True)
class KilledProcess:
    """A killed process, the time of the kill, and the duration of the arm's motion after it, s."""

    victim: str
    after_s: float
    speed_m_per_s: float
    moved_on_s: float


def kill_somebody(
    emulated: EmulatedCell, config: Path, runs: Path, victim: str, rng: random.Random
) -> KilledProcess:
    """Run a cell as a process of its own and kill one of its processes while the arm moves."""
    command = [sys.executable, "-m", "cell", "run", "--config", str(config), "--runs", str(runs)]
    cell = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    began_s, delay_s = time.monotonic(), rng.uniform(0.0, 0.25)
    moves = rng.choice([1, 2, 3])  # lower, execute, go home
    try:
        motions, moving = 0, False
        while motions < moves and cell.poll() is None:
            speed = np.linalg.norm(emulated.controller.request("state")["speed"][:3])
            if speed > 0.02 and not moving:
                motions += 1
            moving = bool(speed > 0.02)
            time.sleep(0.004)
        time.sleep(delay_s)
        children = _arm_processes(cell.pid)
        state = emulated.controller.request("state")
        pids = [cell.pid] if victim == "cell" else children
        pids = [*children, cell.pid] if victim == "both" else pids
        killed_s = time.monotonic()
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):  # it had come to its end
                os.kill(pid, signal.SIGKILL)
        time.sleep(STILL_S + 0.1)
        moved_s = emulated.controller.request("state")["last_moved_s"] - killed_s
        speed = float(np.linalg.norm(state["speed"][:3]))
        return KilledProcess(victim, killed_s - began_s, speed, max(0.0, moved_s))
    finally:
        cell.kill() if victim != "child" else cell.terminate()
        cell.wait()


def _arm_processes(pid: int) -> list[int]:
    """The processes of the arm's client that a cell has started."""
    children = []
    for child in family(pid)[1:]:
        with contextlib.suppress(OSError):  # it has ended
            if "ur_child" in Path(f"/proc/{child}/cmdline").read_text():
                children.append(child)
    return children
