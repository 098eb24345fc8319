"""Files are whole or not there: whatever fails, the former one is left and nothing beside it."""

from __future__ import annotations

from pathlib import Path

import pytest

from cell.files.atomic import write_all, write_new, write_whole


def test_a_file_is_made_with_its_folders_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "file.txt"
    write_whole(path, "é\n")
    assert path.read_bytes() == b"\xc3\xa9\n"
    write_whole(path, b"\x00")
    assert path.read_bytes() == b"\x00"
    assert list(path.parent.iterdir()) == [path]


def test_a_disk_without_room_leaves_the_former_file(tmp_path: Path, full_disk: None) -> None:
    path = tmp_path / "file.txt"
    write_whole(path, "former")
    with pytest.raises(OSError, match="too large"):
        write_whole(path, "x" * 5000)
    assert path.read_text() == "former"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "file")
    write_whole(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "file").read_text() == "new"


def test_rights_are_those_of_any_new_file(tmp_path: Path) -> None:
    write_whole(tmp_path / "file", "")
    (tmp_path / "other").write_text("")
    assert (tmp_path / "file").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_of_several_files_all_are_written_or_none(tmp_path: Path, full_disk: None) -> None:
    first, second = tmp_path / "new" / "first.txt", tmp_path / "second.txt"
    write_all({second: "former"})
    with pytest.raises(OSError, match="too large") as caught:
        write_all({first: "new", second: "x" * 5000})
    assert caught.value.filename == str(second)
    assert [p.name for p in tmp_path.iterdir()] == ["second.txt"]
    assert second.read_text() == "former"


def test_a_new_file_is_whole_and_takes_nobodys_place(tmp_path: Path, full_disk: None) -> None:
    path = tmp_path / "file.txt"
    with pytest.raises(OSError, match="too large"):
        write_new(path, "x" * 5000)
    assert list(tmp_path.iterdir()) == []
    write_new(path, "first")
    with pytest.raises(FileExistsError):
        write_new(path, "second")
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]
