"""Ids of the cables of a run."""

from __future__ import annotations

import io
from itertools import islice

import pytest

from cell.cli.arguments import LONGEST_ID, part_ids


@pytest.mark.parametrize(
    ("said", "ids"),
    [
        (None, [None, None, None]),
        ("A-09", ["A-09", "A-10", "A-11"]),
        ("99", ["99", "100", "101"]),
        ("A1-x", ["A1-x", "A1-x-2", "A1-x-3"]),
        (" Ä 7 ", ["Ä 7", "Ä 8", "Ä 9"]),
    ],
)
def test_the_last_digits_count_on(said: str | None, ids: list[str | None]) -> None:
    assert list(islice(part_ids(said), 3)) == ids


@pytest.mark.parametrize("said", ["", "  ", "a\nb", "x" * (LONGEST_ID + 1)])
def test_what_is_no_id_is_refused(said: str) -> None:
    with pytest.raises(ValueError, match="is no id"):
        part_ids(said)


def test_a_scanner_is_asked_again_and_ends_with_its_input(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("X1\n\nY 2\n"))
    assert list(part_ids("-")) == ["X1", "Y 2"]
    assert "scan it again" in capsys.readouterr().err
