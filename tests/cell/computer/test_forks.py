"""Jobs in copies of this process give what this process would, whatever becomes of the copies."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from cell.computer.forks import forks
from tests.waiting import is_alive, wait_until


class Own:
    """What cannot be pickled by name, as an effect of a user's file."""


def local() -> type:
    class Local(Own):
        pass

    return Local


def pid(job: int) -> tuple[int, int]:
    time.sleep(0.05)
    return job, os.getpid()


def test_results_are_in_the_order_of_the_jobs_and_both_processes_work():
    told = []
    with forks([pid], most=2) as beside:
        found = beside.map(pid, range(8), lambda job, result: told.append(job))
    assert [job for job, _ in found] == list(range(8))
    assert len({process for _, process in found}) == 2
    assert os.getpid() in {process for _, process in found}
    assert sorted(told) == list(range(8))


def test_what_both_know_is_the_same_object_again():
    kind = local()

    def twice(given):
        time.sleep(0.05)
        return given, given

    with forks([twice], most=2, known=[kind]) as beside:
        found = beside.map(twice, [kind] * 4)
    assert all(a is kind and b is kind for a, b in found)


def test_what_a_killed_copy_was_doing_is_done_here():
    here = os.getpid()

    def deadly(job):
        if os.getpid() != here:
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.05)
        return job

    with forks([deadly], most=3) as beside:
        assert beside.map(deadly, range(6)) == list(range(6))
        assert beside.map(deadly, range(3)) == list(range(3))


def test_an_error_is_that_of_this_process():
    here = os.getpid()

    def fails(job):
        time.sleep(0.05)
        if job == 3:
            raise KeyError("here" if os.getpid() == here else "there")
        return job

    with forks([fails], most=2) as beside, pytest.raises(KeyError, match="here"):
        beside.map(fails, range(4))


def test_whoever_waits_may_stop_and_keeps_what_was_done():
    here, told = os.getpid(), []

    def slow(job):
        time.sleep(0.2 if os.getpid() == here else 1e3)
        return job

    def check():
        raise InterruptedError

    begun = time.monotonic()
    with forks([slow], most=2) as beside, pytest.raises(InterruptedError):
        beside.map(slow, range(3), lambda job, result: told.append(job), check)
    assert len(told) == 2
    assert time.monotonic() - begun < 30.0


def test_nothing_is_left_of_the_copies():
    threads = threading.active_count()
    with forks([pid], most=4) as beside:
        processes = {process for _, process in beside.map(pid, range(12))}
    for process in processes - {os.getpid()}:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)
    assert threading.active_count() == threads


def test_a_copy_with_a_job_does_not_outlive_its_parent():
    program = (
        "import os, sys, time\n"
        "from cell.computer.forks import forks\n"
        "def slow(job):\n"
        "    os.write(1, b'%d\\n' % os.getpid())\n"  # at once, or lines of two would be mixed
        "    sum(range(10**12))\n"  # in C, with Python's lock
        "with forks([slow], most=2) as beside:\n"
        "    beside.map(slow, [0, 1])\n"
    )
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    try:
        ids = {int(process.stdout.readline()) for _ in range(2)}
    finally:
        process.kill()
        process.communicate()
    (copy,) = ids - {process.pid}
    wait_until(lambda: not is_alive(copy))


def test_copies_that_cannot_be_made_leave_nothing_open(monkeypatch):
    """As where this user may have no more processes: a cell goes on for days."""

    def refused():
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(os, "fork", refused)
    before = set(Path("/proc/self/fd").iterdir())
    with forks([abs], most=3) as beside:
        assert beside.map(abs, [-1, -2]) == [1, 2]
    assert set(Path("/proc/self/fd").iterdir()) == before
