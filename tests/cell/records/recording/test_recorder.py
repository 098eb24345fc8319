"""A recorder in its own process: nothing is lost silently, and nothing waits for it."""

from __future__ import annotations

import errno
import logging
import os
import shutil
import signal
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cell.records.recording import form, writer
from cell.records.recording.reading import read_recording
from cell.records.recording.recorder import IDLE, NORMAL, Recorder
from cell.records.recording.recover import recover_in_place
from cell.records.recording.writer import RecordingSession
from drivers.clock import RealClock
from drivers.interfaces import Frame, Trajectory
from tests.waiting import wait_until

from .conftest import picture


class StillArm:
    """Measured poses of an arm at rest, 500 in a second."""

    name = "arm"

    def log(self, start_s, end_s):
        t_s = np.arange(np.ceil(start_s * 500), np.floor(end_s * 500) + 1) / 500
        return Trajectory(t_s, np.zeros(len(t_s)), np.ones(len(t_s)), np.zeros(len(t_s)))


class SilentArm:
    """Measures no poses: nothing but what a test hands over reaches the recorder."""

    name = "arm"

    def log(self, start_s, end_s):
        return Trajectory(*np.zeros((4, 0)))


@pytest.fixture(autouse=True)
def busy_computer(monkeypatch):
    """Beside other tests a process that waits for an idle computer may wait for a minute."""
    monkeypatch.setattr("cell.records.recording.recorder.IDLE", NORMAL)


@pytest.fixture
def recorder():
    made = Recorder(StillArm(), RealClock(), 2**20)
    yield made
    made.close()


def frames(count, shape=(48, 64)):
    for index in range(count):
        image = np.resize(picture(index), shape)
        yield Frame(index, time.monotonic(), image)


def written(recorder):
    """Wait until all was taken over that was handed over; the file may lack it yet."""
    deadline = time.monotonic() + 20.0
    while recorder.waiting_bytes:
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("patience_s", "gives_way"), [(0.0, True), (10.0, False)], ids=["real time", "simulated time"]
)
def test_only_in_real_time_does_the_recorder_wait_for_an_idle_computer(
    patience_s, gives_way, tmp_path, monkeypatch
):
    """Beside busy cores a simulated cell waited minutes for its recorder, which gains nobody."""
    monkeypatch.setattr("cell.records.recording.recorder.IDLE", IDLE)
    recorder = Recorder(SilentArm(), RealClock(), 2**20, patience_s)
    recorder.begin(tmp_path / form.FILE, {})
    try:
        recorder.event(form.STATE, {"state": "idle", "step": None})
        wait_until(lambda: recorder.waiting_bytes == 0 or idle(recorder))
        assert idle(recorder) == gives_way
    finally:  # beside other tests an idle process may not even come to its end
        kill(recorder)
        recorder.close()
        for memory in in_memory():
            memory.unlink()


def test_what_is_handed_over_is_in_the_file(recorder, tmp_path):
    recorder.begin(tmp_path / form.FILE, {"cycle": "3"})
    given = list(frames(20))
    for frame in given:
        recorder.frame(frame)
    recorder.event(form.STATE, {"state": "execute", "step": "lower"})
    recorder.add_detections([f.t_s for f in given], np.full((20, 11, 2), 5.0))
    path = Trajectory(np.arange(3.0), *np.ones((3, 3)))
    recorder.poses(form.COMMANDED, path)
    time.sleep(0.1)  # poses of so much time
    recorder.end()
    assert recorder.wait()
    recording = read_recording(tmp_path)
    assert recording.complete
    assert [f.t_s for f in recording.frames()] == [f.t_s for f in given]
    assert recording.count(form.SEEN) == 20
    assert recording.count(form.COMMANDED) == 3
    assert recording.count(form.MEASURED) >= 40
    assert not (tmp_path / form.PART).exists()
    assert recorder.notes == []


def test_two_cycles_have_a_file_each(recorder, tmp_path):
    for cycle in ("1", "2"):
        (tmp_path / cycle).mkdir()
        recorder.begin(tmp_path / cycle / form.FILE, {"cycle": cycle})
        for frame in frames(int(cycle)):
            recorder.frame(frame)
        recorder.end()
    assert recorder.wait()
    for cycle in ("1", "2"):
        recording = read_recording(tmp_path / cycle)
        assert recording.started["cycle"] == cycle
        assert len(list(recording.frames())) == int(cycle)


def test_one_that_is_not_kept_leaves_nothing(recorder, tmp_path):
    recorder.begin(tmp_path / form.FILE, {})
    for frame in frames(3):
        recorder.frame(frame)
    recorder.end(keep=False)
    assert recorder.wait()
    assert list(tmp_path.iterdir()) == []


def test_frames_that_find_no_room_are_a_gap_and_are_told(recorder, tmp_path):
    """A process that stands still, as on a computer that is too slow."""
    recorder.begin(tmp_path / form.FILE, {})
    recorder.pause()  # 0.25 s: nothing is read
    large = list(frames(40, (512, 512)))
    for frame in large:
        recorder.frame(frame)
    recorder.resume()
    written(recorder)
    recorder.frame(Frame(40, time.monotonic(), large[0].image))
    recorder.end()
    assert recorder.wait()
    recording = read_recording(tmp_path)
    (gap,) = recording.json(form.GAP)
    assert gap["frames"] + recording.count(form.IMAGE) == 41
    assert gap["frames"] > 20
    assert [f.index for f in recording.frames()][-1] == 40
    assert "too slow" in recorder.notes[0]


def on_disk(part, count):
    """Wait until so many frames are in a file that is being written.

    What was taken over waits for the next flush, on a busy computer for long.
    """
    deadline, found = time.monotonic() + 20.0, 0
    while found < count:
        assert time.monotonic() < deadline
        copy = part.parent / "copied" / form.PART
        copy.parent.mkdir(exist_ok=True)
        with suppress(OSError, ValueError):  # nothing is in it yet
            shutil.copyfile(part, copy)
            found = recover_in_place(copy).messages.get(form.IMAGE, 0)
        shutil.rmtree(copy.parent)


def idle(recorder):
    return os.sched_getscheduler(recorder.process_id) == os.SCHED_IDLE


def kill(recorder):
    """Kill its process, and wait until it is dead: on a busy computer it comes late to that."""
    os.kill(recorder.process_id, signal.SIGKILL)
    os.waitid(os.P_PID, recorder.process_id, os.WEXITED | os.WNOWAIT)


def test_a_killed_recorder_is_told_of_and_costs_nothing_else(tmp_path):
    recorder = Recorder(SilentArm(), RealClock(), 2**20)
    recorder.begin(tmp_path / form.FILE, {})
    for frame in frames(5):
        recorder.frame(frame)
    on_disk(tmp_path / form.PART, 5)
    kill(recorder)
    for frame in frames(5):
        recorder.frame(frame)
    recorder.end()
    assert recorder.wait(1.0)
    assert "has ended" in recorder.notes[0]
    (tmp_path / "next").mkdir()
    recorder.begin(tmp_path / "next" / form.FILE, {})  # with a new process
    recorder.end()
    recorder.close()
    assert read_recording(tmp_path / "next").complete
    recovered = recover_in_place(tmp_path / form.PART)
    assert recovered.messages[form.IMAGE] == 6  # the one with which it was found dead is in memory
    assert not in_memory()


def in_memory():
    """What this process's recorders have left in memory."""
    return list(Path("/dev/shm").glob(f"cable-cell-{os.getpid()}-*"))


def test_what_was_only_in_memory_is_recovered(recorder, tmp_path):
    """Cell and recorder are killed at once, while the recorder leaves the computer to others."""
    recorder.begin(tmp_path / form.FILE, {"cycle": "1"})
    for frame in frames(3):
        recorder.frame(frame)
    on_disk(tmp_path / form.PART, 3)
    recorder.pause()
    for frame in frames(4):
        recorder.frame(frame)
    recorder.event(form.STATE, {"state": "execute", "step": "lower"})
    kill(recorder)
    recorder.forget()
    recovered = recover_in_place(tmp_path / form.PART)
    assert recovered.messages[form.IMAGE] == 7
    assert read_recording(tmp_path).last(form.STATE)["step"] == "lower"
    assert sorted(p.name for p in tmp_path.iterdir()) == [form.FILE]
    assert not in_memory()


def test_a_recorder_that_dies_at_the_end_is_told_of(recorder, tmp_path):
    """Nothing is handed over any more when it dies; nobody waits for it in vain."""
    recorder.begin(tmp_path / form.FILE, {})
    recorder.frame(next(frames(1)))
    on_disk(tmp_path / form.PART, 1)
    recorder.pause()
    recorder.end()
    kill(recorder)
    assert recorder.wait(1.0)
    assert "has ended" in recorder.notes[0]
    recorder.close()
    recover_in_place(tmp_path / form.PART)
    assert not in_memory()


def test_a_folder_that_is_gone_is_told_of(recorder, tmp_path):
    recorder.begin(tmp_path / "gone" / form.FILE, {})
    for frame in frames(3):
        recorder.frame(frame)
    recorder.end()
    assert recorder.wait()
    assert "No such file" in recorder.notes[0]


def test_a_full_disk_costs_frames_and_says_so(tmp_path, monkeypatch):
    recording = RecordingSession(tmp_path / form.FILE, {form.EPOCH: "0"})
    recording.write(("frame", 0, 1.0, 48, 64), picture(0).tobytes())
    real, free = os.statvfs, 48 * 2**20

    class Full:
        f_bavail, f_frsize = free, 1

    monkeypatch.setattr(writer.os, "statvfs", lambda path: Full)
    for index in (1, 2):
        recording.write(("frame", index, 1.0 + index, 48, 64), picture(index).tobytes())
    recording.write(("event", form.STATE, 4.0, {"state": "execute", "step": "lower"}), b"")
    monkeypatch.setattr(writer.os, "statvfs", real)
    recording.write(("frame", 3, 4.0, 48, 64), picture(3).tobytes())
    report = recording.end(True, True)
    assert report["lost_frames"] == 2
    assert "64 MiB are free" in report["cause"]
    read = read_recording(tmp_path)
    assert [f.index for f in read.frames()] == [0, 3]
    assert list(read.json(form.GAP)) == [{"first": 1, "frames": 2, "cause": report["cause"]}]
    assert read.last(form.STATE)["step"] == "lower"


def test_a_disk_that_refuses_leaves_a_torn_file(tmp_path, monkeypatch):
    """As when another program takes the last byte between the look and the writing."""
    recording = RecordingSession(tmp_path / form.FILE, {form.EPOCH: "0"})
    for index in range(3):
        recording.write(("frame", index, 1.0 + index, 48, 64), picture(index).tobytes())
    recording.keep_up(now=True)

    def refuse(descriptor, data):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as context:
        context.setattr(writer.os, "write", refuse)
        for index in range(3, 6):
            recording.write(("frame", index, 1.0 + index, 48, 64), picture(index).tobytes())
            recording.keep_up(now=True)
    report = recording.end(True, True)
    assert "No space left" in report["error"]
    assert report["lost_frames"] >= 2
    assert recover_in_place(tmp_path / form.PART).messages[form.IMAGE] == 3


def test_after_a_killed_recorder_poses_are_recorded_once(tmp_path):
    """What took poses for the recording that was torn does not go on in the next."""
    recorder = Recorder(StillArm(), RealClock(), 2**20)
    recorder.begin(tmp_path / form.FILE, {})
    kill(recorder)
    recorder.event(form.STATE, {"state": "execute", "step": "lower"})
    recorder.end()
    assert [t for t in threading.enumerate() if t.name == "poses"] == []
    assert not any(recorder._handler in logging.getLogger(n).handlers for n in ("cell", "drivers"))
    recorder.close()
    (tmp_path / form.PART).unlink(missing_ok=True)
    for ring in in_memory():
        ring.unlink()


def test_frames_that_are_missing_at_the_end_are_a_gap_too(recorder, tmp_path, monkeypatch):
    """No frame comes after them that could tell."""
    monkeypatch.setattr("cell.records.recording.recorder.PAUSE_S", 600.0)
    recorder.begin(tmp_path / form.FILE, {})
    recorder.pause()  # until it is waited for
    for frame in frames(8, (512, 512)):
        recorder.frame(frame)
    recorder.end()
    assert recorder.wait()
    recording = read_recording(tmp_path)
    (gap,) = recording.json(form.GAP)
    assert 0 < gap["frames"] == 8 - recording.count(form.IMAGE)
    assert "too slow" in recorder.notes[0]


def test_a_recorder_that_cannot_be_started_leaves_nothing_open(monkeypatch, tmp_path):
    """As where this user may have no more processes: every cycle tries again."""

    def refused(*_, **__):
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr("cell.records.recording.recorder.subprocess.Popen", refused)
    recorder = Recorder(SilentArm(), RealClock(), 2**20)
    before = set(Path("/proc/self/fd").iterdir())
    recorder.begin(tmp_path / form.FILE, {})
    assert "cannot be started" in recorder.notes[0]
    assert set(Path("/proc/self/fd").iterdir()) == before
    assert not in_memory()


def test_a_full_disk_costs_messages_and_says_so(tmp_path, monkeypatch):
    """The film is whole, and the disk fills up before it is said what was decided."""
    recording = RecordingSession(tmp_path / form.FILE, {form.EPOCH: "0"})
    recording.write(("frame", 0, 1.0, 48, 64), picture(0).tobytes())
    with monkeypatch.context() as full:
        full.setattr(writer, "LEAST_FREE_BYTES", 2**62)
        recording.write(("event", form.DECISION, 2.0, {"offset_m": 0.01}), b"")
    report = recording.end(True, True)
    assert read_recording(tmp_path).last(form.DECISION) is None
    assert report["lost_messages"] == 1
    told = Recorder(SilentArm(), RealClock(), 2**20)
    told._report(report)
    assert "1 messages are missing" in told.notes[0]
    assert "MiB are free" in told.notes[0]


def test_a_disk_that_loses_what_was_written_is_told_of(tmp_path, monkeypatch):
    """The system says so once, to whoever asks first to have it on the disk."""
    recording = RecordingSession(tmp_path / form.FILE, {form.EPOCH: "0"})
    recording.write(("frame", 0, 1.0, 48, 64), picture(0).tobytes())
    asked = threading.Event()

    def lost(descriptor):
        if not asked.is_set():
            asked.set()
            raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(writer.os, "fdatasync", lost)
    monkeypatch.setattr("cell.records.recording.writer.SYNC_S", 0.0)
    recording.keep_up(now=True)
    assert asked.wait(20.0)
    report = recording.end(True, True)
    assert "Input/output error" in report["error"]
    assert not (tmp_path / form.FILE).exists()


def test_a_verification_that_is_killed_is_told_of(tmp_path, monkeypatch):
    """As by a system without memory: it says nothing itself."""
    recording = RecordingSession(tmp_path / form.FILE, {form.EPOCH: "0"})
    recording.write(("frame", 0, 1.0, 48, 64), picture(0).tobytes())
    killed = subprocess.CompletedProcess([], -signal.SIGKILL, "", "")
    with monkeypatch.context() as context:
        context.setattr("cell.records.recording.writer.subprocess.run", lambda *_, **__: killed)
        report = recording.end(True, True)
    assert "SIGKILL" in report["error"]
    assert recover_in_place(tmp_path / form.PART).messages[form.IMAGE] == 1


def test_what_is_gone_is_not_said_to_be_recoverable(tmp_path):
    """A folder of records that somebody removed in mid-cycle."""
    notes: list[str] = []
    recorder = SimpleNamespace(note=notes.append)
    for folder in (tmp_path, tmp_path / "gone"):
        Recorder._report(recorder, {"path": str(folder / form.FILE), "error": "no such file"})
    assert notes[0].endswith(f"`cell recover {tmp_path / form.FILE}` reads what is there")
    assert notes[1].endswith("no such file; nothing of it is there any more")
