"""Errors about the input are messages; others are faults of this program, and stay visible."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer

from cell.cli.shared import refusing
from cell.files.input_error import InputError
from cell.files.words import first_of


def test_an_error_that_our_code_raises_is_a_message(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as raised, refusing():
        raise InputError.at(Path("a.csv"), "is empty; give rows")
    assert raised.value.exit_code == 2
    assert capsys.readouterr().err == "a.csv:1: is empty; give rows\n"


def test_another_error_is_no_message() -> None:
    with pytest.raises(ValueError, match="empty"), refusing():
        max(list[int]())
    with pytest.raises(ValueError, match="could not convert"), refusing():
        first_of([str(float("x"))], 1)
