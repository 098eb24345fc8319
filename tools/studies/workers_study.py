"""Recorded cycles identified again by one and by two workers: speed, memory, and the same bits.

    python -m tools.studies.workers_study --cycles 1000 --pairs 1

Copies of recorded cycles are identified by `cell identify --all`, each as if it were another.  One
and two workers go in pairs, because other programs may have the cores.  Beside the time by the
clock, which these spoil, stands that of processors: the client's and its busiest worker's add up to
what two idle cores would take at most.  Then a worker is killed midway, on this computer and in a
Dask cluster.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
CELL = (sys.executable, "-m", "cell")
#: Processes are looked at so often, s.
LOOK_S = 0.1
#: What a copy of a cycle has.
NEEDED = ("state.json", "settings.yaml", "model.json", "study")


@dataclass
class Watched:
    """A command that has ended, by its processes' numbers.

    cpu_s      processor time that each has taken, the command's own first
    peak_mib   resident memory of each at its most
    """

    wall_s: float
    cpu_s: dict[int, float] = field(default_factory=dict)
    peak_mib: dict[int, float] = field(default_factory=dict)
    client: int = 0

    @property
    def on_idle_cores_s(self) -> float:
        """At most, if nothing else ran: the client's part is not done beside the workers'."""
        workers = [s for number, s in self.cpu_s.items() if number != self.client]
        return self.cpu_s.get(self.client, 0.0) + max(workers, default=0.0)


def identified(folder: Path, table: Path, where: str, kill: Callable[[Watched], None]) -> Watched:
    """Identify all, with a look at the processes every so often.

    kill  is told of every look
    """
    table.unlink(missing_ok=True)
    words = (*CELL, "identify", "--all", str(folder), "--csv", str(table), "--workers", where)
    begin_s = time.perf_counter()
    process = subprocess.Popen([*words, "--json"], env=ENVIRONMENT, stdout=subprocess.DEVNULL)
    seen = Watched(0.0)
    while process.poll() is None:
        _look(process.pid, seen)
        kill(seen)
        time.sleep(LOOK_S)
    if process.returncode:
        sys.exit(f"{' '.join(words)} ended with {process.returncode}")
    seen.wall_s = time.perf_counter() - begin_s
    return seen


def _look(pid: int, seen: Watched) -> None:
    """The command watches a child, the client; the child's children are its workers."""
    try:
        for process in psutil.Process(pid).children(recursive=True):
            if process.ppid() == pid:
                seen.client = process.pid
            spent, memory = process.cpu_times(), process.memory_info().rss / 2**20
            seen.cpu_s[process.pid] = spent.user + spent.system
            seen.peak_mib[process.pid] = max(seen.peak_mib.get(process.pid, 0.0), memory)
    except psutil.NoSuchProcess:
        return


def nobody(seen: Watched) -> None:
    """Kills nothing."""


def killer(table: Path, rows: int, victim: Callable[[Watched], int]) -> Callable[[Watched], None]:
    """Kills one worker as soon as the table has so many rows."""
    killed: list[int] = []

    def kill(seen: Watched) -> None:
        if not killed and table.exists() and table.read_bytes().count(b"\n") > rows:
            killed.append(victim(seen))
            os.kill(killed[0], signal.SIGKILL)
            print(f"  killed worker {killed[0]} after {rows} recordings", flush=True)

    return kill


def a_worker(seen: Watched) -> int:
    """One of the client's copies."""
    there = psutil.Process(seen.client).children()
    return next(p.pid for p in there)


@contextmanager
def cluster(folder: Path, workers: int) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and workers on loopback; its address and the workers."""
    file = folder / "scheduler.json"
    dask = (sys.executable, "-m", "dask")
    common = ("--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(file))
    options = ("--nthreads", "1", "--no-nanny", "--local-directory", str(folder))
    commands = [(*dask, "scheduler", "--port", "0", *common)]
    commands += [(*dask, "worker", *common, *options)] * workers
    processes = []
    try:
        with (folder / "dask.log").open("wb") as log:
            for words in commands:
                processes.append(subprocess.Popen(words, env=ENVIRONMENT, stdout=log, stderr=log))
        from distributed import Client

        with Client(scheduler_file=str(file), timeout=120, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=120)
            address = client.scheduler.address
        yield address, processes[1:]
    finally:
        for process in reversed(processes):
            process.kill()
            process.wait()


def copies(folder: Path, recorded: Sequence[Path], count: int) -> Path:
    """So many cycles, copies of those recorded, each with a name of its own."""
    place = folder / "year"
    for number in range(count):
        source = recorded[number % len(recorded)]
        cycle = (
            place / f"20261125T{number // 3600:02d}{number // 60 % 60:02d}{number % 60:02d}.000-1"
        )
        cycle.mkdir(parents=True)
        for name in NEEDED:
            part = source / name
            (shutil.copytree if part.is_dir() else shutil.copy)(part, cycle / name)
    return place


def recorded_cycles(given: Path | None, folder: Path) -> list[Path]:
    """Cycles with a model, of a folder of cycles or newly simulated."""
    if given is None:
        given, config = folder / "runs", folder / "cell.yaml"
        config.write_text((ROOT / "config/fake.yaml").read_text() + "recording: null\n")
        words = (*CELL, "run", "--config", str(config), "--cycles", "3", "--out", str(given))
        subprocess.run(words, env=ENVIRONMENT, stdout=subprocess.DEVNULL, check=False)
    found = sorted(p.parent for p in given.glob("*/model.json"))
    if not found:
        sys.exit(f"{given}: holds no cycle with a model")
    return found


def told(name: str, seen: Watched, reference: bytes | None, table: Path) -> None:
    """One line of a run."""
    same = "" if reference is None else f", table {_same(reference, table)}"
    client = seen.peak_mib.get(seen.client, 0.0)
    print(
        f"{name}: {seen.wall_s:.1f} s by the clock, on idle cores ≤ {seen.on_idle_cores_s:.1f} s, "
        f"client's memory {client:.0f} MiB{same}",
        flush=True,
    )


def _same(reference: bytes, table: Path) -> str:
    return "the same bit for bit" if table.read_bytes() == reference else "DIFFERS"


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cycles", type=int, default=1000)
    parser.add_argument("--pairs", type=int, default=1)
    parser.add_argument("--runs", type=Path, help="folder of recorded cycles; default: simulated")
    given = parser.parse_args()
    with TemporaryDirectory() as place:
        folder = Path(place)
        year = copies(folder, recorded_cycles(given.runs, folder), given.cycles)
        table, reference = folder / "table.csv", b""
        for pair in range(given.pairs):
            one = identified(year, table, "1", nobody)
            told(f"pair {pair + 1}, one worker", one, None, table)
            reference = table.read_bytes()
            two = identified(year, table, "2", nobody)
            told(f"pair {pair + 1}, two workers", two, reference, table)
            print(
                f"  {one.wall_s / two.wall_s:.2f} times as fast by the clock, on idle cores ≥ "
                f"{one.on_idle_cores_s / two.on_idle_cores_s:.2f}",
                flush=True,
            )
        half = given.cycles // 2
        killed = identified(year, table, "2", killer(table, half, a_worker))
        told("one of two workers killed", killed, reference, table)
        with cluster(folder, 2) as (address, workers):
            victim = killer(table, half, lambda seen: workers[0].pid)
            killed = identified(year, table, address, victim)
        told("cluster, one of two workers killed", killed, reference, table)


if __name__ == "__main__":
    main()
