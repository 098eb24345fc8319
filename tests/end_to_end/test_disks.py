"""A disk that fills up, or that nobody may write to, during a run: a mount of the test's own."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cell.records.ledger.ledger import Ledger, LedgerQuery
from cell.records.recording import form
from cell.records.recording.reading import verify

CELL = f"{sys.executable} -m cell"
#: In a mount name space of its own, which ends with the shell.
_APART = ["unshare", "-m"] if os.geteuid() == 0 else ["unshare", "-rm"]


def may_mount() -> bool:
    if shutil.which("unshare") is None:
        return False
    command = [*_APART, "sh", "-c", "mount -t tmpfs tmpfs /mnt"]
    return subprocess.run(command, capture_output=True).returncode == 0


pytestmark = pytest.mark.skipif(not may_mount(), reason="no disk can be mounted here")


@pytest.fixture
def on_disk(tmp_path: Path, recorded_config: Path):
    """Run a script where `disk` is a small disk; what it left there, copied."""
    config = tmp_path / "recorded.yaml"
    config.write_text(recorded_config.read_text() + "\nrecording: {min_free_gb: 0}\n")

    def run(size: str, script: str) -> tuple[subprocess.CompletedProcess[str], Path]:
        disk, copy = tmp_path / "disk", tmp_path / "copy"
        disk.mkdir()
        whole = f"mount -t tmpfs -o size={size} tmpfs disk && {script}\ncp -r disk copy"
        done = subprocess.run(
            [*_APART, "sh", "-c", whole],
            cwd=tmp_path,
            env=os.environ | {"CELL": CELL, "PYTHONPATH": str(Path(__file__).parents[2])},
            capture_output=True,
            text=True,
            timeout=240,
        )
        return done, copy

    return run


CYCLES = "$CELL run -c recorded.yaml --runs disk/runs --cycles"


def outcomes(copy: Path) -> list[str]:
    results = sorted(copy.glob("runs/*/result.json"))
    return [json.loads(r.read_text())["outcome"] for r in results]


def listed(copy: Path) -> list[str]:
    ledger = Ledger(copy / "runs")
    try:
        return [c.outcome for c in ledger.listed(LedgerQuery())]
    finally:
        ledger.close()


def test_a_disk_that_fills_up_costs_nothing_earlier(on_disk):
    """The second cycle finds a full disk: nothing moves, the cause is named, the first is whole."""
    fill = "sh -c 'head -c 1G /dev/zero > disk/filler; true' 2> /dev/null"
    script = f"{CYCLES} 1 && cp -r disk/runs before && {fill}; truncate -s -300K disk/filler; "
    done, copy = on_disk("300m", script + f"{CYCLES} 1; echo code $?; rm disk/filler")
    assert "code 1" in done.stdout
    assert "MB are free on the disk" in done.stderr and "make room there" in done.stderr
    assert outcomes(copy) == ["inserted", "failed"]
    assert listed(copy) == ["inserted", "failed"]
    (first,) = (copy.parent / "before").iterdir()
    for file in (f for f in first.rglob("*") if f.is_file()):
        now = copy / "runs" / first.name / file.relative_to(first)
        assert now.read_bytes() == file.read_bytes(), file
    assert verify(copy / "runs" / first.name / form.FILE)[form.IMAGE] > 100


def test_with_little_room_frames_are_left_out_and_the_cable_goes_in(on_disk):
    done, copy = on_disk("69m", f"{CYCLES} 2")
    assert done.returncode == 0, done.stderr
    assert "frames are missing" in done.stderr
    assert outcomes(copy) == listed(copy) == ["inserted", "inserted"]
    assert all(verify(f) for f in copy.glob(f"runs/*/{form.FILE}"))


def test_where_nobody_may_write_nothing_moves(on_disk):
    script = f"{CYCLES} 1 && mount -o remount,ro disk && cp -r disk before && {CYCLES} 1; "
    done, copy = on_disk("300m", script + "echo code $?; $CELL history --runs disk/runs")
    assert "code 2" in done.stdout
    assert "Read-only file system" in done.stderr
    assert "1 inserted" in done.stdout  # the ledger can be asked all the same
    assert outcomes(copy) == ["inserted"]
    assert len(list((copy / "runs").iterdir())) == 1
