"""Who shows the board to a camera: nobody at a terminal is said, not guessed."""

from __future__ import annotations

import pytest

from calib.errors import CalibrationError
from cell.calibration.assistants import Operator


def test_nobody_at_the_terminal_is_an_error_with_its_remedy() -> None:
    def nobody(words: str) -> str:
        raise EOFError

    person = Operator(nobody)
    for question in (
        lambda: person.board(3, ""),
        lambda: person.thread(1),
        person.cable,
        person.clear,
    ):
        with pytest.raises(CalibrationError, match=r"somebody must act: .*--from a folder"):
            question()


def test_a_plumb_line_is_asked_for_at_another_place_until_there_is_none() -> None:
    asked: list[str] = []

    def answer(words: str) -> str:
        asked.append(words)
        return " No" if len(asked) == 2 else ""

    person = Operator(answer)
    assert [person.thread(1), person.thread(2)] == [True, False]
    assert "another place" in asked[1]
    assert "another place" not in asked[0]


def test_nobody_has_to_have_a_cable() -> None:
    assert Operator(lambda words: "").cable() is True
    assert Operator(lambda words: "n").cable() is False
