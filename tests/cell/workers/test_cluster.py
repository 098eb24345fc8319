"""A real cluster: a worker is killed, others are refused, and what is missing is said."""

from __future__ import annotations

import re
import shutil
import signal
import sys
from types import SimpleNamespace

import pytest

from cell.lab.line.identify_all import identified_table, identify_all
from cell.lab.line.recordings import packer, recordings_in
from cell.study.folder import write_study
from cell.workers.cluster import Cluster, cluster
from cell.workers.executor import WorkersError, place
from cell.workers.here import LocalCores, OneAfterAnother, executor
from cell.workers.identity import code_hash
from drivers.installing import install_extra
from tests.cell.workers import jobs
from tests.cell.workers.conftest import ROOT, when_both_are_there
from tests.waiting import wait_until


def test_what_a_killed_worker_was_doing_is_done_by_the_other(cluster_of_two, tmp_path):
    with when_both_are_there(cluster_of_two) as found:
        results, done = found.map(jobs.EndsOnce(tmp_path, 7), range(40)), []
        done += [next(results).value for _ in range(3)]
        done += [result.value for result in results]
    assert done == [jobs.square(n) for n in range(40)]
    assert len(list(tmp_path.iterdir())) == 3  # both, and the mark that one was killed
    for name in ("a", "b"):
        if cluster_of_two.processes[name].poll() is not None:
            cluster_of_two.processes.pop(name)
            cluster_of_two.start_worker(name)


def test_recordings_are_identified_as_on_this_computer(cluster_of_two, make_study, tmp_path):
    runs = tmp_path / "runs"
    for number in range(4):
        write_study(make_study(seed=40 + number), runs / f"cable_{number}")

    def table_of(executor) -> bytes:
        file = tmp_path / "identified.csv"
        with identified_table(file, afresh=True) as table:
            *_, found = identify_all(recordings_in(runs), packer(runs, None, []), table, executor)
        assert found.outcomes == {"identified": 4}
        return file.read_bytes()

    with when_both_are_there(cluster_of_two) as found:
        assert table_of(found) == table_of(LocalCores(2)) == table_of(OneAfterAnother())


def test_a_worker_that_would_give_other_results_is_refused_by_name(cluster_of_two, tmp_path):
    for package in ("cell", "calib", "drivers"):
        shutil.copytree(ROOT / package, tmp_path / package)
    with (tmp_path / "cell" / "replay.py").open("a") as file:
        file.write("# another version\n")
    cluster_of_two.start_worker("c", threads=2, OPENBLAS_NUM_THREADS="4", PYTHONPATH=str(tmp_path))
    told: list[str] = []

    def refused() -> bool:
        try:
            with cluster(cluster_of_two.address):
                return False
        except WorkersError as error:
            told[:] = str(error).splitlines()
            return len(told) == 3

    try:
        wait_until(refused, why=lambda: str(told))
    finally:
        cluster_of_two.end("c", signal.SIGKILL)
    where = rf"--workers {cluster_of_two.address}: worker tcp://127.0.0.1:\d+ has "
    code = rf"another code [0-9a-f]{{16}}, here {code_hash()}; install the same version of both"
    assert re.match(where + code, told[0])
    assert re.match(where + "OPENBLAS_NUM_THREADS 4; start it with OPENBLAS_NUM_THREADS=1", told[1])
    assert re.match(where + "2 threads; start it with `--nthreads 1 --nworkers 2`", told[2])


class Endless:
    """A cluster whose one worker comes to no end."""

    def __init__(self):
        self.jobs, self.cancelled = [], []

    def nthreads(self):
        return {"worker": 1}

    def submit(self, function, *given, **options):
        self.jobs.append(SimpleNamespace(add_done_callback=lambda told: None, release=lambda: None))
        return self.jobs[-1]

    def cancel(self, futures):
        self.cancelled += futures


def test_what_is_waited_for_is_cancelled_too():
    """An interrupted command left its oldest job to the cluster."""
    client, looks = Endless(), iter(range(2))
    results = Cluster(client, "tcp://x:1").map(abs, [1, 2, 3], lambda: next(looks) and 1 / 0)
    with pytest.raises(ZeroDivisionError):
        next(results)
    _, *jobs = client.jobs
    assert len(jobs) == 3 and client.cancelled == jobs


def test_where_nobody_answers_that_is_said(monkeypatch):
    monkeypatch.setattr("cell.workers.cluster._CONNECT_S", 0.3)
    told = "--workers tcp://127.0.0.1:9: no scheduler answers .*; start one with `dask scheduler`"
    with pytest.raises(WorkersError, match=told), cluster("tcp://127.0.0.1:9"):
        pass


def test_without_its_package_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    told = re.escape(install_extra("cluster"))
    with pytest.raises(WorkersError, match=told), executor("tcp://127.0.0.1:9"):
        pass


@pytest.mark.parametrize(
    ("text", "expected"),
    [("3", 3), ("tcp://host:8786", "tcp://host:8786"), ("tls://10.0.0.1:1", "tls://10.0.0.1:1")],
)
def test_a_place_is_an_address_or_a_number_of_cores(text, expected):
    assert place(text) == expected


@pytest.mark.parametrize("text", ["", "0", "-1", "host:8786", "tcp://host", "http://host:80", "x"])
def test_what_is_no_place_is_refused(text):
    with pytest.raises(WorkersError, match="give 2, or tcp://host:8786"):
        place(text)


def test_cores_of_this_computer_are_used_without_a_cluster():
    with executor(2) as found:
        assert [r.value for r in found.map(jobs.square, [1, 2])] == [jobs.square(1), jobs.square(2)]
