"""One of the fault trials.

All of them: `make fault-trials`.  Times are judged there, on a computer that does nothing else.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this machine")
pytestmark = pytest.mark.real_time

ROOT = Path(__file__).parents[2]


def test_the_cell_stops_names_the_fault_keeps_the_cable_and_works_again() -> None:
    worker = os.getpid() % 60000
    command = [
        sys.executable,
        "-m",
        "tools.faults.fault_trials",
        "--only",
        "gripper: unplugged in hold_and_capture",
        "--kills",
        "0",
        "--attempts",
        "3",
    ]
    command += ["--patience-s", "0.5", "--bar-ms", "1000"]
    command += ["--host", f"127.{120 + worker // 250 % 100}.{1 + worker % 250}.10"]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 of 1 trials passed" in done.stdout
