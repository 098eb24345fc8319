"""Recording from a camera that streams: a thread takes every picture, and counts.

A camera library is a `Source`.  Everything else is the same for all of them and lives here: the
deadline of opening, the bounded buffer, missing, frozen, slow and silent cameras, and the mapping
of the camera's time stamps onto the cell's clock.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from drivers.interfaces import (
    CameraError,
    Clock,
    ConnectError,
    DeviceError,
    DeviceLostError,
    Frame,
    Image,
)

_SLOW_REMEDY = "shorten the exposure, lower the frame rate, or use a faster bus or computer"
_LOST_REMEDY = "check the camera's cable and power, then connect again"
_MISSING_REMEDY = "check cable and load, or lower the frame rate, then record again"


@dataclass(frozen=True)
class Shot:
    """What a source says of one picture.

    image    (H, W) grey levels; None = not asked for
    stamp_s  the camera's own time of the exposure, from any origin; None = it has none
    number   the camera's own count; None = it has none
    """

    image: Image | None
    stamp_s: float | None = None
    number: int | None = None


class Source(Protocol):
    """An open camera that streams; used by one thread only."""

    @property
    def rate_hz(self) -> float:
        """Frame rate read back from the camera, Hz."""
        ...

    def grab(self, wanted: Callable[[], bool]) -> Shot | None:
        """The next picture, waiting for it; None = none came yet.

        wanted  whether the image itself is wanted, asked when it is there
        raises  DeviceLostError: there will be no more; CameraError: it is unusable
        """
        ...

    def close(self) -> None:
        """Release the camera.  Does not raise."""
        ...


@dataclass(frozen=True)
class CaptureOptions:
    """What is asked of the stream of pictures.

    latency_s           from the middle of an exposure to the arrival of its picture, at best:
                        exposure, readout and transport.  Measured by calibration each session,
                        for no camera tells; a wrong value shifts all times of a session alike
    connect_s           longest time until pictures come at the rate asked for
    lost_after_periods  the camera is lost when no picture came for so many periods
    rate_tolerance      allowed departure of the measured from the camera's own frame rate
    buffer_frames       pictures that may wait to be read
    settle_frames       pictures over which the rate is measured, and the stamps' origin found
    late_s              longest time that a picture may come later than the quickest ones do
    """

    latency_s: float = 0.0
    connect_s: float = 5.0
    lost_after_periods: float = 30.0
    rate_tolerance: float = 0.05
    buffer_frames: int = 512
    settle_frames: int = 40
    late_s: float = 0.5

    def __post_init__(self) -> None:
        for name in ("connect_s", "lost_after_periods", "rate_tolerance", "late_s"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"capture.{name} = {getattr(self, name)}: must be > 0")
        if not self.latency_s >= 0.0:
            raise ValueError(f"capture.latency_s = {self.latency_s} s: must be ≥ 0")
        for name, least in (("buffer_frames", 1), ("settle_frames", 2)):
            if getattr(self, name) < least:
                raise ValueError(f"capture.{name} = {getattr(self, name)}: must be ≥ {least}")


class StreamingCamera:
    """A camera whose pictures a thread of its own takes, so that no reader holds anything up.

    open_source  opens a camera, sets it up and reads it back; raises ConnectError.  It may hang
                 for longer than `connect_s`: then its thread is left behind, and releases the
                 camera when it gets it.
    """

    def __init__(
        self,
        open_source: Callable[[], Source],
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

    def connect(self) -> None:
        """Open the camera and see pictures come.  Raises ConnectError."""
        self.close()
        stream = _Stream(self._open_source, self._options, self._clock, self.name)
        try:
            self._rate_hz = stream.settle()
        except DeviceError:
            stream.quit(wait_s=0.0)
            raise
        self._stream = stream

    def close(self) -> None:
        """Release the camera; safe to call twice."""
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.quit(wait_s=1.0)

    def start(self, frame_count: int) -> None:
        """Raises CameraError: fewer than one frame; DeviceLostError: no pictures come."""
        if frame_count < 1:
            raise CameraError(self.name, f"{frame_count} frames asked for, at least 1 is needed")
        if self._stream is None:
            raise DeviceLostError(self.name, "not connected", "connect first")
        self._stream.start(frame_count)

    def read(self) -> Frame | None:
        """Next picture.  Raises CameraError: missing, frozen, slow, late, not read in time;
        DeviceLostError: none came for too long.
        """
        return None if self._stream is None else self._stream.read()

    def stop(self) -> None:
        """End a recording early."""
        if self._stream is not None:
            self._stream.stop()


@dataclass(frozen=True)
class _Taken:
    shot: Shot
    arrived_s: float


class _Recording:
    """Frames of one `start`, checked one by one as they come."""

    def __init__(
        self,
        frame_count: int,
        start_s: float,
        origin_s: float,
        rate_hz: float,
        options: CaptureOptions,
        device: str,
    ) -> None:
        self.waiting: deque[Frame] = deque()
        self.error: DeviceError | None = None
        self._device = device
        self._count = frame_count
        self._start_s = start_s
        self._origin_s = origin_s  # what is added to a stamp to have the time of its arrival
        self._period_s = 1.0 / rate_hz
        self._options = options
        self._taken = 0
        self._first_s = 0.0
        self._last: Frame | None = None
        self._last_number: int | None = None

    @property
    def complete(self) -> bool:
        """Whether no more pictures are to be taken."""
        return self.error is not None or self._taken == self._count

    def take(self, taken: _Taken) -> None:
        """Add a picture, if it was exposed after the start."""
        shot, options = taken.shot, self._options
        reached_s = taken.arrived_s
        if shot.stamp_s is not None:
            reached_s = shot.stamp_s + self._origin_s
        t_s = reached_s - options.latency_s
        if shot.image is None or t_s < self._start_s:
            return
        frame = Frame(self._taken, t_s, shot.image)
        self.error = self._fault(frame, shot, taken.arrived_s - reached_s)
        if self.error is not None:
            return
        if self._taken == 0:
            self._first_s = t_s
        self.waiting.append(frame)
        self._taken += 1
        self._last, self._last_number = frame, shot.number

    def _fault(self, frame: Frame, shot: Shot, late_s: float) -> CameraError | None:
        options, which = self._options, f"picture {frame.index + 1} of {self._count}"
        if len(self.waiting) >= options.buffer_frames:
            return self._error(
                f"overflow: {len(self.waiting)} pictures wait to be read at {which}",
                "read while recording, or allow a larger buffer",
            )
        if late_s > options.late_s:
            return self._error(
                f"{which} came {late_s:.3f} s late, allowed {options.late_s:.3f} s", _SLOW_REMEDY
            )
        last = self._last
        if last is None:
            missing = (frame.t_s - self._start_s) / self._period_s - 1.0
            if missing > 0.5 and shot.stamp_s is not None:
                return self._error(f"{missing:.0f} pictures missing before the first")
            return None
        if shot.number is not None and self._last_number is not None:
            missing = shot.number - self._last_number - 1
            if missing != 0:
                return self._error(
                    f"{missing} pictures missing before {which}: the camera's count goes from "
                    f"{self._last_number} to {shot.number}"
                )
        else:
            missing = round((frame.t_s - last.t_s) / self._period_s) - 1
            if missing > 0:
                return self._error(
                    f"{missing} pictures missing before {which}: "
                    f"{(frame.t_s - last.t_s) * 1e3:.2f} ms after the one before, period "
                    f"{self._period_s * 1e3:.2f} ms"
                )
        if frame.t_s <= last.t_s:
            return self._error(
                f"the time of {which} is not later than the one before", _MISSING_REMEDY
            )
        if frame.image.shape != last.image.shape:
            return self._error(
                f"{which} is {_size(frame.image)} pixels, the one before {_size(last.image)}"
            )
        if _same(frame.image, last.image):
            return self._error(f"{which} repeats the one before: the camera is frozen")
        rate_hz = frame.index / (frame.t_s - self._first_s)
        if frame.index >= options.settle_frames and (
            rate_hz * self._period_s < 1.0 - options.rate_tolerance
        ):
            return self._error(
                f"slow: {rate_hz:.1f} Hz measured, {1.0 / self._period_s:.1f} Hz expected",
                _SLOW_REMEDY,
            )
        return None

    def _error(self, cause: str, remedy: str = _MISSING_REMEDY) -> CameraError:
        return CameraError(self._device, cause, remedy)


class _Stream:
    """One connection: its thread, and what the thread and the callers share."""

    def __init__(
        self,
        open_source: Callable[[], Source],
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
        self._recent: deque[_Taken] = deque(maxlen=max(2, options.settle_frames))
        self._error: DeviceError | None = None
        self._recording: _Recording | None = None
        self._thread = threading.Thread(target=self._run, name=device, daemon=True)
        self._thread.start()

    # --- the thread ---------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            source = self._open_source()
        except DeviceError as error:
            self._fail(error)
            return
        try:
            with self._changed:
                self._rate_hz = source.rate_hz
                self._changed.notify_all()
            while not self._quit.is_set():
                shot = source.grab(self._wanted)
                if shot is not None:
                    self._take(_Taken(shot, self._clock.now_s()))
        except DeviceError as error:
            self._fail(error)
        finally:
            source.close()

    def _wanted(self) -> bool:
        recording = self._recording
        return recording is not None and not recording.complete

    def _take(self, taken: _Taken) -> None:
        with self._changed:
            self._recent.append(_Taken(_without_image(taken.shot), taken.arrived_s))
            recording = self._recording
            if recording is not None and not recording.complete:
                recording.take(taken)
            self._changed.notify_all()

    def _fail(self, error: DeviceError) -> None:
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
                left_s = until_s - self._clock.now_s()
                if left_s <= 0.0:
                    raise self._not_settled(measured_hz)
                self._changed.wait(left_s)

    def start(self, frame_count: int) -> None:
        with self._changed:
            self._check_alive()
            assert self._rate_hz is not None  # since `settle`
            origin_s = min(
                (t.arrived_s - t.shot.stamp_s for t in self._recent if t.shot.stamp_s is not None),
                default=0.0,
            )
            self._recording = _Recording(
                frame_count,
                self._clock.now_s(),
                origin_s,
                self._rate_hz,
                self._options,
                self._device,
            )

    def read(self) -> Frame | None:
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
                    left_s = self._check_alive()
                except DeviceLostError:
                    self._recording = None
                    raise
                self._changed.wait(left_s)
        return None

    def stop(self) -> None:
        with self._changed:
            self._recording = None
            self._changed.notify_all()

    def _check_alive(self) -> float:
        """Seconds that the next picture may still take.  Raises DeviceLostError."""
        if self._error is not None:
            cause, remedy = self._error.cause, self._error.remedy
            raise DeviceLostError(self._device, cause, remedy or _LOST_REMEDY)
        assert self._rate_hz is not None
        allowed_s = self._options.lost_after_periods / self._rate_hz
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
            _SLOW_REMEDY,
        )


def _as_connect_error(error: DeviceError) -> ConnectError:
    if isinstance(error, ConnectError):
        return error
    return ConnectError(error.device, error.cause, error.remedy)


def _without_image(shot: Shot) -> Shot:
    return Shot(None, shot.stamp_s, shot.number)


def _same(a: Image, b: Image) -> bool:
    """Whether two pictures are equal and not blank: a covered lens is not a frozen camera."""
    return np.array_equal(a[::16], b[::16]) and np.array_equal(a, b) and bool(a.min() != a.max())


def _size(image: Image) -> str:
    return f"{image.shape[1]} × {image.shape[0]}"
