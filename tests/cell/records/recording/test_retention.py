"""Old recordings make room for new ones, and those that are marked stay."""

from __future__ import annotations

import json
import os
import time
from datetime import datetime, timedelta
from datetime import time as time_of_day
from pathlib import Path

import pytest

from cell.records.recording import form, retention
from cell.records.recording.retention import KEPT, Retention, recording_room
from cell.run.computer_check import check_room
from cell.settings.records import RecordingSettings


def limits(max_bytes=None, **others):
    """Only these; none of the settings' own."""
    size_gb = None if max_bytes is None else max_bytes / 1e9
    none = {"max_size_gb": size_gb, "min_free_gb": 0.0, "last_removed_every": 0}
    return RecordingSettings(**none | others)


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
    assert Retention(runs, limits(max_age_days=5.0, max_bytes=5000)).make_room() == ""
    assert days(runs) == [0, 1, 2, 3, 4]


def test_the_oldest_go_first(runs):
    assert Retention(runs, limits(max_bytes=2500)).make_room() == ""
    assert days(runs) == [3, 4]
    assert (runs / "cycle-0" / "result.json").exists()  # only frames go


def test_old_ones_go(runs):
    Retention(runs, limits(max_age_days=2.5)).make_room()
    assert days(runs) == [2, 3, 4]


def test_what_is_marked_stays(runs):
    (runs / "cycle-0" / KEPT).touch()
    Retention(runs, limits(max_bytes=2500)).make_room()
    assert days(runs) == [0, 4]


def test_what_was_recorded_since_counts(runs):
    kept = Retention(runs, limits(max_bytes=5000))
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

    monkeypatch.setattr(os, "statvfs", lambda path: Full)
    said = Retention(runs, limits(min_free_gb=1.0)).make_room()
    assert "recording.min_free_gb" in said
    assert days(runs) == []


def test_a_folder_that_is_not_there_yet(tmp_path):
    assert Retention(tmp_path / "runs", limits(max_bytes=1.0)).make_room() == ""


def test_one_that_is_finished_between_two_looks_counts(runs, monkeypatch):
    """Its recorder gives it its name after it was looked for, before its part is looked for."""
    kept = Retention(runs, limits(max_bytes=5000))
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
    kept = Retention(runs, limits(max_bytes=5000))
    kept.make_room()
    kept.add(runs / "cycle-9" / form.FILE)
    look = Path.exists
    monkeypatch.setattr(Path, "exists", lambda path: "cycle-9" in path.parts or look(path))
    assert kept.make_room() == ""
    assert days(runs) == [0, 1, 2, 3, 4]


def cycles(runs: Path, outcomes: dict[int, str], first: datetime, whole=()) -> None:
    """Recordings of 1000 bytes, an hour apart; those of `whole` with 5000 bytes of whole frames."""
    for number, outcome in outcomes.items():
        at = first + timedelta(hours=number)
        file = runs / f"{at:%Y%m%dT%H%M%S}.000-{number}" / form.FILE
        file.parent.mkdir(parents=True)
        (file.parent / "result.json").write_text(json.dumps({"outcome": outcome}))
        names = {form.FILE: 1000} | ({form.WHOLE: 5000} if number in whole else {})
        for name, size in names.items():
            file.with_name(name).write_bytes(bytes(size))
            os.utime(file.with_name(name), (at.timestamp(), at.timestamp()))


def numbers(runs: Path, name: str = form.FILE) -> list[int]:
    return sorted(int(p.parent.name.rpartition("-")[2]) for p in runs.glob(f"*/{name}"))


def test_what_somebody_will_ask_for_goes_last(tmp_path):
    """The first of each shift, what was not inserted, and every third."""
    outcomes = dict.fromkeys(range(1, 10), "inserted") | {2: "missed", 5: "failed"}
    cycles(tmp_path, outcomes, datetime.now() - timedelta(hours=20))
    Retention(tmp_path, limits(max_bytes=6000, last_removed_every=3)).make_room()
    assert numbers(tmp_path) == [2, 3, 5, 6, 8, 9]
    Retention(tmp_path, limits(max_bytes=3000, last_removed_every=3)).make_room()
    assert numbers(tmp_path) == [5, 6, 9]


def test_the_first_of_a_shift_goes_last(tmp_path):
    day = (datetime.now() - timedelta(days=2)).replace(hour=0, minute=0, second=0, microsecond=0)
    cycles(tmp_path, dict.fromkeys(range(1, 24), "inserted"), day)
    begins = tuple(time_of_day(hour, 30) for hour in (5, 13, 21))
    kept = Retention(tmp_path, limits(max_bytes=5000), begins)
    kept.make_room()
    assert numbers(tmp_path) == [1, 6, 14, 22, 23]


def test_whole_frames_go_before_any_recording(tmp_path):
    outcomes = dict.fromkeys(range(1, 6), "inserted") | {1: "missed", 2: "missed", 3: "failed"}
    cycles(tmp_path, outcomes, datetime.now() - timedelta(hours=20), whole=(1, 2, 3))
    kept = Retention(tmp_path, limits(max_bytes=11_000))
    kept.make_room()
    assert (numbers(tmp_path), numbers(tmp_path, form.WHOLE)) == ([1, 2, 3, 4, 5], [3])
    removed = list(tmp_path.glob(f"*/{form.REMOVED}"))
    assert removed == []  # the recordings are there still
    Retention(tmp_path, limits(max_bytes=5000)).make_room()
    assert (numbers(tmp_path), numbers(tmp_path, form.WHOLE)) == ([1, 2, 3, 4, 5], [])


def test_whole_frames_that_are_marked_stay(tmp_path):
    cycles(tmp_path, {1: "missed"}, datetime.now() - timedelta(hours=20), whole=(1,))
    for folder in tmp_path.iterdir():
        (folder / KEPT).touch()
    Retention(tmp_path, limits(max_bytes=1000)).make_room()
    assert numbers(tmp_path, form.WHOLE) == [1]


def test_whole_frames_are_removed_with_their_recording(tmp_path):
    cycles(tmp_path, {1: "missed"}, datetime.now() - timedelta(hours=20), whole=(1,))
    (folder,) = tmp_path.iterdir()
    retention.remove_recording(folder / form.FILE, "by Ada")
    assert {p.name for p in folder.iterdir()} == {"result.json", form.REMOVED}


def test_the_room_for_recordings_is_told_by_those_that_are_there(tmp_path, monkeypatch):
    class Disk:
        f_bavail, f_frsize = 10**6, 10**4  # 10 GB are free

    monkeypatch.setattr(os, "statvfs", lambda path: Disk)
    pixels = 1280 * 1024
    wanted = RecordingSettings(max_size_gb=2.0, min_free_gb=1.0)
    usual = recording_room(tmp_path, wanted, pixels)
    assert usual.bytes == usual.limit_bytes == 2e9
    assert usual.cycle_bytes == pytest.approx(17e6, rel=0.1)
    whole = recording_room(tmp_path, wanted.model_copy(update={"whole_frames": True}), pixels)
    assert whole.cycle_bytes == pytest.approx(460e6, rel=0.1)
    cycles(tmp_path, {1: "inserted", 2: "inserted"}, datetime.now() - timedelta(hours=5))
    for folder in tmp_path.iterdir():
        said = {"outcome": "inserted", "seconds": {"lower": 4.0, "execute": 5.0}}
        (folder / "result.json").write_text(json.dumps(said))
    for cycle, outcome in enumerate(("failed", "rehearsed", "rejected"), 3):  # other lengths
        cycles(tmp_path, {cycle: outcome}, datetime.now())
        for folder in tmp_path.glob(f"*-{cycle}"):
            said = {"outcome": outcome, "seconds": {"connect": 99.0}}
            (folder / "result.json").write_text(json.dumps(said))
            (folder / form.FILE).write_bytes(b"")
    there = recording_room(tmp_path, wanted, pixels)
    assert (there.cycle_bytes, there.cycle_s, there.cycles) == (1000, 9.0, 2_000_000)
    assert there.hours == pytest.approx(5000.0)
    assert check_room(there).met
    small = recording_room(tmp_path, wanted.model_copy(update={"max_size_gb": 20.0}), pixels)
    assert small.bytes == pytest.approx(9e9, rel=1e-5)
    assert not check_room(small).met
    assert "lower recording.max_size_gb to 9" in check_room(small).remedy
    assert check_room(None).met
