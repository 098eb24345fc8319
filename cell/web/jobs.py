"""Queue of the lab's computations for the pages: commands as child processes, one at a time.

A page's own process computes nothing.  A job consists of commands that a person could type, too.
Its progress is their output on the error stream, its results are the files they write.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import IO, Any

from cell.computer.watched import FIT_ERROR, PROGRESS_VARIABLE
from cell.files.atomic import write_atomic
from drivers.threads import GuardedThread, error_text

#: The command that moves the arm.
MOVING = "run"
#: Largest number of waiting jobs, and of ended jobs that are kept, the newest.
MOST_WAITING, REMEMBERED = 5, 12
#: Largest number of stored lines of a job's output, and of characters of a line.
MOST_LINES, LONGEST_LINE = 400, 2000
#: Time for a cancelled command to print its results so far, s.
ANSWERING_S = 35.0
#: Interval of progress messages, s.
_PROGRESS_S = 0.5
_COUNTED = re.compile(r"\b(\d+) of (\d+)\b")


class JobState(StrEnum):
    """State of a job."""

    QUEUED = "queued"
    RUNNING = "running"
    CANCELLING = "cancelling"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


#: States of jobs that have not ended.
OPEN = frozenset({JobState.QUEUED, JobState.RUNNING, JobState.CANCELLING})


@dataclass(frozen=True)
class JobTask:
    """A task to be run as a job.

    title     in English, marked for the catalogues
    subject   its study or file
    commands  words after `cell`, of each command; they are run in this order
    good      exit codes of success
    log       file for the output of the last command; None = not stored
    moves     the arm moves: it begins at once or not at all, and is only killed on request
    """

    title: str
    subject: str
    commands: tuple[tuple[str, ...], ...]
    good: frozenset[int] = frozenset({0})
    log: Path | None = None
    moves: bool = False

    @property
    def typed(self) -> str:
        """The commands as a person types them, a line each."""
        return "\n".join(shlex.join(["cell", *words]) for words in self.commands)


@dataclass(frozen=True)
class Job:
    """Present state of a job.

    by        user who submitted it
    step      of its commands, from 0
    progress  current activity
    share     completed share of the current part; None = cannot be counted
    output    newest lines of the error stream, without progress
    printed   newest lines of the standard output
    errors    of the models that the command has fitted: `effects`, `rms_m`, `noise_m`
    ended_s   Unix time; None = has not
    """

    number: int
    task: JobTask
    by: str
    state: JobState = JobState.QUEUED
    step: int = 0
    progress: str = ""
    share: float | None = None
    output: tuple[str, ...] = ()
    printed: tuple[str, ...] = ()
    errors: tuple[Mapping[str, Any], ...] = ()
    ended_s: float | None = None


@dataclass(frozen=True)
class CompletedCommand:
    """A command that was run at once: its exit code, None = time limit exceeded; its output."""

    code: int | None
    printed: str
    output: str


def child(words: Sequence[str]) -> subprocess.Popen[str]:
    """Start a command of the cell in a process group of its own, at lower priority.

    A command that moves the arm has the normal priority.
    """
    nice = None if words[0] == MOVING else shutil.which("nice")
    before = [] if nice is None else [nice, "-n", "10"]
    return subprocess.Popen(
        [*before, sys.executable, "-m", "cell", *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        encoding="utf-8",
        errors="replace",
        start_new_session=True,
        env={**os.environ, PROGRESS_VARIABLE: str(_PROGRESS_S), "COLUMNS": "100"},
    )


def end(process: subprocess.Popen[str]) -> None:
    """End a child and its own child processes."""
    _kill_group(process)
    process.wait()


def _kill_group(process: subprocess.Popen[str]) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def run_command(words: Sequence[str], within_s: float) -> CompletedCommand:
    """Run a short command at once, not as a job; it is ended after `within_s`."""
    process = child(words)
    try:
        printed, errors = process.communicate(timeout=within_s)
    except subprocess.TimeoutExpired:
        end(process)
        process.communicate()
        return CompletedCommand(None, "", "")
    most = MOST_LINES * LONGEST_LINE
    return CompletedCommand(process.returncode, printed[:most], errors[:most])


#: Starts a command, given by its words, in a process group of its own.
Start = Callable[[Sequence[str]], "subprocess.Popen[str]"]


class Jobs:
    """A queue of jobs and the thread that runs them; all pages of a server share it.

    Use it as a context: its end cancels the running job.

    start        starts a command
    answering_s  time for a cancelled command to print its results so far
    """

    def __init__(self, start: Start = child, answering_s: float = ANSWERING_S) -> None:
        self._start, self._answering_s = start, answering_s
        self._changed = threading.Condition()
        self._jobs: dict[int, Job] = {}  # the oldest first
        self._process: subprocess.Popen[str] | None = None
        self._closed = False
        self._numbers = 0
        self._version = 0
        self._thread: threading.Thread | None = None

    @property
    def version(self) -> int:
        """Number that grows with every change of a job, so that pages detect changes."""
        return self._version

    @property
    def moves(self) -> bool:
        """Whether a job that moves the arm has not ended."""
        return any(j.task.moves and j.state in OPEN for j in self.listed())

    def listed(self) -> tuple[Job, ...]:
        """All stored jobs, the newest first."""
        with self._changed:
            return tuple(reversed(self._jobs.values()))

    def submit(self, task: JobTask, by: str) -> str:
        """Put a job in the queue; reason of a refusal, or ""."""
        with self._changed:
            waiting = [j for j in self._jobs.values() if j.state is JobState.QUEUED]
            if self._closed:
                return "the server is ending"
            if len(waiting) >= MOST_WAITING:
                return f"{MOST_WAITING} jobs wait already: cancel one, or wait for an end"
            if any(j.task == task and j.state in OPEN for j in self._jobs.values()):
                return "this is being done already: wait for its end"
            if task.moves and any(j.state in OPEN for j in self._jobs.values()):
                return "the gripper must move when you say so: wait until the job at work has ended"
            if any(j.task.moves and j.state in OPEN for j in self._jobs.values()):
                return "a cable is being measured: wait for its end"
            self._numbers += 1
            self._put(Job(self._numbers, task, by))
            ended = [j.number for j in self._jobs.values() if j.state not in OPEN]
            for number in ended[: max(0, len(self._jobs) - REMEMBERED)]:
                del self._jobs[number]
            if self._thread is None:
                self._thread = GuardedThread("lab jobs", self._work, self._died)
                self._thread.start()
        return ""

    def cancel(self, number: int) -> str:
        """Cancel a job, the second time at once; reason of a refusal, or ""."""
        with self._changed:
            job = self._jobs.get(number)
            if job is None or job.state not in OPEN:
                return "this job has ended"
            process = self._process
            if job.state is JobState.QUEUED:
                self._put(replace(job, state=JobState.CANCELLED, ended_s=time.time()))
            elif job.state is JobState.RUNNING:
                self._put(replace(job, state=JobState.CANCELLING))
                if process is not None:
                    process.send_signal(signal.SIGTERM)  # as Ctrl-C, and never ignored
                    if not job.task.moves:
                        self._kill_later(process)
            elif process is not None:
                _kill_group(process)
        return ""

    def __enter__(self) -> Jobs:
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._closed = True
            for job in self._jobs.values():
                if job.state is JobState.QUEUED:
                    self._put(replace(job, state=JobState.CANCELLED, ended_s=time.time()))
            if self._process is not None:
                moves = any(j.task.moves and j.state in OPEN for j in self._jobs.values())
                if moves:  # it stops the arm, and closes its record
                    self._process.send_signal(signal.SIGTERM)
                else:
                    _kill_group(self._process)
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(10.0)

    def _change(self, number: int, **values: Any) -> None:
        with self._changed:
            self._put(replace(self._jobs[number], **values))

    def _put(self, job: Job) -> None:
        self._jobs[job.number] = job
        self._version += 1
        self._changed.notify_all()

    def _kill_later(self, process: subprocess.Popen[str]) -> None:
        def kill() -> None:
            with self._changed:
                if self._process is process:
                    _kill_group(process)

        timer = threading.Timer(self._answering_s, kill)
        timer.daemon = True
        timer.start()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._next() is not None)
                job = self._next()
                if self._closed or job is None:
                    return
                self._put(replace(job, state=JobState.RUNNING))
            self._run(job.number)

    def _died(self, error: BaseException) -> None:
        """Mark open jobs as failed; the next job starts a new thread."""
        with self._changed:
            if self._process is not None:
                end(self._process)
            for job in self._jobs.values():
                if job.state in OPEN:
                    last = (*job.output, error_text(error))[-MOST_LINES:]
                    self._put(replace(job, state=JobState.FAILED, output=last, ended_s=time.time()))
            self._process = self._thread = None

    def _next(self) -> Job | None:
        return next((j for j in self._jobs.values() if j.state is JobState.QUEUED), None)

    def _run(self, number: int) -> None:
        task = self._jobs[number].task
        code: int | None = None  # of the last command; None = it was not begun
        for step, words in enumerate(task.commands):
            code = None
            with self._changed:
                job = self._jobs[number]
                if job.state is JobState.CANCELLING:
                    break
                begun = replace(job, step=step, progress="", share=None, printed=(), errors=())
                self._put(begun)
            code = self._command(number, words)
            if code not in task.good:
                break
        with self._changed:
            job = self._jobs[number]
            state = JobState.DONE if code in task.good else JobState.FAILED
            if job.state is JobState.CANCELLING and code != 0:
                state = JobState.CANCELLED
        if task.log is not None and job.printed:
            with suppress(OSError):
                write_atomic(task.log, "\n".join(job.printed) + "\n")
        self._change(number, state=state, progress="", share=None, ended_s=time.time())

    def _command(self, number: int, words: Sequence[str]) -> int:
        """Run a command to its end; its exit code."""
        try:
            process = self._start(words)
        except OSError as error:
            self._add_output(number, str(error), progress=False)
            return -1
        with self._changed:
            self._process = process
            if self._closed or self._jobs[number].state is JobState.CANCELLING:
                end(process)
        assert process.stdout is not None and process.stderr is not None
        printing = GuardedThread(
            "lab output",
            partial(self._read_printed, number, process.stdout),
            lambda _: end(process),
        )
        with process.stdout, process.stderr:
            printing.start()
            begins = f"{words[0]}: "
            for line in _lines(process.stderr):
                if line.startswith(FIT_ERROR):
                    self._add_error(number, line.removeprefix(FIT_ERROR))
                else:
                    self._add_output(
                        number, line.removeprefix(begins), progress=line.startswith(begins)
                    )
            printing.join()
        code = process.wait()
        with self._changed:
            self._process = None
        end(process)  # remaining child processes
        return code

    def _add_output(self, number: int, line: str, *, progress: bool) -> None:
        if not progress:
            self._change(number, output=(*self._jobs[number].output, line)[-MOST_LINES:])
            return
        counted = _COUNTED.search(line)
        share = None if counted is None else int(counted[1]) / max(1, int(counted[2]))
        self._change(number, progress=line, share=share)

    def _add_error(self, number: int, text: str) -> None:
        errors = (*self._jobs[number].errors, json.loads(text))
        self._change(number, errors=errors[-MOST_LINES:])

    def _read_printed(self, number: int, stream: IO[str]) -> None:
        self._change(number, printed=tuple(deque(_lines(stream), MOST_LINES)))


def _lines(stream: IO[str]) -> Iterator[str]:
    """Lines of a stream, cut at a largest length to limit memory."""
    with stream:
        while line := stream.readline(LONGEST_LINE):
            yield line.rstrip("\n")
