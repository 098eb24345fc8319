"""Without a terminal of its own the keyboard reads nothing, and harms nothing."""

from __future__ import annotations

import io
import os
import pty
import sys
import termios
import time
import tty
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import TextIO

import pytest

from cell.cli.keyboard import Keyboard


def refuse(key: str) -> None:
    raise AssertionError(f"key {key}")


def a_file(tmp_path: Path) -> TextIO:
    path = tmp_path / "keys"
    path.write_text("hhhh")
    return path.open()


@pytest.mark.parametrize(
    "stdin", [a_file, lambda tmp_path: io.StringIO("hhhh"), lambda tmp_path: None]
)
def test_nothing_is_read_without_a_terminal(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, stdin: Callable[[Path], TextIO | None]
) -> None:
    stream = stdin(tmp_path)
    monkeypatch.setattr(sys, "stdin", stream)
    with Keyboard(refuse) as keyboard:
        assert not keyboard.listens
    if stream is not None:
        assert stream.read() == "hhhh"
        stream.close()


def test_a_terminal_of_another_session_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    master, slave = pty.openpty()
    before = termios.tcgetattr(slave)
    os.write(master, b"h\n")
    with open(slave, closefd=False) as stream:  # a descriptor, not a path
        monkeypatch.setattr(sys, "stdin", stream)
        with Keyboard(refuse) as keyboard:
            assert not keyboard.listens
            assert termios.tcgetattr(slave) == before
        assert stream.readline() == "h\n"
    os.close(slave)
    os.close(master)


def test_keys_that_waited_while_the_process_was_halted_are_dropped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`u` went on with a cycle as soon as the process did."""
    master, slave = pty.openpty()
    pressed: list[str] = []
    times_s = [0.0, 1.5]  # before the wait for the first key, and after it
    clock = SimpleNamespace(monotonic=lambda: times_s.pop(0) if times_s else 2.0)
    monkeypatch.setattr("cell.cli.keyboard.time", clock)
    monkeypatch.setattr("cell.cli.keyboard.is_in_foreground", lambda descriptor: True)
    with open(slave, closefd=False) as stream:  # a descriptor, not a path
        monkeypatch.setattr(sys, "stdin", stream)
        tty.setcbreak(slave)
        os.write(master, b"u")
        with Keyboard(pressed.append):
            until_s = time.monotonic() + 10.0
            while not pressed and time.monotonic() < until_s:
                if not times_s:
                    os.write(master, b"h")
                time.sleep(0.02)
    os.close(slave)
    os.close(master)
    assert set(pressed) == {"h"}
