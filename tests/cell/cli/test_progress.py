"""What is said of work under way: pieces, time so far, time left; off a terminal too."""

import io
import json

import pytest
from rich.console import Console

from cell.cli import progress
from cell.cli.progress import MOST_BARS, ProgressLine, Ticker, error_sparkline
from cell.computer.watched import FIT_ERROR, PROGRESS_VARIABLE
from cell.lab.data.work import ModelError


def line_of(console_is_terminal: bool = False):
    clock = [100.0]
    console = Console(file=io.StringIO(), force_terminal=console_is_terminal)
    return clock, ProgressLine("diagnose", console, lambda: clock[0])


def test_the_time_left_is_that_of_the_part_under_way() -> None:
    clock, line = line_of()
    assert line.line() == "diagnose: at work, 0 s so far"
    clock[0] += 50.0
    line("refitted with tip_mass", 0, 8)
    clock[0] += 10.0
    line("refitted with air_drag", 2, 8)
    assert line.line() == (
        "diagnose: refitted with air_drag, 2 of 8, 1 min 0 s so far, about 30 s left of this part"
    )
    line("refitted with air_drag", 1, 5)  # a new part begins
    clock[0] += 3.0
    assert line.line().endswith("1 of 5, 1 min 3 s so far")
    line("refitted with draught", 2, 5)
    assert line.line().endswith("2 of 5, 1 min 3 s so far, about 9 s left of this part")


def test_the_time_left_of_few_pieces_never_grows() -> None:
    """Two own effects took longer than the rest: "1 min left" became 5 while one was waited for."""
    clock, line = line_of()
    line("refitting", 0, 10)
    clock[0] += 30.0
    line("refitted with tip_mass", 5, 10)
    assert "about 30 s left" in line.line()
    clock[0] += 20.0
    assert "about 10 s left" in line.line(), "the same piece, 20 s later"
    line("refitted with air_drag", 6, 10)  # 50 s for six: 83 s in all, thought were 60
    for _ in range(3):
        assert line.line().endswith("this part: longer than thought")
        clock[0] += 20.0
    line("refitted with draught", 9, 10)
    assert line.line().endswith("this part: longer than thought")
    line("refitting with another effect", 0, 9)
    clock[0] += 9.0
    line("refitted with draught", 1, 9)
    assert line.line().endswith("about 1 min 12 s left of this part")
    clock[0] += 5.0
    line("refitted with tip_mass", 3, 9)  # faster than thought
    assert line.line().endswith("about 28 s left of this part")


def test_the_time_left_of_many_pieces_is_what_they_take() -> None:
    """Of 1,000 recordings it was "longer than thought" from the 78th on, at a steady pace."""
    clock, line = line_of()
    line("identifying", 0, 1000)
    clock[0] += 10.0
    line("identifying", 10, 1000)
    assert "about 16 min 30 s left" in line.line()
    clock[0] += 50.0
    line("identifying", 30, 1000)
    assert line.line().endswith("30 of 1000, 1 min 0 s so far, about 32 min 20 s left of this part")


def test_off_a_terminal_a_line_is_printed_at_every_tick(capsys) -> None:
    asked = []

    def wait(seconds: float) -> bool:
        asked.append(seconds)
        return len(asked) > 2

    Ticker(lambda: f"at work {len(asked)}", 10.0, wait).stop()
    ticker = Ticker(lambda: "", 10.0, wait)  # nothing to say, nothing printed
    ticker.stop()
    assert set(asked) == {10.0}
    out, err = capsys.readouterr()
    assert out == ""
    assert set(err.splitlines()) <= {"at work 1", "at work 2"}


@pytest.mark.parametrize(
    ("asked", "every_s"), [("0.5", 0.5), ("0", 0.1), ("nan", 0.1), ("soon", None)]
)
def test_whoever_starts_a_command_may_ask_for_more_lines(monkeypatch, asked, every_s) -> None:
    monkeypatch.setenv(PROGRESS_VARIABLE, asked)
    waited = []

    def wait(seconds: float) -> bool:
        waited.append(seconds)
        return True

    Ticker(lambda: "", None, wait).stop()
    assert waited == [every_s or progress.EVERY_S]


def test_a_line_off_a_terminal_names_command_and_piece(capsys) -> None:
    _, line = line_of()
    with line:
        line("fitting", 1, 3)
    assert capsys.readouterr().err == "", "work of less than ten seconds is not spoken of"


def test_the_error_falls_behind_the_line_of_a_terminal():
    errors = [
        ModelError((), 1e-3, 1e-4),
        ModelError(("a",), 3e-4, 1e-4),
        ModelError(("b",), 1e-4, 1e-4),
    ]
    assert error_sparkline(errors) == "█▄▁"
    assert len(error_sparkline(errors * 20)) == MOST_BARS
    shown = ProgressLine("diagnose", Console(file=io.StringIO(), force_terminal=True))
    for error in errors:
        shown.watch(error)
    assert shown.line().endswith("  █▄▁")


def test_the_error_goes_to_whoever_asked_for_lines(monkeypatch, capsys):
    monkeypatch.setenv(PROGRESS_VARIABLE, "5")
    with ProgressLine("diagnose", Console(file=io.StringIO())) as shown:
        shown.watch(ModelError(("a",), 3e-4, 1e-4))
    (line,) = capsys.readouterr().err.splitlines()
    said = {"effects": ["a"], "rms_m": 3e-4, "noise_m": 1e-4}
    assert line.startswith(FIT_ERROR) and json.loads(line.removeprefix(FIT_ERROR)) == said
