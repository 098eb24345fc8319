"""A recording is read back as it was written, by this program and by others."""

from __future__ import annotations

import json
import re
import tracemalloc
from collections import deque
from contextlib import nullcontext

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from pybag.mcap.record_reader import McapRecordReaderFactory
from zstandard import ZstdDecompressor

from cell.files.input_error import InputError
from cell.records.recording import form
from cell.records.recording.film import (
    is_protected,
    keep_recording,
    read_film,
    read_frame,
    why_no_film,
)
from cell.records.recording.reading import (
    GrowingRecording,
    TornRecordingError,
    read_recording,
    recording_under_way,
    small_jpeg,
    verify,
)
from cell.records.recording.retention import remove_recording
from cell.records.recording.writer import RecordingWriter

from .conftest import EPOCH_NS, T_S, fill, picture


def test_frames_come_back_to_the_last_bit(make_recording):
    frames = list(read_recording(make_recording()).frames())
    assert [f.index for f in frames] == list(range(12))
    assert [f.t_s for f in frames] == T_S.tolist()  # not as nanoseconds
    for frame in frames:
        np.testing.assert_array_equal(frame.image, picture(frame.index))


def test_events_and_counts(make_recording):
    recording = read_recording(make_recording())
    assert recording.complete
    assert recording.started["cycle"] == "7"
    assert [s["step"] for s in recording.json(form.STATE)] == ["step 0", "step 4", "step 8"]
    assert recording.last(form.STATE) == {"state": "execute", "step": "step 8"}
    assert recording.last(form.FAULT) is None
    assert recording.count(form.MEASURED) == 36


def test_numbers_of_events_are_exact_and_never_nan(tmp_path):
    writer = RecordingWriter(tmp_path / form.FILE, {form.EPOCH: str(EPOCH_NS)})
    poses = {"t_s": T_S, "x_m": np.sqrt(T_S), "y_m": -T_S / 7.0, "angle_rad": T_S * 1e-300}
    writer.event(form.ANSWER, 0.0, {"start_s": 0.1, "end_s": float("inf"), **poses})
    writer.close({})
    ((said, read),) = read_recording(tmp_path).trajectories(form.ANSWER)
    assert said["start_s"] == 0.1
    assert said["end_s"] is None
    for name, values in poses.items():
        np.testing.assert_array_equal(getattr(read, name), values)


def test_the_official_reader_opens_it(make_recording):
    with make_recording().open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        messages = list(reader.iter_messages())
    schemas = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
    assert schemas[form.IMAGE] == "foxglove.RawImage"
    assert schemas[form.MEASURED] == "foxglove.PoseInFrame"
    assert len(messages) == summary.statistics.message_count == 12 + 12 + 36 + 3
    first = next(m for _, c, m in messages if c.topic == form.IMAGE)
    assert first.log_time == EPOCH_NS + round(T_S[0] * 1e9)


def test_a_second_independent_reader_opens_it(make_recording):
    with McapRecordReaderFactory.from_file(make_recording()) as reader:
        assert reader.get_statistics().message_count == 63
        topics = {channel.topic for channel in reader.get_channels().values()}
        chunks = [reader.get_chunk(index) for index in reader.get_chunk_indexes()]
    assert topics == {form.IMAGE, form.FRAME, form.MEASURED, form.STATE}
    data = b"".join(
        ZstdDecompressor().decompress(c.records, max_output_size=c.uncompressed_size)
        for c in chunks
    )
    assert all(picture(index).tobytes() in data for index in range(12))


def test_one_frame_is_in_memory_not_all(tmp_path):
    frame = bytes(1_000_000)
    writer = RecordingWriter(tmp_path / form.FILE, {form.EPOCH: str(EPOCH_NS)})
    for index in range(20):
        writer.frame(index, 0.005 * index, 1000, 1000, frame)
    writer.close({})
    recording = read_recording(tmp_path)
    for read in (recording.check, lambda: deque(recording.frames(), maxlen=0)):
        tracemalloc.start()
        try:
            read()
            assert tracemalloc.get_traced_memory()[1] < 6e6
        finally:
            tracemalloc.stop()


def test_a_file_that_lacks_messages_is_torn(make_recording):
    path = make_recording()
    counts = verify(path)
    verify(path, counts)
    with pytest.raises(TornRecordingError, match="12 of 13 messages of /camera/image"):
        verify(path, counts | {form.IMAGE: 13})


def test_a_changed_byte_is_noticed(make_recording):
    path = make_recording()
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)
    with pytest.raises(TornRecordingError):
        verify(path)
    recording = read_recording(path)
    for read in (recording.check, lambda: list(recording.frames())):
        with pytest.raises(InputError, match=f"checksum is wrong; `cell recover {path}`"):
            read()


def test_wherever_a_byte_is_changed_it_is_called_damage(make_recording):
    """A checksum finds some, the decompressor others; a person reads one word and one remedy."""
    path = make_recording()
    data = path.read_bytes()
    whole = [frame.image.tobytes() for frame in read_recording(path).frames()]
    said = []
    for at in range(len(data) // 8, len(data) // 2, 61):  # before the index at the end
        path.write_bytes(data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :])
        try:
            read = [frame.image.tobytes() for frame in read_recording(path).frames()]
        except InputError as error:
            said.append(str(error))
        else:
            assert read == whole  # a byte of an index that nobody read
    assert len(said) > 100
    wanted = f"{path}:1: is damaged: .*; `cell recover {path}` copies what is whole"
    assert [line for line in said if not re.fullmatch(wanted, line)] == []
    assert len(set(said)) > 1


@pytest.mark.parametrize(
    ("content", "said"),
    [(b"", "is no MCAP file"), (b"no recording", "is no MCAP file"), (None, "is missing")],
)
def test_what_is_no_recording_is_refused(tmp_path, content, said):
    path = tmp_path / "some.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=said):
        read_recording(path)


def test_a_folder_without_or_with_a_torn_recording(tmp_path, make_recording):
    with pytest.raises(InputError, match="not recorded"):
        read_recording(tmp_path)
    make_recording(form.PART, closed=False)
    with pytest.raises(InputError, match=f"cell recover {tmp_path}"):
        read_recording(tmp_path)


def test_a_recording_of_another_program_is_refused(tmp_path):
    import foxglove

    context = foxglove.Context()
    with foxglove.open_mcap(tmp_path / "other.mcap", context=context):
        foxglove.Channel("/a", schema={"type": "object"}, context=context).log({"b": 1})
    with pytest.raises(InputError, match="no recording of `cell run`"):
        read_recording(tmp_path / "other.mcap")


def test_all_json_topics_have_a_schema():
    for topic in form.JSON_TOPICS:
        assert json.dumps(form.json_schema(topic))
        assert form.json_schema(topic)["type"] == "object"


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


def test_a_frame_is_found_by_its_number(make_recording):
    film = read_film(make_recording())
    assert film.times_s == pytest.approx(T_S - T_S[0], abs=1e-6)
    for number in (0, 7, 11):
        shown = cv2.imdecode(np.frombuffer(read_frame(film, number).jpeg(640), np.uint8), 0)
        wanted = picture(number)
        off = [np.mean(np.abs(shown.astype(int) - picture(k))) for k in range(12)]
        assert shown.shape == wanted.shape and int(np.argmin(off)) == number
    small = cv2.imdecode(np.frombuffer(read_frame(film, 0).jpeg(32), np.uint8), 0)
    assert small.shape == (24, 32)
    with pytest.raises(IndexError):
        read_frame(film, 12).jpeg(640)


def test_the_cable_is_drawn_where_it_was_seen(tmp_path):
    writer = RecordingWriter(tmp_path / form.FILE, {form.EPOCH: str(EPOCH_NS)})
    for index in range(2):
        writer.frame(index, 1.0 + index, 48, 64, bytes(48 * 64))
    writer.add_detections([2.0], np.array([[[10.0, 20.0], [50.0, 20.0], [np.nan, np.nan]]]))
    writer.close({})
    film = read_film(tmp_path / form.FILE)
    before, after = (
        cv2.imdecode(np.frombuffer(read_frame(film, k).jpeg(640), np.uint8), 1).max(axis=2) > 60
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
    assert is_protected(tmp_path)
    keep_recording(tmp_path, False)
    assert not is_protected(tmp_path)


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        ({"cycle": 1}, r"is of cycle 7, begun \?, its folder of cycle 1, begun \?; put it into"),
        ({"cycle": 7, "started": "2026-11-21T01:02:03+00:00"}, None),
        ({"cycle": "x" * 3}, "its folder of cycle xxx"),
        ({}, None),
    ],
)
def test_a_recording_in_the_folder_of_another_cycle_is_refused(
    make_recording, tmp_path, state, expected
):
    path = make_recording()
    (tmp_path / "state.json").write_text(json.dumps(state))
    with nullcontext() if expected is None else pytest.raises(InputError, match=expected):
        assert read_recording(path).path == path
