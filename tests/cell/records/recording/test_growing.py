"""The newest frame of a recording that is being written."""

from __future__ import annotations

import numpy as np

from cell.records.recording import form
from cell.records.recording.growing import GrowingRecording, recording_under_way, small_jpeg
from cell.records.recording.writer import RecordingWriter

from .conftest import EPOCH_NS, T_S, fill, picture


def test_the_newest_frame_is_read_once_as_the_file_grows(tmp_path):
    path = tmp_path / form.PART
    writer = RecordingWriter(path, {form.EPOCH: str(EPOCH_NS)})
    growing = GrowingRecording(path)
    writer.flush()
    assert growing.newest() is None
    fill(writer)
    writer.event(form.STATE, T_S[-1] + 2.0, {"state": "execute", "step": "verify"})
    writer.flush()
    age_s, image = growing.newest()
    assert abs(age_s - 2.0) < 1e-3
    np.testing.assert_array_equal(image, picture(11))
    assert growing.newest() is None
    writer.frame(12, T_S[-1] + 1.0, 48, 64, picture(12).tobytes())
    writer.flush()
    torn = path.read_bytes()
    path.write_bytes(torn[:-1500])  # the end of a chunk is not there yet
    assert growing.newest() is None
    path.write_bytes(torn)
    np.testing.assert_array_equal(growing.newest()[1], picture(12))
    writer.abandon()


def test_the_recording_under_way_is_that_of_the_newest_cycle(tmp_path):
    assert recording_under_way(tmp_path / "none") is None
    for number in (1, 2):
        folder = tmp_path / f"2026112{number}T021043.800-{number}"
        folder.mkdir()
        (folder / form.PART).touch()
    assert recording_under_way(tmp_path) == folder / form.PART
    (folder / form.PART).unlink()
    assert recording_under_way(tmp_path) is None


def test_a_picture_is_no_wider_than_asked_for():
    assert len(small_jpeg(np.zeros((1024, 1280), np.uint8), 640)) < 20_000
