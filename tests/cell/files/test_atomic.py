"""Files are whole or not there: whatever fails, the former one is left and nothing beside it."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from cell.files.atomic import write_all, write_atomic, write_new


def test_a_file_is_made_with_its_folders_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "file.txt"
    write_atomic(path, "é\n")
    assert path.read_bytes() == b"\xc3\xa9\n"
    write_atomic(path, b"\x00")
    assert path.read_bytes() == b"\x00"
    assert list(path.parent.iterdir()) == [path]


def test_a_disk_without_room_leaves_the_former_file(tmp_path: Path, full_disk: None) -> None:
    path = tmp_path / "file.txt"
    write_atomic(path, "former")
    with pytest.raises(OSError, match="too large"):
        write_atomic(path, "x" * 5000)
    assert path.read_text() == "former"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "file")
    write_atomic(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "file").read_text() == "new"


def test_rights_are_those_of_any_new_file(tmp_path: Path) -> None:
    write_atomic(tmp_path / "file", "")
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


def test_who_may_read_a_file_stays_so(tmp_path):
    """Settings may hold a password."""
    path = tmp_path / "settings.yaml"
    path.write_text("former")
    path.chmod(0o600)
    write_atomic(path, "new")
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == 0o600


def test_two_threads_write_one_file(tmp_path, monkeypatch):
    """One begins while the other has written its part and has not put it in its place."""
    path, replace = tmp_path / "state.json", Path.replace

    def beside(part, target):
        monkeypatch.setattr(Path, "replace", replace)
        other = threading.Thread(target=write_atomic, args=(path, "of the other"))
        other.start()
        other.join()
        return replace(part, target)

    monkeypatch.setattr(Path, "replace", beside)
    write_atomic(path, "of the first")
    assert path.read_text() == "of the first"
    assert [p.name for p in tmp_path.iterdir()] == ["state.json"]
