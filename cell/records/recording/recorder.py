"""The cell's side of a recording: passes messages to the recorder's process without waiting.

Nothing here raises because of a recording: a cell continues without one, with a message.
"""

from __future__ import annotations

import json
import logging
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.files.words import counted
from cell.records.recording import form
from cell.records.recording.ring import (
    RESERVE_BYTES,
    RingWriter,
    remove_forgotten,
    shared_memory,
)
from drivers.interfaces import Arm, Clock, DeviceError, Frame, Trajectory
from drivers.threads import GuardedThread, error_text

if TYPE_CHECKING:  # it brings the compiler
    from cell.records.recording.band import VisionSetup

_LOG = logging.getLogger(__name__)

#: Priorities of the process.  With `IDLE` it runs only while the processor is free.
IDLE, NORMAL = "idle", "normal"
_PROCESS = "cell.records.recording.process"

#: Interval at which measured poses are read from the arm, s.
POSES_EVERY_S = 0.02
#: Longest pause of the recorder after the last frame, while the decision is computed, s.
PAUSE_S = 0.25
#: Longest time to write pending frames at the end of a run, s; then it ends without them.
LAST_WAIT_S = 60.0


class Recorder:
    """Records cycles, one file each, through a separate process that starts with the first.

    arm           source of poses while a cycle is recorded
    clock         of the cell
    patience_s    how long a frame may wait for room, as in simulated time; with 0 the cell runs in
                  real time, and the process has a low priority
    memory_bytes  of frames that wait to be written; more are left out, and the gap is marked
    """

    def __init__(self, arm: Arm, clock: Clock, memory_bytes: int, patience_s: float = 0.0) -> None:
        self._patience_s = patience_s
        self._arm = arm
        self._clock = clock
        self._memory_bytes = memory_bytes + RESERVE_BYTES
        self._process: subprocess.Popen[bytes] | None = None
        self._ring: RingWriter | None = None
        self._file: Path | None = None
        self._wake = self._status = -1
        self._lock = threading.Lock()
        self._under_way = False
        self._waiting = 0
        self._lost_frames: list[int] = []
        self._full = False
        self._stream: _PoseStream | None = None
        self._handler = _Handler(self)
        self.notes: list[str] = []

    # --- a recording ------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Start the process if it does not run: it takes half a second."""
        if self._process is not None and self._process.poll() is None:
            return
        if self._process is not None:
            self.note("the recorder's process has ended; a new one is started")
            self.forget()
        remove_forgotten()
        memory, self._file = shared_memory(self._memory_bytes)
        wake, self._wake = os.pipe()
        self._status, status = os.pipe()
        os.set_blocking(self._wake, False)
        os.set_blocking(self._status, False)
        passed = (memory, wake, status)
        priority = NORMAL if self._patience_s else IDLE
        command = [sys.executable, "-m", _PROCESS, *map(str, passed), priority]
        if self._file is not None:
            command.append(str(self._file))
        try:
            self._process = subprocess.Popen(
                command, pass_fds=passed, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL
            )
            self._ring = RingWriter(memory)
        except OSError:
            self.forget()
            if self._file is not None:
                self._file.unlink(missing_ok=True)
            raise
        finally:
            for descriptor in passed:
                os.close(descriptor)

    def begin(
        self, path: Path, begun: Mapping[str, str], vision: VisionSetup | None = None
    ) -> None:
        """Begin a recording at `path`.

        vision  setup of vision, to store bands of the frames; None = full frames are stored
        """
        try:
            self.prepare()
        except OSError as error:
            self.note(f"nothing is recorded: the recorder cannot be started: {error}")
            return
        self._read_reports()
        now_s = self._clock.now_s()
        epoch_ns = time.time_ns() - round(now_s * 1e9)
        self._lost_frames, self._full = [], False
        self._under_way = True
        metadata = {form.EPOCH: str(epoch_ns), form.RING: str(self._file or ""), **begun}
        pickled = None if vision is None else pickle.dumps(vision)  # the process need not know it
        self._put(("begin", str(path.absolute()), metadata, pickled))
        self._waiting += 1
        for logger in _LOGGERS:
            logging.getLogger(logger).addHandler(self._handler)
        self._stream = _PoseStream(self, self._arm, now_s)
        self._stream.start()

    def end(self, keep: bool = True, whole: bool = False) -> None:
        """End the recording; the file is closed, verified and kept, or removed, in the background.

        whole  whether full frames are stored too
        """
        if self._stream is not None:
            self._stream.end()
            self._stream = None
        for logger in _LOGGERS:
            logging.getLogger(logger).removeHandler(self._handler)
        if not self._under_way:  # its process has ended meanwhile, or it was not begun
            return
        if self._lost_frames:
            self._mark_gap(self._clock.now_s())
        self._put(("end", keep, whole))
        self._under_way = False

    def wait(self, timeout_s: float = LAST_WAIT_S) -> bool:
        """Wait until all recordings that have ended are files; returns whether they are."""
        end_s = time.monotonic() + timeout_s
        self.resume()
        while self._waiting and self._process is not None and time.monotonic() < end_s:
            ended = self._process.poll() is not None
            self._read_reports()
            if ended and self._waiting:
                self._has_ended()
            time.sleep(0.002)
        return not self._waiting

    def close(self) -> None:
        """Wait for pending writes, and end the process."""
        self.end()
        if self._process is None:
            return
        if not self.wait():
            self.note("a recording was not finished in time; `cell recover` makes it readable")
        self.forget()

    # --- messages ---------------------------------------------------------------------------------

    def frame(self, frame: Frame) -> None:
        """A frame as it was read."""
        height, width = frame.image.shape
        image = np.ascontiguousarray(frame.image)
        header = ("frame", frame.index, frame.t_s, height, width)
        end_s = time.monotonic() + self._patience_s
        while not (done := self._put(header, image, RESERVE_BYTES)) and time.monotonic() < end_s:
            time.sleep(0.005)
        if not done:
            self._lost_frames.append(frame.index)
        elif self._lost_frames:
            self._mark_gap(frame.t_s)

    def poses(self, topic: str, poses: Trajectory) -> None:
        """Poses on the cell's clock, measured or commanded."""
        if len(poses.t_s):
            columns = (poses.t_s, poses.x_m, poses.y_m, poses.angle_rad)
            self._put(("poses", topic, np.stack(columns, axis=-1)))

    def add_detections(self, t_s: Sequence[float], points_px: FloatArray) -> None:
        """The detected cable in frames: (n, points, 2) column and row, nan = not detected."""
        self._put(("seen", tuple(t_s), points_px))

    def event(self, topic: str, data: Mapping[str, Any]) -> None:
        """A message of a JSON topic, with the current time."""
        self._put(("event", topic, self._clock.now_s(), data))

    def now_s(self) -> float:
        """Time on the cell's clock."""
        return self._clock.now_s()

    @property
    def waiting_bytes(self) -> int:
        """Bytes that the recorder's process has not read from the ring yet."""
        return 0 if self._ring is None else self._ring.waiting_bytes

    @property
    def process_id(self) -> int | None:
        """Id of the process that writes; None = it was not started."""
        return None if self._process is None else self._process.pid

    def pause(self) -> None:
        """Pause after the last frame: the decision is computed, and needs the processor."""
        if self._ring is not None:
            self._ring.pause(time.monotonic() + PAUSE_S)

    def resume(self) -> None:
        """Resume after the decision."""
        if self._ring is not None:
            self._ring.pause(0.0)

    def log(self, record: logging.LogRecord) -> None:
        """A line of the program's log."""
        now_s = self._clock.now_s()
        self._put(("log", now_s, record.levelname, record.name, record.getMessage()))

    def _mark_gap(self, t_s: float) -> None:
        lost = self._lost_frames
        gap = {"first": lost[0], "frames": len(lost), "cause": "the recorder was too slow"}
        if self._put(("event", form.GAP, t_s, gap)):
            self._lost_frames = []
            self.note(f"not recorded: {counted(len(lost), 'frame')}; the computer was too slow")

    def _put(
        self, header: tuple[Any, ...], payload: NDArray[Any] | None = None, spare: int = 0
    ) -> bool:
        if not self._under_way or self._ring is None:
            return True
        with self._lock:
            done = self._ring.put(header, payload, spare)
            if not done and header[0] != "frame" and not self._full:
                self._full = True
                self.note("the recorder was too slow: messages of this cycle are missing")
            with suppress(BlockingIOError):  # it has been woken often enough
                try:
                    os.write(self._wake, b"\0")
                except BrokenPipeError:
                    self._has_ended()
        return done

    def _has_ended(self) -> None:
        self._under_way = False
        self._waiting = 0
        self.note("the recorder's process has ended: this cycle is recorded in part")

    # --- its reports ------------------------------------------------------------------------------

    def _read_reports(self) -> None:
        with suppress(BlockingIOError, OSError):
            while data := os.read(self._status, 65536):
                for line in data.decode().splitlines():
                    self._waiting -= 1
                    self._report(json.loads(line))

    def _report(self, report: Mapping[str, Any]) -> None:
        path = report["path"]
        if "error" in report:
            rest = "nothing of it is there any more"
            if Path(path).parent.exists():
                rest = f"`cell recover {path}` reads what is there"
            self.note(f"{path} is torn: {report['error']}; {rest}")
        elif lost := [
            f"{n} {kind}" for kind in ("frames", "messages") if (n := report.get(f"lost_{kind}"))
        ]:
            self.note(f"{path}: {' and '.join(lost)} are missing: {report['cause']}")
        elif report["kept"]:
            size = report["bytes"] / 1e6
            _LOG.info("%s: %d frames, %.0f MB, verified", path, report["frames"], size)
        if why := report.get("not_reduced"):
            self.note(f"{path}: all of its frames are kept whole: {why}")

    def note(self, note: str) -> None:
        """Log a message for a person, and keep it for the end of the run."""
        _LOG.warning("recording: %s", note)
        self.notes.append(note)

    def forget(self) -> None:
        """Let the process write its pending messages, and end."""
        for descriptor in (self._wake, self._status):
            with suppress(OSError):
                os.close(descriptor)
        writer, self._process, self._ring, self._waiting = self._process, None, None, 0
        if writer is None:
            return
        try:
            writer.wait(LAST_WAIT_S)
        except subprocess.TimeoutExpired:
            writer.kill()
            writer.wait()


#: Loggers of the program, whose lines are recorded.
_LOGGERS = ("cell", "drivers", "calib")


class _Handler(logging.Handler):
    """Passes lines of the log to the recorder, except its own."""

    def __init__(self, recorder: Recorder) -> None:
        super().__init__(logging.INFO)
        self._recorder = recorder

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler`."""
        if record.name != __name__:
            self._recorder.log(record)


class _PoseStream(GuardedThread):
    """Reads measured poses from the arm continuously, until `end`."""

    def __init__(self, recorder: Recorder, arm: Arm, begin_s: float) -> None:
        super().__init__("poses", self._take_all, self._died)
        self._recorder = recorder
        self._arm = arm
        self._after_s = begin_s
        self._over = threading.Event()

    def _take_all(self) -> None:
        while not self._over.wait(POSES_EVERY_S):
            self._take()
        self._take()

    def end(self) -> None:
        """Read the remaining poses, and stop."""
        self._over.set()
        self.join()

    def _died(self, error: BaseException) -> None:
        self._recorder.note(f"measured poses are missing from here on: {error_text(error)}")

    def _take(self) -> None:
        try:
            poses = self._arm.log(self._after_s, self._recorder.now_s())
        except DeviceError:
            return
        new = poses.t_s > self._after_s
        if np.any(new):
            self._after_s = float(poses.t_s[-1])
            columns = (poses.t_s, poses.x_m, poses.y_m, poses.angle_rad)
            self._recorder.poses(form.MEASURED, Trajectory(*(c[new] for c in columns)))
