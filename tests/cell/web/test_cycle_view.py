"""A cycle's page: what is known of it, and frames that are served from memory."""

from __future__ import annotations

import os
from datetime import datetime
from pathlib import Path

import pytest

from cell.records.folder import Record
from cell.records.recording import form
from cell.records.recording.writer import RecordingWriter
from cell.records.result import Outcome, Result
from cell.web import camera as films_module
from cell.web.camera import Films, LiveCamera
from cell.web.cycle_view import cycle_view, tip_chart


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = Record(tmp_path, 3, datetime(2026, 11, 24, 6, 30))
    seconds = {"lower": 0.5}
    result = Result(3, Outcome.MISSED, str(made.folder), part="A-1", seconds=seconds)
    made.close(result)
    writer = RecordingWriter(made.folder / form.FILE, {form.EPOCH: "0", "format": form.FORMAT})
    for index in range(5):
        writer.frame(index, 1.0 + index, 48, 64, bytes(48 * 64))
    settings = {"destination": {"x_m": [-0.02, -0.01], "y_m": [0.0, 0.01]}}
    writer.event(form.SETTINGS, 1.0, {"settings": settings})
    writer.event(form.DECISION, 2.0, {"tip_m": [[0.0, 0.0], [-0.01, 0.005]]})
    writer.event(form.GAP, 2.0, {"first": 2, "frames": 1, "cause": "too slow"})
    writer.close({})
    return made.folder


def test_what_is_known_of_a_cycle(folder: Path) -> None:
    view = cycle_view(folder)
    assert (view.cycle, view.part, view.good, view.no_film) == (3, "A-1", False, "")
    assert view.summary.startswith("missed")
    assert view.spent["step"] == {"lower": 0.5}
    assert view.tip["predicted"] == [[0.0, 0.0], [-10.0, 5.0]]
    assert len(view.tip["destination"]) == 5
    assert view.gaps == ("1: too slow",)
    names = {"predicted": "p", "destination": "d", "seen": "s"}
    assert [s["name"] for s in tip_chart(view.tip, names)["series"]] == ["p", "d"]
    (folder / form.FILE).unlink()
    assert "was not kept" in cycle_view(folder).no_film


def test_frames_are_kept_in_memory_within_a_bound(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    films = Films()
    assert len(films.film(folder).stamps_ns) == 5
    first = films.frame(folder, 0)
    monkeypatch.setattr(films_module, "MOST_BYTES", 3 * len(first))
    for number in range(5):
        films.frame(folder, number)
    assert films.bytes <= 3 * len(first)
    with pytest.raises(IndexError):
        films.frame(folder, 5)
    (folder / form.FILE).unlink()
    with pytest.raises(OSError, match="No such file"):
        films.frame(folder, 4)


def test_the_camera_shows_the_cycle_under_way_and_nothing_after_it(folder: Path) -> None:
    camera = LiveCamera(folder.parent)
    camera.read()
    assert camera.newest is None
    (folder / form.FILE).rename(folder / form.PART)
    camera.read()
    assert camera.newest is not None
    number = camera.newest.number
    camera.read()
    assert camera.newest.number == number
    (folder / form.PART).rename(folder / form.FILE)
    camera.read()
    assert camera.newest is None


def test_the_age_of_a_picture_counts_from_when_it_was_written(folder: Path) -> None:
    """The recorder was killed an hour ago: whoever opens the page now sees an old picture."""
    part = (folder / form.FILE).rename(folder / form.PART)
    os.utime(part, (1_790_000_000.0, 1_790_000_000.0))
    camera = LiveCamera(folder.parent)
    camera.read()
    assert camera.newest is not None
    assert camera.newest.taken_s == pytest.approx(1_790_000_000.0, abs=10.0)
