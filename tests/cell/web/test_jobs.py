"""Jobs of the lab's page: queued, followed, cancelled, ended with the server; never many."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from cell.computer.watched import FIT_ERROR
from cell.web.jobs import (
    LONGEST_LINE,
    MOST_LINES,
    MOST_WAITING,
    REMEMBERED,
    Job,
    Jobs,
    JobState,
    JobTask,
    run_command,
)
from tests.waiting import wait_until

ENDLESS = "import time; print('work: 3 of 4, 1 s so far', flush=True, file=sys.stderr)\n"
ENDLESS += "while True: time.sleep(0.01)"
STUBBORN = f"import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)\n{ENDLESS}"
ANSWERING = """
import signal, time
def stop(*_): print('the best so far'); sys.exit(143)
signal.signal(signal.SIGTERM, stop)
print('work: begun', flush=True, file=sys.stderr)
while True: time.sleep(0.01)
"""


def started(words: Sequence[str]) -> subprocess.Popen[str]:
    """A program in place of a command; its first word is what progress begins with."""
    return subprocess.Popen(
        [sys.executable, "-c", f"import sys\n{words[1]}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


@pytest.fixture
def jobs() -> Iterator[Jobs]:
    with Jobs(started, answering_s=60.0) as jobs:
        yield jobs


def task(*programs: str, subject: str = "study", log: Path | None = None) -> JobTask:
    return JobTask("Work", subject, tuple(("work", p) for p in programs), log=log)


def newest(jobs: Jobs) -> Job:
    return jobs.listed()[0]


def test_commands_run_one_after_another_until_one_fails(jobs: Jobs, tmp_path: Path) -> None:
    log = tmp_path / "results" / "log.txt"
    jobs.submit(task("print(1)", "print(2)\nprint(3)", log=log), "ada")
    wait_until(lambda: newest(jobs).state is JobState.DONE)
    assert newest(jobs).printed == ("2", "3")
    assert log.read_text() == "2\n3\n"
    jobs.submit(task("print('bad:3: mend it', file=sys.stderr); sys.exit(2)", "1"), "ada")
    failed = wait_until(lambda: newest(jobs).state is JobState.FAILED and newest(jobs))
    assert (failed.step, failed.output, failed.by) == (0, ("bad:3: mend it",), "ada")


def test_progress_is_what_the_command_says(jobs: Jobs) -> None:
    version = jobs.version
    jobs.submit(task(ENDLESS), "ada")
    job = wait_until(lambda: newest(jobs).progress and newest(jobs))
    assert (job.state, job.progress, job.share) == (JobState.RUNNING, "3 of 4, 1 s so far", 0.75)
    assert jobs.version > version
    assert jobs.cancel(job.number) == ""
    wait_until(lambda: newest(jobs).state is JobState.CANCELLED)
    assert "ended" in jobs.cancel(job.number)


def test_errors_of_fits_are_apart_from_what_is_said(jobs: Jobs) -> None:
    said = ({"effects": [], "rms_m": 9e-4}, {"effects": ["a"], "rms_m": 1e-4})
    text = "".join(f"{FIT_ERROR}{json.dumps(error)}\n" for error in said)
    assert jobs.submit(task(f"print({text!r}, end='', file=sys.stderr)"), "ada") == ""
    wait_until(lambda: jobs.listed()[0].state is JobState.DONE)
    assert jobs.listed()[0].errors == said
    assert jobs.listed()[0].output == ()


def test_what_is_cancelled_may_say_what_it_knows(jobs: Jobs, tmp_path: Path) -> None:
    jobs.submit(task(ANSWERING, log=tmp_path / "log.txt"), "ada")
    wait_until(lambda: newest(jobs).progress)
    jobs.cancel(newest(jobs).number)
    wait_until(lambda: newest(jobs).state is JobState.CANCELLED)
    assert (tmp_path / "log.txt").read_text() == "the best so far\n"


def test_what_is_cancelled_between_two_commands_is_not_done() -> None:
    class CancelledAtItsEnd(subprocess.Popen[str]):
        def wait(self, timeout: float | None = None) -> int:
            code = super().wait(timeout)
            jobs.cancel(newest(jobs).number)
            return code

    def start(words: Sequence[str]) -> subprocess.Popen[str]:
        return CancelledAtItsEnd(
            [sys.executable, "-c", words[1]],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    with Jobs(start) as jobs:
        jobs.submit(task("1", "2"), "ada")
        wait_until(lambda: newest(jobs).ended_s is not None)
        assert (newest(jobs).state, newest(jobs).step) == (JobState.CANCELLED, 0)
        jobs.submit(task("1"), "ada")  # all that was asked is done: the order came too late
        wait_until(lambda: newest(jobs).ended_s is not None)
        assert newest(jobs).state is JobState.DONE


def test_what_is_cancelled_before_its_first_command_is_not_done(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = Jobs._run

    def cancelled_first(jobs: Jobs, number: int) -> None:
        jobs.cancel(number)
        run(jobs, number)

    monkeypatch.setattr(Jobs, "_run", cancelled_first)
    with Jobs(started) as jobs:
        jobs.submit(task(ENDLESS), "ada")
        wait_until(lambda: newest(jobs).ended_s is not None)
        assert newest(jobs).state is JobState.CANCELLED


def test_what_does_not_listen_is_ended_by_a_second_cancel(jobs: Jobs) -> None:
    jobs.submit(task(STUBBORN), "ada")
    wait_until(lambda: newest(jobs).progress)
    jobs.cancel(newest(jobs).number)
    assert newest(jobs).state is JobState.CANCELLING
    jobs.cancel(newest(jobs).number)
    wait_until(lambda: newest(jobs).state is JobState.CANCELLED)


def test_what_does_not_listen_is_ended_after_a_while() -> None:
    with Jobs(started, answering_s=0.05) as jobs:
        jobs.submit(task(STUBBORN), "ada")
        wait_until(lambda: newest(jobs).progress)
        jobs.cancel(newest(jobs).number)
        wait_until(lambda: newest(jobs).state is JobState.CANCELLED)


def test_the_queue_is_short_and_the_past_too(jobs: Jobs) -> None:
    jobs.submit(task(ENDLESS), "ada")
    wait_until(lambda: newest(jobs).progress)
    for n in range(MOST_WAITING):
        assert jobs.submit(task("1", subject=str(n)), "ada") == ""
    assert "wait already" in jobs.submit(task("1", subject="more"), "ada")
    first, *_, running = jobs.listed()
    assert jobs.cancel(first.number) == ""
    assert newest(jobs).state is JobState.CANCELLED
    assert "being done" in jobs.submit(task(ENDLESS), "bob")
    jobs.cancel(running.number)
    wait_until(lambda: all(j.state in (JobState.DONE, JobState.CANCELLED) for j in jobs.listed()))
    for n in range(REMEMBERED):
        jobs.submit(task("1", subject=str(n)), "ada")
        wait_until(lambda: newest(jobs).state is JobState.DONE)
    assert len(jobs.listed()) == REMEMBERED


def test_output_without_end_is_cut(jobs: Jobs) -> None:
    long = "print('x' * 3000, file=sys.stderr)"
    jobs.submit(task(f"{long}\nfor _ in range({10 * MOST_LINES}): print('y')"), "ada")
    wait_until(lambda: newest(jobs).state is JobState.DONE)
    assert max(map(len, newest(jobs).output)) == LONGEST_LINE
    assert len(newest(jobs).printed) == MOST_LINES


def test_jobs_end_with_the_server() -> None:
    children: list[subprocess.Popen[str]] = []

    def kept(words: Sequence[str]) -> subprocess.Popen[str]:
        children.append(started(words))
        return children[-1]

    with Jobs(kept) as jobs:
        jobs.submit(task(STUBBORN), "ada")
        jobs.submit(task("1", subject="next"), "ada")
        wait_until(lambda: jobs.listed()[1].progress)
    (child,) = children
    assert child.wait(10) != 0
    with pytest.raises(ProcessLookupError):
        os.killpg(child.pid, 0)
    assert "ending" in jobs.submit(task("1"), "ada")


def test_the_arm_moves_at_once_or_not_at_all(jobs: Jobs) -> None:
    moving = replace(task(ENDLESS, subject="cell"), moves=True)
    jobs.submit(task(ENDLESS), "ada")
    assert "when you say so" in jobs.submit(moving, "ada")
    jobs.cancel(newest(jobs).number)
    wait_until(lambda: newest(jobs).state is JobState.CANCELLED)
    assert jobs.submit(moving, "ada") == ""
    assert "is being measured" in jobs.submit(task("1"), "bob")
    jobs.cancel(newest(jobs).number)
    wait_until(lambda: newest(jobs).state is JobState.CANCELLED)


def test_what_moves_the_arm_closes_its_record_when_the_server_ends(tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    program = ANSWERING.replace("print('the best so far')", f"open({str(closed)!r}, 'w').close()")
    with Jobs(started) as jobs:
        jobs.submit(replace(task(program), moves=True), "ada")
        wait_until(lambda: newest(jobs).progress)
    assert closed.exists()


def test_what_moves_the_arm_has_the_time_it_needs_to_stop_unless_asked_again(
    tmp_path: Path,
) -> None:
    """It was killed while it still closed its record."""
    go, closed = tmp_path / "go", tmp_path / "closed"
    program = f"""
import os, signal, time
def stop(*_):
    while not os.path.exists({str(go)!r}): time.sleep(0.01)
    open({str(closed)!r}, 'w').close()
    sys.exit(143)
signal.signal(signal.SIGTERM, stop)
print('work: begun', flush=True, file=sys.stderr)
while True: time.sleep(0.01)
"""
    with Jobs(started, answering_s=0.0) as jobs:
        jobs.submit(replace(task(program), moves=True), "ada")
        wait_until(lambda: newest(jobs).progress)
        before = set(threading.enumerate())
        jobs.cancel(newest(jobs).number)
        wait_until(lambda: set(threading.enumerate()) <= before)  # no timer kills it
        go.touch()
        wait_until(lambda: newest(jobs).state is JobState.CANCELLED)
    assert closed.exists()


def test_a_short_command_has_a_limit_of_time() -> None:
    assert run_command(("--version",), 0.0).code is None
    ran = run_command(("--nonsense",), 60.0)
    assert ran.code == 2 and "nonsense" in ran.output
