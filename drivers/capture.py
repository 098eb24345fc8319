"""Recording from a streaming camera: a thread takes and counts every picture.

A camera library is a `Source`.  The parts common to all are here: the deadline of opening,
slow and silent cameras, and the origin of the camera's timestamps; faults of single pictures are
in `recording`.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Protocol

import numpy as np

from drivers.interfaces import (
    CameraError,
    Clock,
    ConnectError,
    DeviceError,
    DeviceLostError,
    Frame,
)
from drivers.priority import raise_thread
from drivers.recording import SLOW_REMEDY, ArrivedShot, CaptureOptions, FrameSequence, Shot
from drivers.threads import GuardedThread, error_text

_LOG = logging.getLogger(__name__)

#: Above all computations, below the arm: a picture that is not read in time is lost.
_PRIORITY = 8
_LEAST_PERIODS = 3.0  # of silence before a camera is lost
_WAKING_S = 0.002
_LOST_REMEDY = "check the camera's cable and power, then reset"


class FrameSource(Protocol):
    """An open camera that streams; used by one thread only."""

    @property
    def rate_hz(self) -> float:
        """Frame rate read back from the camera, Hz."""
        ...

    def grab(self, wanted: Callable[[], bool]) -> Shot | None:
        """The next picture, waiting for it; None = none came yet.

        wanted  whether the image itself is wanted; called when it has arrived
        raises  DeviceLostError: no further picture will come; CameraError: it is unusable
        """
        ...

    def close(self) -> None:
        """Release the camera.  Does not raise."""
        ...


class StreamingCamera:
    """Camera whose pictures a thread takes, so that a slow reader delays none.

    open_source  opens a camera, sets it up and reads it back; raises ConnectError.  It may hang
                 for longer than `connect_s`: then its thread is abandoned, and releases the
                 camera once it is open.
    """

    def __init__(
        self,
        open_source: Callable[[], FrameSource],
        options: CaptureOptions,
        clock: Clock,
        name: str = "camera",
    ) -> None:
        self.name = name
        self._open_source = open_source
        self._options = options
        self._clock = clock
        self._stream: _Stream | None = None
        self._rate_hz = 0.0

    @property
    def frame_rate_hz(self) -> float:
        """Frame rate read back from the camera, Hz; 0 before the first `connect`."""
        return self._rate_hz

    @property
    def latency_s(self) -> float:
        """Time from the middle of an exposure to the arrival of its picture, s."""
        return self._options.latency_s

    def connect(self) -> None:
        """Open the camera and check that pictures arrive.  Raises ConnectError."""
        self.close()
        stream = _Stream(self._open_source, self._options, self._clock, self.name)
        try:
            self._rate_hz = stream.settle()
        except DeviceError:
            stream.quit(wait_s=0.0)
            raise
        self._stream = stream
        _LOG.info("%s: connected, pictures at %.1f Hz", self.name, self._rate_hz)

    def close(self) -> None:
        """Release the camera; safe to call twice."""
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.quit(wait_s=1.0)

    def check(self) -> None:
        """Raises DeviceLostError: no pictures come; CameraError: the recording is unusable."""
        self._connected_stream().check()

    def start(self, frame_count: int) -> None:
        """Raises CameraError: fewer than one frame; DeviceLostError: no pictures come."""
        if frame_count < 1:
            raise CameraError(self.name, f"{frame_count} frames asked for, at least 1 is needed")
        self._connected_stream().start(frame_count)

    def read(self) -> Frame | None:
        """Next picture.  Raises CameraError: missing, frozen, slow, late, not read in time;
        DeviceLostError: none came for too long.
        """
        return None if self._stream is None else self._stream.read()

    def stop(self) -> None:
        """End a recording early."""
        if self._stream is not None:
            self._stream.stop()

    def _connected_stream(self) -> _Stream:
        if self._stream is None:
            raise DeviceLostError(self.name, "not connected", "connect first")
        return self._stream


class _Stream:
    """A connection: its thread, and the state shared by the thread and the callers."""

    def __init__(
        self,
        open_source: Callable[[], FrameSource],
        options: CaptureOptions,
        clock: Clock,
        device: str,
    ) -> None:
        self._open_source = open_source
        self._options = options
        self._clock = clock
        self._device = device
        self._changed = threading.Condition()
        self._quit = threading.Event()
        self._rate_hz: float | None = None
        self._recent: deque[ArrivedShot] = deque(maxlen=max(2, options.settle_frames))
        self._error: DeviceError | None = None
        self._recording: FrameSequence | None = None
        self._thread = GuardedThread(device, self._run, self._died)
        self._thread.start()

    # --- the thread ---------------------------------------------------------------------------

    def _run(self) -> None:
        raise_thread(_PRIORITY)
        try:
            source = self._open_source()
            try:
                with self._changed:
                    self._rate_hz = source.rate_hz
                    self._changed.notify_all()
                while not self._quit.is_set():
                    shot = source.grab(self._wanted)
                    if shot is not None:
                        self._store(ArrivedShot(shot, self._clock.now_s()))
            finally:
                source.close()
        except DeviceError as error:
            self._fail(error)

    def _died(self, error: BaseException) -> None:
        """Report an uncaught error of the camera library as the loss of the camera."""
        self._fail(DeviceLostError(self._device, error_text(error), _LOST_REMEDY))

    def _wanted(self) -> bool:
        recording = self._recording
        return recording is not None and not recording.complete

    def _store(self, arrived: ArrivedShot) -> None:
        with self._changed:
            self._recent.append(ArrivedShot(_without_image(arrived.shot), arrived.arrived_s))
            recording = self._recording
            if recording is not None and not recording.complete:
                recording.take(arrived)
            self._changed.notify_all()

    def _fail(self, error: DeviceError) -> None:
        _LOG.warning("%s", error)
        with self._changed:
            self._error = error
            self._changed.notify_all()

    # --- the callers --------------------------------------------------------------------------

    def quit(self, wait_s: float) -> None:
        """End the thread; one that hangs in the camera's library ends when that returns."""
        self._quit.set()
        with self._changed:
            self._recording = None
        if wait_s > 0.0:
            self._thread.join(wait_s)

    def settle(self) -> float:
        """Wait until pictures come at the camera's rate; that rate, Hz.  Raises ConnectError."""
        until_s = self._clock.now_s() + self._options.connect_s
        with self._changed:
            while True:
                if self._error is not None:
                    raise _as_connect_error(self._error)
                measured_hz = self._measured_hz()
                if self._rate_hz is not None and measured_hz is not None:
                    departure = abs(measured_hz / self._rate_hz - 1.0)
                    if departure <= self._options.rate_tolerance:
                        return self._rate_hz
                remaining_s = until_s - self._clock.now_s()
                if remaining_s <= 0.0:
                    raise self._not_settled(measured_hz)
                self._changed.wait(remaining_s)

    def check(self) -> None:
        with self._changed:
            self._check_alive()
            if self._recording is not None and self._recording.error is not None:
                raise self._recording.error

    def start(self, frame_count: int) -> None:
        with self._changed:
            self._check_alive()
            assert self._rate_hz is not None  # since `settle`
            origin_s = min(
                (t.arrived_s - t.shot.stamp_s for t in self._recent if t.shot.stamp_s is not None),
                default=0.0,
            )
            self._recording = FrameSequence(
                frame_count,
                self._clock.now_s(),
                origin_s,
                self._rate_hz,
                self._options,
                self._device,
            )

    def read(self) -> Frame | None:
        overslept_s = 0.0  # time in which this process was not run is not the camera's silence
        with self._changed:
            while (recording := self._recording) is not None:
                if recording.waiting:
                    return recording.waiting.popleft()
                if recording.complete:
                    self._recording = None
                    if recording.error is not None:
                        raise recording.error
                    return None
                try:
                    remaining_s = self._check_alive(overslept_s)
                except DeviceLostError:
                    self._recording = None
                    raise
                due_s = self._clock.now_s() + remaining_s
                self._changed.wait(remaining_s)
                overslept_s += max(0.0, self._clock.now_s() - due_s - _WAKING_S)
        return None

    def stop(self) -> None:
        with self._changed:
            self._recording = None
            self._changed.notify_all()

    def _check_alive(self, overslept_s: float = 0.0) -> float:
        """Seconds that the next picture may still take.  Raises DeviceLostError."""
        if self._error is not None:
            cause, remedy = self._error.cause, self._error.remedy
            raise DeviceLostError(self._device, cause, remedy or _LOST_REMEDY)
        assert self._rate_hz is not None
        allowed_s = max(self._options.lost_after_s, _LEAST_PERIODS / self._rate_hz) + overslept_s
        silent_s = self._clock.now_s() - self._recent[-1].arrived_s
        if silent_s > allowed_s:
            raise DeviceLostError(
                self._device,
                f"no picture came for {silent_s:.3f} s, allowed {allowed_s:.3f} s",
                _LOST_REMEDY,
            )
        return allowed_s - silent_s + 1e-3

    def _measured_hz(self) -> float | None:
        """Rate of the last pictures: by their arrival, or by their stamps if that differs more."""
        if len(self._recent) < self._options.settle_frames or self._rate_hz is None:
            return None
        first, last = self._recent[0], self._recent[-1]
        spans_s = [last.arrived_s - first.arrived_s]
        if first.shot.stamp_s is not None and last.shot.stamp_s is not None:
            spans_s.append(last.shot.stamp_s - first.shot.stamp_s)
        rates = [(len(self._recent) - 1) / max(span_s, 1e-9) for span_s in spans_s]
        expected_hz = self._rate_hz
        return max(rates, key=lambda rate_hz: abs(np.log(rate_hz / expected_hz)))

    def _not_settled(self, measured_hz: float | None) -> ConnectError:
        waited = f"within {self._options.connect_s:.1f} s"
        if self._rate_hz is None:
            return ConnectError(
                self._device, f"it did not open {waited}", "check address, cable and power"
            )
        if measured_hz is None:
            return ConnectError(
                self._device, f"only {len(self._recent)} pictures came {waited}", _LOST_REMEDY
            )
        return ConnectError(
            self._device,
            f"slow or uneven: {measured_hz:.1f} Hz measured, {self._rate_hz:.1f} Hz expected",
            SLOW_REMEDY,
        )


def _as_connect_error(error: DeviceError) -> ConnectError:
    if isinstance(error, ConnectError):
        return error
    return ConnectError(error.device, error.cause, error.remedy)


def _without_image(shot: Shot) -> Shot:
    return Shot(None, shot.stamp_s, shot.number)
