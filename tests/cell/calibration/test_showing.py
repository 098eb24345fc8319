"""Who shows the board to a camera: nobody at a terminal is said, not guessed."""

from __future__ import annotations

import pytest

from calib.errors import CalibrationError
from cell.calibration.showing import Person


def test_nobody_at_the_terminal_is_an_error_with_its_remedy() -> None:
    def nobody(words: str) -> str:
        raise EOFError

    person = Person(nobody)
    for question in (lambda: person.board(3, ""), person.thread, person.clear):
        with pytest.raises(CalibrationError, match=r"somebody must act: .*--from a folder"):
            question()


def test_an_answer_with_n_is_no_plumb_line() -> None:
    assert Person(lambda words: "").thread()
    assert not Person(lambda words: " No").thread()
