"""Ctrl-C and SIGTERM are answered once, and never where an exception would be lost."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from cell.__main__ import main
from cell.cli import app
from cell.cli.shared import answering, stoppable


@pytest.fixture(autouse=True)
def heard_again() -> Iterator[None]:
    former = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in former.items():
        signal.signal(number, handler)


def give(number: int) -> None:
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_knows_something_goes_on(number: int) -> None:
    with answering() as interrupted:
        assert not interrupted
        with pytest.raises(KeyboardInterrupt):
            give(number)
        give(number)
    assert interrupted and interrupted.code == 128 + number


def test_a_command_that_knows_nothing_ends(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as ended, answering():
        give(signal.SIGTERM)
    assert ended.value.exit_code == 128 + signal.SIGTERM
    assert "there are no results yet, and nothing was written" in capsys.readouterr().err


def test_what_is_asked_to_stop_is_not_interrupted() -> None:
    asked: list[int] = []
    with stoppable(lambda: asked.append(1)) as interrupted:
        give(signal.SIGTERM)
    assert (asked, interrupted.code) == ([1], 128 + signal.SIGTERM)


def test_the_compiler_comes_to_its_end() -> None:
    """In its callbacks an exception is dropped; it then failed, with a traceback."""
    compiler = {"__name__": "numba.core", "give": give, "time": time, "done": []}
    exec("def compiled():\n    give(15)\n    time.sleep(0.2)\n    done.append(1)", compiler)
    with answering() as interrupted, pytest.raises(KeyboardInterrupt):
        compiler["compiled"]()  # type: ignore[operator]
        time.sleep(5.0)
    assert compiler["done"] == [1]
    assert interrupted


def interrupted(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_a_command_without_an_answer_says_that_it_was_interrupted(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("cell.settings.load_settings", interrupted)
    done = CliRunner().invoke(app, ["check", "--config", str(tmp_path / "cell.yaml")])
    assert (done.exit_code, done.stderr) == (130, "interrupted\n")


def test_while_its_words_are_read_a_command_says_so_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cell.cli.about", interrupted)
    done = CliRunner().invoke(app, ["--version"])
    assert (done.exit_code, done.stderr) == (130, "interrupted\n")


def test_before_there_is_a_command_one_line_is_said_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("cell.cli.main", interrupted)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_an_input_that_ends_before_an_answer_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As by Ctrl-D in a question of `init`: nothing is written."""
    monkeypatch.setattr("cell.cli.settings._is_interactive", lambda: True)
    done = CliRunner().invoke(app, ["init", "-o", str(tmp_path / "cell.yaml")], input="")
    assert done.exit_code == 2
    assert "the input ended before an answer: nothing is done" in done.stderr
    assert list(tmp_path.iterdir()) == []
