"""Jobs that workers of every kind can import."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cell.cable.solver import threads


def square(number: float) -> tuple[float, float]:
    """Sums in an order that another number of threads would change."""
    rng = np.random.default_rng(int(number))
    matrix = rng.standard_normal((80, 80))
    return number**2, float((matrix @ matrix.T).sum())


def odd_fails(number: int) -> int:
    if number % 2:
        raise ZeroDivisionError(f"of {number}")
    return number


class SpecialError(Exception):
    """Pickled with one argument, it cannot be made again."""

    def __init__(self, place: str, line: int) -> None:
        super().__init__(f"{place}:{line}")


def fails_specially(number: int) -> int:
    raise SpecialError("here", number)


@dataclass
class Counter:
    """A function that changes itself."""

    calls: list[int] = field(default_factory=list)

    def __call__(self, number: int) -> int:
        self.calls.append(number)
        return len(self.calls)


@dataclass(frozen=True)
class EndsOnce:
    """Ends the first process that does a certain job; every job leaves its process's number."""

    folder: Path
    deadly: int

    def __call__(self, number: int) -> tuple[float, float]:
        (self.folder / str(os.getpid())).touch()
        killed = self.folder / "killed"
        if number == self.deadly and not killed.exists():
            killed.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return square(number)


def ends_always(number: int) -> int:
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def slowly(number: int) -> int:
    time.sleep(0.05)
    return number


def cores(number: int) -> int:
    return threads()


def value_of(effect: type) -> tuple[type, str, str]:
    """An effect itself, with its file's name and a number of its law."""
    assert effect.file is not None
    return effect, effect.name, effect.file.sha256
