"""Keys at a real terminal: hold, go on, stop; the terminal left as it was; or closed."""

from __future__ import annotations

import json
import os
import pty
import select
import termios
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from cell.records.folder import read_record

from .forked import Forked, Forking

Start = Callable[..., Forked]

#: Opens the terminal as the controlling one of a new session, as a login shell does; for keys
#: only, or for what is printed too.
AT_TERMINAL = """
import os
os.setsid()
terminal = os.open({terminal!r}, os.O_RDWR)
for stream in {streams}:
    os.dup2(terminal, stream)
"""


class Run:
    """A `cell run` at a terminal of its own."""

    def __init__(self, start: Start, runs: Path, *options: str, streams: Sequence[int]) -> None:
        self.runs = runs
        self.master, self.slave = pty.openpty()
        self.before = termios.tcgetattr(self.slave)
        first = AT_TERMINAL.format(terminal=os.ttyname(self.slave), streams=streams)
        self.process = start("--json", "--runs", runs, *options, first=first)

    def hang_up(self) -> None:
        """Close the terminal, as its window or an ssh connection that is gone does."""
        os.close(self.master)
        self.master = os.open(os.devnull, os.O_RDWR)

    def press(self, key: bytes) -> None:
        os.write(self.master, key)

    def state(self) -> dict[str, Any]:
        for path in sorted(self.runs.glob("*/state.json"))[-1:]:
            state: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            return state
        return {}

    def until(self, holds: Callable[[dict[str, Any]], bool]) -> None:
        until_s = time.monotonic() + 120.0
        while not holds(self.state()):
            assert self.process.poll() is None, self.process.communicate(timeout=30)
            assert time.monotonic() < until_s, self.state()
            if select.select([self.master], [], [], 0.0)[0]:
                os.read(self.master, 4096)  # else whoever prints there would wait
            time.sleep(0.02)

    def end(self) -> tuple[int, list[dict[str, Any]]]:
        out, _ = self.process.communicate(timeout=120)
        return self.process.returncode, [json.loads(line) for line in out.splitlines()]


@pytest.fixture
def run(forking: Forking, quick_config: Path, tmp_path: Path) -> Iterator[Callable[..., Run]]:
    runs: list[Run] = []
    begin = partial(forking.start, "run", "-c", quick_config)

    def start(*options: str, streams: Sequence[int] = (0,)) -> Run:
        runs.append(Run(begin, tmp_path / "runs", *options, streams=streams))
        return runs[-1]

    yield start
    for one in runs:
        one.process.kill()
        one.process.wait(30)
        os.close(one.master)
        os.close(one.slave)


def is_held(state: dict[str, Any]) -> bool:
    return state.get("state") == "held"


def test_h_holds_between_motions_and_u_goes_on(run: Callable[..., Run]) -> None:
    it = run()
    it.until(lambda state: state.get("step") in ("connect", "warm_up"))
    it.press(b"h")
    it.until(is_held)
    assert it.state()["step"] == "start", "no cable is taken while it is held"
    it.press(b"x")
    time.sleep(0.5)
    assert is_held(it.state())
    it.press(b"u")
    it.until(lambda state: state.get("step") in ("grasp", "lower"))
    it.press(b"h")
    it.until(is_held)
    held_in = it.state()["step"]
    assert held_in in ("grasp", "choose"), "a swing is filmed to its end before it is held"
    it.press(b"u")
    code, (result,) = it.end()
    assert (code, result["outcome"]) == (0, "inserted")


def test_a_stop_while_held_stops_and_u_clears_nothing(run: Callable[..., Run]) -> None:
    it = run("--cycles", "3")
    it.until(lambda state: state.get("step") in ("connect", "warm_up"))
    assert not termios.tcgetattr(it.slave)[3] & termios.ECHO, "keys are not shown"
    it.press(b"h")
    it.until(is_held)
    it.press(b"\x03u")
    code, (result,) = it.end()
    assert code == 130
    assert (result["outcome"], result["fault"]["cause"]) == ("failed", "interrupted by a person")
    assert termios.tcgetattr(it.slave) == it.before


def test_a_closed_terminal_stops_the_arm_and_closes_the_record(run: Callable[..., Run]) -> None:
    it = run("--cycles", "50", streams=(0, 1, 2))
    it.until(lambda state: state.get("cycle", 0) >= 2 and state.get("step") == "lower")
    it.hang_up()
    it.process.communicate(timeout=60)
    assert it.process.returncode == 1
    record = read_record(max(it.runs.iterdir(), key=lambda f: int(f.name.rpartition("-")[2])))
    assert record.closed and record.state["state"] == "stopped"
    assert record.result is not None and record.result.fault is not None
    assert record.result.fault.cause == "the terminal was closed"
    assert record.result.fault.cable in ("a cable is in the jaws", "no cable is in the jaws")
    log = it.runs.with_name("runs.log").read_text(encoding="utf-8")
    assert f"the arm is stopped, {record.result.fault.cable}" in log
