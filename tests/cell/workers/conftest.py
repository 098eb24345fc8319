"""Executors of every kind; the cluster is a real scheduler with two workers on loopback."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from cell.workers.cluster import cluster
from cell.workers.here import LocalCores, OneAfterAnother
from tests.cell.lab.conftest import make_study
from tests.waiting import wait_until

__all__ = ["make_study"]

ROOT = Path(__file__).parents[3]
#: On a busy computer a process of Dask needs many seconds to begin.
PATIENCE_S = 60.0
#: Idle processes of Dask look around a hundred times a second: other tests want the computer.
QUIET = {
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
    "DASK_DISTRIBUTED__ADMIN__SYSTEM_MONITOR__INTERVAL": "5s",
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
}


@dataclass
class Dask:
    """A scheduler and its workers, processes of their own."""

    folder: Path
    processes: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    @property
    def address(self) -> str:
        address: str = json.loads((self.folder / "scheduler.json").read_text())["address"]
        return address

    def start(self, name: str, *command: str, **environment: str) -> None:
        """Start a process of Dask that writes to its log."""
        paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        own = {"PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "1", **QUIET}
        given = {**os.environ, **own, **environment}
        words = [sys.executable, "-m", f"distributed.cli.dask_{command[0]}", *command[1:]]
        with (self.folder / f"{name}.log").open("wb") as log:
            process = subprocess.Popen(words, cwd=self.folder, env=given, stdout=log, stderr=log)
        self.processes[name] = process

    def start_worker(self, name: str, threads: int = 1, **environment: str) -> None:
        options = ("--nthreads", str(threads), "--no-nanny", "--no-dashboard", "--name", name)
        file = str(self.folder / "scheduler.json")
        self.start(name, "worker", "--scheduler-file", file, "--host", "127.0.0.1", *options,
                   "--local-directory", str(self.folder), **environment)  # fmt: skip

    def end(self, name: str, number: signal.Signals = signal.SIGTERM) -> None:
        process = self.processes.pop(name)
        process.send_signal(number)
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def log(self) -> str:
        return "\n".join(file.read_text() for file in sorted(self.folder.glob("*.log")))


@contextmanager
def dask(folder: Path) -> Iterator[Dask]:
    found = Dask(folder)
    try:
        file = str(folder / "scheduler.json")
        found.start("scheduler", "scheduler", "--host", "127.0.0.1", "--port", "0",
                    "--no-dashboard", "--scheduler-file", file)  # fmt: skip
        found.start_worker("a")  # both wait for the scheduler's file
        found.start_worker("b")
        wait_until((folder / "scheduler.json").exists, why=found.log)
        yield found
    finally:
        for name in list(found.processes):
            found.end(name, signal.SIGKILL if name != "scheduler" else signal.SIGTERM)


@pytest.fixture(scope="session")
def cluster_of_two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Dask]:
    with dask(tmp_path_factory.mktemp("dask")) as found:
        yield found


@pytest.fixture(params=["one after another", "local cores", "cluster"])
def executor(request: pytest.FixtureRequest):
    if request.param == "one after another":
        yield OneAfterAnother()
    elif request.param == "local cores":
        yield LocalCores(2)
    else:
        found = request.getfixturevalue("cluster_of_two")
        with when_both_are_there(found) as executor:
            yield executor


@contextmanager
def when_both_are_there(found: Dask):
    from distributed import Client

    with Client(found.address, set_as_default=False, timeout=PATIENCE_S) as client:
        client.wait_for_workers(2, timeout=PATIENCE_S)
    with cluster(found.address) as executor:
        yield executor
