"""Kills recording cells at random moments, and measures what `cell recover` recovers.

A child runs simulated cycles in real time, and writes to shared memory the time of its clock, and
the timestamp of the last frame that it has read.  After SIGKILL of the child, or of the child and
its recorder at once, the last pose and the last frame of its recording are compared with that.

    python -m tools.faults.kill_study --kills 100 kills.csv
"""

from __future__ import annotations

import argparse
import mmap
import os
import random
import signal
import sqlite3
import struct
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from cell.records.folder import UNFINISHED
from cell.records.ledger.ledger import Ledger, LedgerQuery, ListedCycle
from cell.records.recording import form
from cell.records.recording.reading import Recording, read_recording
from cell.records.recording.recover import being_written, recover_in_place, torn_recordings
from tools.processes import Program, family, wait_until
from tools.studies.rows import added_rows

ROOT = Path(__file__).parents[2]
#: Largest permitted loss, s.
MOST_LOST_S = 0.05

_CHILD = """
import mmap, struct, sys, threading, time
from pathlib import Path
from cell.wiring.build import build_cell
from cell.settings import load_settings

config, runs, shared = map(Path, sys.argv[1:4])
settings = load_settings(config)
world = settings.world.model_copy(update={"real_time_factor": float(sys.argv[5])})
settings = settings.model_copy(update={"world": world})
cell = build_cell(settings, runs, seed=int(sys.argv[4]), cycles=100)
with shared.open("r+b") as file:
    memory = mmap.mmap(file.fileno(), 16)

camera = cell._station.devices.camera
read = camera.read

def told():
    frame = read()
    if frame is not None:
        memory[8:] = struct.pack("<d", frame.t_s)
    return frame

camera.read = told

def tell():
    while True:
        memory[:8] = struct.pack("<d", cell.now_s())
        time.sleep(0.001)

threading.Thread(target=tell, daemon=True).start()
for number in range(1, 101):
    cell.run_cycle(number)
"""


@dataclass(frozen=True)
class KilledCell:
    """Recovered data of one killed cell.

    after_s   since its first cable was grasped, by the computer's clock
    both      whether the recorder was killed at the same time
    step      current step of the cell
    poses_lost_s    from the last recorded pose, or the beginning of the recording if that was
                    later, to the kill
    frames_lost_s   from the last recorded frame to the last that the cell has read; nan = none
    finished_cycles, results   cycles marked as closed; those with a result
    listed, listed_wrong   cycles in the ledger; those listed as finished without a result
    """

    number: int
    after_s: float
    both: bool
    step: str
    frames: int
    poses_lost_s: float
    frames_lost_s: float
    finished_cycles: int
    results: int
    listed: int
    listed_wrong: int


def kill_once(
    config: Path, runs: Path, number: int, after_s: float, both: bool, speed: float = 1.0
) -> KilledCell:
    """Run a cell, kill it some time after it grasps, and recover the recording.

    speed   of the simulated world; at 1 a busy computer falls behind, and then makes up for it
    raises  RuntimeError: the cell ended by itself, or nothing could be recovered, or the ledger
            is damaged
    """
    with tempfile.NamedTemporaryFile() as shared:
        shared.write(bytes(16))
        shared.flush()
        command = [sys.executable, "-c", _CHILD, config, runs, shared.name, number + 1, speed]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        child = Program(list(map(str, command)), env=environment, cwd=ROOT)
        try:
            states = "*/state.json"
            wait_until(lambda: any('"grasp"' in f.read_text() for f in runs.glob(states)), child)
            time.sleep(after_s)
            memory = mmap.mmap(shared.fileno(), 16)
            pid = child.process.pid
            ids = family(pid) if both else [pid]
            now_s, frame_s = struct.unpack("<dd", memory[:16])
            for process in ids:
                os.kill(process, signal.SIGKILL)
        finally:
            child.end()
    deadline = time.monotonic() + 300.0  # it runs in the spare time of a busy computer
    while any(being_written(p) for p in runs.rglob(form.PART)):
        if time.monotonic() > deadline:
            raise RuntimeError("the recorder does not end")
        time.sleep(0.01)
    for torn in torn_recordings(runs):
        recover_in_place(torn)
    folders = sorted(runs.iterdir())
    recordings = [read_recording(f) for f in folders]
    frames = [message["t_s"] for one in recordings for message in one.json(form.FRAME)]
    recording = recordings[-1]
    states = list(recording.json(form.STATE))
    closed = [f for f in folders if '"closed": true' in (f / "state.json").read_text()]
    results = [f for f in folders if (f / "result.json").exists()]
    listed = _ledger_cycles(runs)
    ended = [c for c in listed if c.outcome != UNFINISHED]
    return KilledCell(
        number,
        after_s,
        both,
        str(states[-1]["step"]) if states else "",
        recording.count(form.IMAGE),
        (now_s - _known_until_s(recording)) / speed,
        (frame_s - max(frames, default=0.0)) / speed if frame_s else float("nan"),
        len(closed),
        len(results),
        len(listed),
        sum(not (c.folder / "result.json").exists() for c in ended),
    )


def _ledger_cycles(runs: Path) -> list[ListedCycle]:
    """Cycles in the ledger, which is opened without changes, and may not exist yet."""
    place = runs.with_name(f"{runs.name}.sqlite")
    if not place.exists():
        return []
    with closing(sqlite3.connect(place)) as database:
        if database.execute("PRAGMA integrity_check").fetchall() != [("ok",)]:
            raise RuntimeError(f"{place} is damaged")
        if not database.execute("SELECT * FROM sqlite_master").fetchall():  # as it was being made
            return []
    with closing(Ledger(runs)) as ledger:
        return ledger.listed(LedgerQuery())


def _known_until_s(recording: Recording) -> float:
    """Time of the last measured pose, or of the recording's beginning, on the cell's clock, s."""
    with recording.path.open("rb") as file:
        topics = [form.CYCLE, form.MEASURED]
        messages = make_reader(file).iter_messages(topics=topics, log_time_order=False)
        last_ns = max(
            (m.log_time for _, _, m in messages), default=int(recording.started[form.EPOCH])
        )
    return (last_ns - int(recording.started[form.EPOCH])) / 1e9


def table(kills: list[KilledCell]) -> str:
    """Sentences on the largest losses."""
    lines = [f"{len(kills)} kills, {sum(k.both for k in kills)} of them with the recorder"]
    for kind in ("poses", "frames"):
        lost_ms = 1e3 * np.array([getattr(k, f"{kind}_lost_s") for k in kills])
        lost_ms = lost_ms[np.isfinite(lost_ms)]
        line = f"{kind}: {np.sum(lost_ms <= 1e3 * MOST_LOST_S)} of {len(lost_ms)} up to "
        line += f"{MOST_LOST_S * 1e3:.0f} ms before"
        if len(lost_ms):
            line += f"; median {np.median(lost_ms):.0f} ms, largest {lost_ms.max():.0f} ms"
        lines.append(line)
    false, listed = sum(k.listed_wrong for k in kills), sum(k.listed for k in kills)
    lines.append(f"ledger: sound every time; {listed} cycles, {false} called finished that are not")
    wrong = sum(k.finished_cycles != k.results for k in kills)
    lines.append(f"listed as finished without a result, or the other way round: {wrong}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("file", type=Path, help="CSV file to write")
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--config", type=Path, default=ROOT / "config" / "fake.yaml")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--speed", type=float, default=0.5, help="of the simulated world")
    parser.add_argument("--longest-s", type=float, default=14.0, help="after the first grasp")
    options = parser.parse_args()
    draw = random.Random(options.seed)
    options.file.unlink(missing_ok=True)

    def made() -> Iterator[KilledCell]:
        for number in range(options.kills):
            with tempfile.TemporaryDirectory() as folder:
                after_s, runs = draw.uniform(0.0, options.longest_s), Path(folder) / "runs"
                yield kill_once(
                    options.config, runs, number, after_s, number % 2 == 1, options.speed
                )

    kills = []
    for kill in added_rows(options.file, KilledCell, made()):
        kills.append(kill)
        print(kill, flush=True)
    print(table(kills))


if __name__ == "__main__":
    main()
