"""Single frames of a recording, and why there is none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cell.files.input_error import InputError
from cell.records.recording import form
from cell.records.recording.film import (
    frame_jpeg,
    is_kept,
    keep_recording,
    read_film,
    why_no_film,
)
from cell.records.recording.retention import remove_recording
from cell.records.recording.writer import RecordingWriter

from .conftest import EPOCH_NS, T_S, picture


def test_a_frame_is_found_by_its_number(make_recording):
    film = read_film(make_recording())
    assert film.times_s == pytest.approx(T_S - T_S[0], abs=1e-6)
    for number in (0, 7, 11):
        shown = cv2.imdecode(np.frombuffer(frame_jpeg(film, number, 640), np.uint8), 0)
        wanted = picture(number)
        off = [np.mean(np.abs(shown.astype(int) - picture(k))) for k in range(12)]
        assert shown.shape == wanted.shape and int(np.argmin(off)) == number
    small = cv2.imdecode(np.frombuffer(frame_jpeg(film, 0, 32), np.uint8), 0)
    assert small.shape == (24, 32)
    with pytest.raises(IndexError):
        frame_jpeg(film, 12, 640)


def test_the_cable_is_drawn_where_it_was_seen(tmp_path):
    writer = RecordingWriter(tmp_path / form.FILE, {form.EPOCH: str(EPOCH_NS)})
    for index in range(2):
        writer.frame(index, 1.0 + index, 48, 64, bytes(48 * 64))
    writer.seen([2.0], np.array([[[10.0, 20.0], [50.0, 20.0], [np.nan, np.nan]]]))
    writer.close({})
    film = read_film(tmp_path / form.FILE)
    before, after = (
        cv2.imdecode(np.frombuffer(frame_jpeg(film, k, 640), np.uint8), 1).max(axis=2) > 60
        for k in (0, 1)
    )
    assert not before.any()
    assert after[20, 12:48].all() and not after[:, 60:].any() and not after[35:].any()


def test_why_there_is_no_film_is_said(make_recording, tmp_path):
    path = make_recording(closed=False)
    with pytest.raises(InputError):
        read_film(path)
    path.rename(tmp_path / form.PART)
    assert "cell recover" in why_no_film(tmp_path)
    (tmp_path / form.PART).rename(path)
    assert why_no_film(tmp_path) == ""
    remove_recording(path, "recordings take 21.0 GB")
    assert "recordings take 21.0 GB" in why_no_film(tmp_path)
    (tmp_path / form.REMOVED).unlink()
    assert "was not kept" in why_no_film(tmp_path)
    (tmp_path / "settings.yaml").write_text("recording: null\n")
    assert "`recording: null`" in why_no_film(tmp_path)


def test_a_recording_is_kept_for_good(tmp_path):
    keep_recording(tmp_path, True)
    assert is_kept(tmp_path)
    keep_recording(tmp_path, False)
    assert not is_kept(tmp_path)
