"""A cycle's page: what is known of it, and frames that are served from memory."""

from __future__ import annotations

import os
from datetime import datetime
from pathlib import Path

import pytest

from cell.records.folder import Record
from cell.records.recording import form
from cell.records.recording.writer import RecordingWriter
from cell.records.result import Correction, Outcome, Result
from cell.web import camera as films_module
from cell.web.camera import Films, LiveCamera
from cell.web.cycle_view import cycle_view, decision_chart, error_chart, tip_chart


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = Record(tmp_path, 3, datetime(2026, 11, 24, 6, 30))
    seconds = {"lower": 0.5}
    chosen = {"offset_m": 0.01, "delay_s": 0.2}
    result = Result(3, Outcome.MISSED, str(made.folder), part="A-1", seconds=seconds, **chosen)
    made.close(result)
    writer = RecordingWriter(made.folder / form.FILE, {form.EPOCH: "0", "format": form.FORMAT})
    for index in range(5):
        writer.frame(index, 1.0 + index, 48, 64, bytes(48 * 64))
    settings = {"destination": {"x_m": [-0.02, -0.01], "y_m": [0.0, 0.01]}}
    writer.event(form.SETTINGS, 1.0, {"settings": settings})
    tip_m, still = [[0.0, 0.0], [-0.01, 0.005]], {"delay_s": 0.0, "margin_std_m": 1e-3}
    table = [
        {"offset_m": 0.01, "probability": 0.5, "margin_m": 0.0, **still},
        {"offset_m": 0.0, "probability": 0.1, "margin_m": -0.001, **still},
        {"offset_m": 0.01, "probability": 0.9, "delay_s": 0.2, "margin_std_m": 1e-4},
    ]
    writer.event(form.DECISION, 2.0, {"offset_m": 0.01, "table": table, "tip_m": tip_m})
    seen = {"tip_m": [[0.0, 0.0], [-0.015, 0.0052]], "predicted_m": [[0.0, 0.0], [-0.015, 0.005]]}
    writer.event(form.PASSAGE, 3.0, {"t_s": [0.1, 0.3], **seen})
    for first, frames in ((2, 1), (5, 3)):
        writer.event(form.GAP, 2.0, {"first": first, "frames": frames, "cause": "too slow"})
    writer.close({})
    return made.folder


def test_what_is_known_of_a_cycle(folder: Path) -> None:
    view = cycle_view(folder)
    assert (view.cycle, view.part, view.good, view.no_film) == (3, "A-1", False, "")
    assert view.summary.startswith("missed")
    assert view.spent["step"] == {"lower": 0.5}
    assert view.flight.planned_m.tolist() == [[0.0, 0.0], [-0.01, 0.005]]
    assert len(view.flight.destination_m) == 5
    assert view.gaps == ("4: too slow",)
    names = {"predicted": "p", "destination": "d", "seen": "s"}
    assert [s["name"] for s in tip_chart(view.flight, names)["series"]] == ["p", "d"]
    (folder / form.FILE).unlink()
    assert "was not kept" in cycle_view(folder).no_film


def test_the_error_of_the_forecast_is_shown_beside_its_limit(folder: Path) -> None:
    flight, (table, chosen) = cycle_view(folder).flight, cycle_view(folder).decision
    assert flight.error_m.tolist() == [[0.0, 0.0], pytest.approx([0.0, 0.0002])]
    assert flight.limit_m == pytest.approx(0.0003)
    assert flight.inside_s.tolist() == [0.3, 0.3]
    names = {k: k for k in ("above", "right", "limit", "time", "error", "inside", "correction")}
    correction = Correction(0.15, 0.001, 0.1, 0.4, 0.9)
    above, _, high, low = error_chart(flight, [correction], names)["series"]
    assert above["data"] == [[0.1, 0.0], [0.3, 0.2]]
    assert above["markLine"]["data"] == [{"xAxis": 0.15, "name": "correction"}]
    assert (high["data"][0], low["data"][0]) == ([0.1, 0.3], [0.1, -0.3])
    assert chosen is not None and chosen["delay_s"] == 0.2  # not the row of the same offset
    names = {k: k for k in ("offset", "probability", "margin", "chosen")}
    probability, _, executed = decision_chart(table, chosen, names)["series"]
    assert probability["data"] == [[0.0, 10.0], [10.0, 50.0]]
    assert executed["data"] == [[10.0, 90.0]]


def test_of_a_recording_without_a_flight_no_chart_is_shown(tmp_path: Path) -> None:
    made = Record(tmp_path, 3, datetime(2026, 11, 24, 6, 30))
    made.close(Result(3, Outcome.REJECTED, str(made.folder)))
    view = cycle_view(made.folder)
    assert tip_chart(view.flight, {}) == error_chart(view.flight, (), {}) == {}
    assert decision_chart(*view.decision, {}) == {}


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
