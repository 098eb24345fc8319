"""Old recordings make room for new ones, and those that are marked stay."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from cell.records.recording import form, retention
from cell.records.recording.retention import KEPT, DiskRoom, Retention


@pytest.fixture
def runs(tmp_path):
    """Five recordings of 1000 bytes, one a day, the newest of now."""
    for day in range(5):
        file = tmp_path / f"cycle-{day}" / form.FILE
        file.parent.mkdir()
        file.write_bytes(bytes(1000))
        (file.parent / "result.json").write_text("{}")
        written_s = time.time() - (4 - day) * 86_400.0
        os.utime(file, (written_s, written_s))
    return tmp_path


def days(runs):
    return sorted(int(p.parent.name[-1]) for p in runs.glob(f"*/{form.FILE}"))


def test_nothing_is_removed_within_the_limits(runs):
    assert Retention(runs, DiskRoom(max_age_s=5 * 86_400.0, max_bytes=5000)).make_room() == ""
    assert days(runs) == [0, 1, 2, 3, 4]


def test_the_oldest_go_first(runs):
    assert Retention(runs, DiskRoom(max_bytes=2500)).make_room() == ""
    assert days(runs) == [3, 4]
    assert (runs / "cycle-0" / "result.json").exists()  # only frames go


def test_old_ones_go(runs):
    Retention(runs, DiskRoom(max_age_s=2.5 * 86_400.0)).make_room()
    assert days(runs) == [2, 3, 4]


def test_what_is_marked_stays(runs):
    (runs / "cycle-0" / KEPT).touch()
    Retention(runs, DiskRoom(max_bytes=2500)).make_room()
    assert days(runs) == [0, 4]


def test_what_was_recorded_since_counts(runs):
    kept = Retention(runs, DiskRoom(max_bytes=5000))
    kept.make_room()
    new = runs / "cycle-9" / form.FILE
    new.parent.mkdir()
    new.write_bytes(bytes(1500))
    kept.add(new)
    kept.make_room()
    assert days(runs) == [2, 3, 4, 9]


def test_without_free_room_all_goes_and_it_says_so(runs, monkeypatch):
    class Full:
        f_bavail, f_frsize = 100, 4096

    monkeypatch.setattr(retention.os, "statvfs", lambda path: Full)
    said = Retention(runs, DiskRoom(min_free_bytes=1e9)).make_room()
    assert "recording.min_free_gb" in said
    assert days(runs) == []


def test_a_folder_that_is_not_there_yet(tmp_path):
    assert Retention(tmp_path / "runs", DiskRoom(max_bytes=1.0)).make_room() == ""


def test_one_that_is_finished_between_two_looks_counts(runs, monkeypatch):
    """Its recorder gives it its name after it was looked for, before its part is looked for."""
    kept = Retention(runs, DiskRoom(max_bytes=5000))
    kept.make_room()
    new = runs / "cycle-9" / form.FILE
    new.parent.mkdir()
    part = new.with_name(form.PART)
    part.write_bytes(bytes(1500))
    kept.add(new)
    look = Path.exists

    def finished_after(path):
        found = look(path)
        if path in (new, part) and look(part):
            part.rename(new)
        return found

    with monkeypatch.context() as between:
        between.setattr(Path, "exists", finished_after)
        kept.make_room()
    kept.make_room()
    assert days(runs) == [2, 3, 4, 9]


def test_one_that_is_brought_to_a_store_meanwhile_is_left_out(runs, monkeypatch):
    """It was there when it was looked for."""
    kept = Retention(runs, DiskRoom(max_bytes=5000))
    kept.make_room()
    kept.add(runs / "cycle-9" / form.FILE)
    look = Path.exists
    monkeypatch.setattr(Path, "exists", lambda path: "cycle-9" in path.parts or look(path))
    assert kept.make_room() == ""
    assert days(runs) == [0, 1, 2, 3, 4]
