"""Without a terminal of its own the keyboard reads nothing, and harms nothing."""

from __future__ import annotations

import io
import os
import pty
import sys
import termios
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

import pytest

from cell.terminal.keyboard import Keyboard


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
