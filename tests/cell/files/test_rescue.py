"""What cannot be written where it should be is kept elsewhere, and told of."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from cell.files.atomic import write_atomic
from cell.files.rescue import write_or_rescue


def test_a_file_that_can_be_written_needs_no_words(tmp_path: Path) -> None:
    assert write_or_rescue(tmp_path / "a.txt", lambda path: write_atomic(path, "all")) == ""
    assert (tmp_path / "a.txt").read_text() == "all"


def test_what_has_no_room_is_kept_in_the_folder_of_temporary_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full, temporary = tmp_path / "full", tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))

    def write(path: Path) -> None:
        if path.parent == full:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write_atomic(path, "all")

    told = write_or_rescue(full / "a.txt", write)
    (copy,) = temporary.glob("*/a.txt")
    assert copy.read_text() == "all"
    assert told == (
        f"{full / 'a.txt'}: cannot be written: No space left on device; it is kept as {copy}: "
        "copy it from there"
    )


def test_where_no_file_has_room_the_remedy_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, full_disk: None
) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    told = write_or_rescue(tmp_path / "a.txt", lambda path: write_atomic(path, "x" * 5000))
    assert told.endswith("make room there, or name another disk, and give the command again")
    assert list(tmp_path.iterdir()) == [temporary]
    assert list(temporary.iterdir()) == []
