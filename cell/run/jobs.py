"""Waiting for what the second process computes."""

from __future__ import annotations

from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import AbstractContextManager, nullcontext
from typing import TypeVar

from cell.computer.second_process import SecondProcess
from cell.run.commands import Commands
from cell.run.waiting import POLL_S

Value = TypeVar("Value")

#: A computation that takes longer has failed, s.
LONGEST_S = 5.0


def found_by(job: Future[Value], commands: Commands) -> Value | None:
    """What a job found; None if its process was killed or hangs, which only costs time.

    raises  InterruptedByCommandError
    """
    for _ in range(round(LONGEST_S / POLL_S)):
        commands.check()
        try:
            return job.result(POLL_S)
        except TimeoutError:
            if job.done():  # it is the job's own
                raise
        except BrokenExecutor:
            return None
    return None


def hurried(computer: Executor) -> AbstractContextManager[None]:
    """While the hand or a frame waits for the second process it need not give way."""
    return computer.hurried() if isinstance(computer, SecondProcess) else nullcontext()
