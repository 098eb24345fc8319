"""A torn recording is made readable, up to where it is torn."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from cell.cli import app
from cell.files.input_error import InputError
from cell.records.recording import form
from cell.records.recording.reading import read_recording, verify
from cell.records.recording.recover import recover, recover_in_place, torn_recordings
from cell.records.recording.ring import RingWriter, shared_memory
from cell.records.recording.writer import RecordingWriter, Sink

from .conftest import EPOCH_NS, T_S, fill, picture


def test_a_recording_that_was_not_closed(make_recording, tmp_path):
    torn = make_recording(form.PART, closed=False)
    recovered = recover_in_place(torn)
    assert recovered.file == tmp_path / form.FILE
    assert recovered.messages[form.IMAGE] == 12
    assert recovered.damaged_bytes == 0
    assert recovered.frames_s == pytest.approx(T_S[-1] - T_S[0], abs=1e-8)
    assert not torn.exists()  # nothing of it is lost
    recording = read_recording(tmp_path)
    assert not recording.complete
    assert recording.started["cycle"] == "7"
    assert [f.t_s for f in recording.frames()] == T_S.tolist()


class Content(bytes):
    """Bytes that are named, not printed, where a test fails."""

    def __repr__(self) -> str:
        return f"<{len(self)} bytes>"


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Content:
    path = tmp_path_factory.mktemp("whole") / form.FILE
    writer = RecordingWriter(path, {form.EPOCH: str(EPOCH_NS)})
    fill(writer)
    writer.close({"complete": "true"})
    return Content(path.read_bytes())


@settings(max_examples=60)
@given(share=st.floats(0.0, 1.0), behind=st.binary(max_size=64))
def test_torn_anywhere(whole, tmp_path_factory, share, behind):
    """All that was whole before the tear comes back, whatever stands behind it."""
    folder = tmp_path_factory.mktemp("torn")
    at = int(share * len(whole))
    torn = folder / form.PART
    torn.write_bytes(whole[:at] + behind)
    try:
        recovered = recover(torn, folder / form.FILE)
    except InputError as error:
        assert at < 6000, error  # before the first chunk ends: a part of a block says nothing
        return
    assert torn.stat().st_size >= at  # it stays as it was
    assert verify(recovered.file) == recovered.messages
    frames = list(read_recording(recovered.file).frames())
    assert frames[-1].image.tobytes() == picture(len(frames) - 1).tobytes()
    assert len(frames) >= int(12 * at / len(whole)) - 2


def test_a_chunk_whose_length_was_not_written_yet(whole, tmp_path):
    """A program killed while it ended a chunk leaves 2^64 - 1 as the length of its content."""
    name = whole.index(b"zstd")
    begins = name - 41
    ends = begins + 9 + int.from_bytes(whole[begins + 1 : begins + 9], "little")
    torn = tmp_path / form.PART
    torn.write_bytes(whole[: name + 4] + b"\xff" * 8 + whole[name + 12 : ends])
    recovered = recover_in_place(torn)
    assert recovered.messages[form.IMAGE] >= 1
    assert recovered.read_bytes <= begins


def damaged(whole: bytes) -> bytes:
    """The same with another byte in a frame."""
    at = whole.index(picture(5).tobytes()[:256]) + 20  # noise is not compressed
    return whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :]


def test_a_damaged_chunk_costs_itself_only(whole, tmp_path):
    torn = tmp_path / "damaged.mcap"
    torn.write_bytes(damaged(whole))
    recovered = recover_in_place(torn)
    assert recovered.file == tmp_path / "damaged.recovered.mcap"
    assert recovered.damaged_bytes > 0
    assert 11 <= recovered.messages[form.IMAGE] < 13
    assert torn.exists()


def test_in_a_folder_a_damaged_recording_is_named_with_its_remedy(whole, tmp_path):
    """The command said that no torn recording was found."""
    folder = tmp_path / "1"
    folder.mkdir()
    done = CliRunner().invoke(app, ["recover", str(tmp_path)])
    assert (done.exit_code, "holds no recording; give" in done.stderr) == (2, True)
    file = folder / form.FILE
    file.write_bytes(whole)
    done = CliRunner().invoke(app, ["recover", str(tmp_path)])
    assert (done.exit_code, done.stdout) == (0, "no torn recording was found\n")
    file.write_bytes(damaged(whole))
    done = CliRunner().invoke(app, ["recover", str(tmp_path)])
    assert done.exit_code == 1
    assert f"{file}:1: is damaged: " in done.stderr
    assert f"`cell recover {file}` copies what is whole" in done.stderr
    assert file.read_bytes() == damaged(whole)


def test_a_cycle_s_recording_is_recovered_to_its_own_name(whole, tmp_path):
    """Whatever reads the folder then reads what is whole, and is told what is not."""
    file, kept = tmp_path / form.FILE, tmp_path / form.TORN
    file.write_bytes(whole[: len(whole) * 3 // 4])
    assert torn_recordings(tmp_path) == torn_recordings(file) == [file]
    assert recover_in_place(file).file == file
    assert torn_recordings(tmp_path) == torn_recordings(file) == []
    assert not kept.exists()
    read_recording(tmp_path).check()
    assert read_recording(tmp_path).losses() == ()

    file.write_bytes(damaged(whole))
    recovered = recover_in_place(file)
    assert recovered.source == kept
    assert kept.read_bytes() == damaged(whole)
    recording = read_recording(tmp_path)
    recording.check()
    assert recording.losses() == (
        f"{recovered.damaged_bytes} damaged bytes could not be recovered",
    )
    assert {p.name for p in tmp_path.iterdir()} == {form.FILE, form.TORN}


def test_a_damaged_recording_that_was_not_closed_is_recovered_once(whole, tmp_path):
    (tmp_path / form.PART).write_bytes(damaged(whole))
    assert recover_in_place(tmp_path / form.PART).source == tmp_path / form.TORN
    assert torn_recordings(tmp_path) == []


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"something else"])
def test_where_nothing_is_to_be_had_nothing_is_written(tmp_path, content):
    """A replay named `cell recover` as the remedy for a file that is no recording at all."""
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(content)
    said = "is torn; `cell recover " if content[:1] == b"\x89" else "is no MCAP file: it begins"
    with pytest.raises(InputError, match=said):
        read_recording(torn)
    with pytest.raises(InputError):
        recover_in_place(torn)
    assert [p.name for p in tmp_path.iterdir()] == ["torn.mcap"]


def test_never_over_another_file(make_recording, tmp_path):
    torn = make_recording(form.PART, closed=False)
    (tmp_path / form.FILE).write_bytes(b"mine")
    with pytest.raises(FileExistsError):
        recover_in_place(torn)
    assert (tmp_path / form.FILE).read_bytes() == b"mine"
    assert torn.exists()


def test_folders_are_searched_but_not_what_is_being_written(tmp_path: Path):
    one, two = tmp_path / "a" / form.PART, tmp_path / "b" / form.PART
    for path in (one, two):
        path.parent.mkdir()
    one.write_bytes(b"torn")
    with two.open("wb"):
        assert torn_recordings(tmp_path) == [one]
    assert torn_recordings(tmp_path) == [one, two]
    assert torn_recordings(one) == [one]
    with pytest.raises(InputError, match="is missing"):
        torn_recordings(tmp_path / "c")


def killed_with_a_full_ring(tmp_path: Path, started: str = "") -> tuple[Path, Path]:
    """A torn recording, and the memory with three frames that nobody has written."""
    descriptor, ring = shared_memory(4 * 2**20)
    os.close(descriptor)
    torn = tmp_path / form.PART
    begun = {form.EPOCH: str(EPOCH_NS), form.RING: str(ring), "started": started}
    writer = RecordingWriter(torn, begun)
    fill(writer)
    writer.abandon()
    descriptor = os.open(ring, os.O_RDWR)
    waiting = RingWriter(descriptor)
    os.close(descriptor)
    for index in range(12, 15):
        header = ("frame", index, T_S[-1] + 0.005 * (index - 11), 48, 64)
        assert waiting.put(header, picture(index))
    return torn, ring


def test_what_is_in_memory_is_not_lost_if_it_cannot_be_written(tmp_path, monkeypatch):
    torn, ring = killed_with_a_full_ring(tmp_path)
    with monkeypatch.context() as full:
        full.setattr("cell.records.recording.writer.LEAST_FREE_BYTES", 2**62)
        for _ in range(2):
            with pytest.raises(OSError, match="still in memory"):
                recover_in_place(torn)
    assert torn.exists() and ring.exists()
    assert {p.name for p in tmp_path.iterdir()} == {form.PART}
    recovered = recover_in_place(torn)
    assert recovered.messages[form.IMAGE] == 15
    assert not ring.exists()


def test_a_disk_that_is_full_is_told_of(make_recording, tmp_path, monkeypatch):
    torn = make_recording(form.PART, closed=False)

    def full(sink, data):
        sink.refused = OSError(errno.ENOSPC, "No space left on device")
        raise sink.refused

    monkeypatch.setattr(Sink, "write", full)
    with pytest.raises(OSError, match="No space left"):
        recover_in_place(torn)
    assert torn.exists()
    assert list(tmp_path.iterdir()) == [torn]


def test_what_is_in_memory_goes_to_the_recording_that_was_under_way(tmp_path):
    """An earlier one of the same run is torn too, as by a disk that was full for a while."""
    (tmp_path / "2").mkdir()
    later, ring = killed_with_a_full_ring(tmp_path / "2", "2026-11-26T10:01:00+01:00")
    earlier = tmp_path / "1" / form.PART
    earlier.parent.mkdir()
    begun = {form.EPOCH: str(EPOCH_NS), form.RING: str(ring)}
    # in the hour that comes twice the earlier one has the later time of day
    writer = RecordingWriter(earlier, begun | {"started": "2026-11-26T10:59:00+02:00"})
    fill(writer)
    writer.abandon()
    found = [recover_in_place(path) for path in torn_recordings(tmp_path)]
    assert [f.messages[form.IMAGE] for f in found] == [12, 15]
    assert found[1].source == later and not ring.exists()


def test_a_recorder_killed_while_it_reduced_a_recording_costs_nothing(make_recording, tmp_path):
    """Between the writing of a band and the removal of the whole frames, at any moment."""
    begun, ended = tmp_path / "begun", tmp_path / "ended"
    for folder in (begun, ended):
        folder.mkdir()
    make_recording().rename(begun / form.PART)
    (begun / form.BAND).write_bytes(b"\x89MCAP0\r\n")
    make_recording().rename(ended / form.PART)
    make_recording().rename(ended / form.FILE)
    assert torn_recordings(tmp_path) == [begun / form.PART]
    assert {p.name for p in begun.iterdir()} == {form.PART}
    assert {p.name for p in ended.iterdir()} == {form.FILE, form.WHOLE}
