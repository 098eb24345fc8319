"""Who computes ahead gives way to vision until the last frame, and then to nobody."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from types import SimpleNamespace

from cell.computer.second_process import SecondProcess
from cell.run.commands import Commands
from cell.run.early_estimate import EarlyEstimator
from cell.run.findings import Filming


class Noting(SecondProcess):
    """Does nothing, and notes when it is hurried."""

    def __init__(self) -> None:
        super().__init__()
        self.noted: list[str] = []

    @contextmanager
    def hurried(self) -> Iterator[None]:
        self.noted.append("hurries")
        yield
        self.noted.append("gives way")


def test_the_hand_waits_for_a_process_that_hurries() -> None:
    computer = Noting()
    station = SimpleNamespace(computer=computer, commands=Commands())
    estimator = EarlyEstimator(station, Filming(0.0, 0.0, 1.0, 10))
    assert estimator.result() is None
    assert computer.noted == []
    job: Future[object] = Future()
    computer.noted.append("asked")
    job.set_result("estimate")
    estimator._second = job
    assert estimator.result() == "estimate"
    assert computer.noted == ["asked", "hurries", "gives way"]
