"""Checks each picture of a recording as it arrives, and refuses faulty ones.

Every picture is checked when it comes: none is missing, repeated, late, of another size or one
too many to be kept.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from drivers.interfaces import CameraError, DeviceError, Frame, Image

SLOW_REMEDY = "shorten the exposure, lower the frame rate, or use a faster bus or computer"
_MISSING_REMEDY = "check cable and load, or lower the frame rate, then record again"


@dataclass(frozen=True)
class Shot:
    """One picture as a source gives it, with its stamp and number.

    image    (H, W) grey levels; None = not requested
    stamp_s  the camera's own time of the exposure, from any origin; None = it has none
    number   the camera's own count; None = it has none
    """

    image: Image | None
    stamp_s: float | None = None
    number: int | None = None


@dataclass(frozen=True)
class CaptureOptions:
    """Requirements on a stream of pictures.

    latency_s           from the middle of an exposure to the arrival of its picture, at best:
                        exposure, readout and transport.  Measured by calibration each session,
                        for no camera tells; a wrong value shifts all times of a session alike
    connect_s           longest time until pictures come at the requested rate
    lost_after_s        the camera is lost when no picture came for so long, or for three periods
                        if those last longer
    rate_tolerance      allowed departure of the measured from the camera's own frame rate
    buffer_frames       pictures that may wait to be read
    settle_frames       pictures over which rate and origin of the stamps are measured
    late_s              longest time that a picture may come later than the quickest ones do
    """

    latency_s: float = 0.0
    connect_s: float = 5.0
    lost_after_s: float = 0.055
    rate_tolerance: float = 0.05
    buffer_frames: int = 512
    settle_frames: int = 40
    late_s: float = 0.5

    def __post_init__(self) -> None:
        for name in ("connect_s", "lost_after_s", "rate_tolerance", "late_s"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"capture.{name} = {getattr(self, name)}: must be > 0")
        if not self.latency_s >= 0.0:
            raise ValueError(f"capture.latency_s = {self.latency_s} s: must be ≥ 0")
        for name, least in (("buffer_frames", 1), ("settle_frames", 2)):
            if getattr(self, name) < least:
                raise ValueError(f"capture.{name} = {getattr(self, name)}: must be ≥ {least}")


def check_settings(
    width_px: int, height_px: int, frame_rate_hz: float, exposure_s: float | None
) -> None:
    """Check that a camera's settings are positive.  Raises ValueError."""
    numbers = {"width_px": width_px, "height_px": height_px, "frame_rate_hz": frame_rate_hz}
    if exposure_s is not None:
        numbers["exposure_s"] = exposure_s
    for name, value in numbers.items():
        if not value > 0:
            raise ValueError(f"camera.{name} = {value}: must be > 0")


@dataclass(frozen=True)
class ArrivedShot:
    """A picture, and when it arrived."""

    shot: Shot
    arrived_s: float


class FrameSequence:
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
        self._origin_s = origin_s  # arrival time minus stamp
        self._period_s = 1.0 / rate_hz
        self._options = options
        self._taken = 0
        self._first_s = 0.0
        self._last: Frame | None = None
        self._last_number: int | None = None

    @property
    def complete(self) -> bool:
        """Whether no more pictures are expected."""
        return self.error is not None or self._taken == self._count

    def take(self, arrived: ArrivedShot) -> None:
        """Add a picture, if it was exposed after the start."""
        shot, options = arrived.shot, self._options
        reached_s = arrived.arrived_s
        if shot.stamp_s is not None:
            reached_s = shot.stamp_s + self._origin_s
        t_s = reached_s - options.latency_s
        if shot.image is None or t_s < self._start_s:
            return
        frame = Frame(self._taken, t_s, shot.image)
        self.error = self._fault(frame, shot, arrived.arrived_s - reached_s)
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
                f"{which} came {late_s:.3f} s late, allowed {options.late_s:.3f} s", SLOW_REMEDY
            )
        last = self._last
        if last is None:
            missing = (frame.t_s - self._start_s) / self._period_s - 1.0
            if missing > 0.5 and shot.stamp_s is not None:
                return self._error(f"{_pictures(round(missing))} missing before the first")
            return None
        if shot.number is not None and self._last_number is not None:
            missing = shot.number - self._last_number - 1
            if missing != 0:
                return self._error(
                    f"{_pictures(missing)} missing before {which}: the camera's count goes from "
                    f"{self._last_number} to {shot.number}"
                )
        else:
            missing = round((frame.t_s - last.t_s) / self._period_s) - 1
            if missing > 0:
                return self._error(
                    f"{_pictures(missing)} missing before {which}: "
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
                SLOW_REMEDY,
            )
        return None

    def _error(self, cause: str, remedy: str = _MISSING_REMEDY) -> CameraError:
        return CameraError(self._device, cause, remedy)


def _same(a: Image, b: Image) -> bool:
    """Whether two pictures are equal and not blank: a covered lens is not a frozen camera."""
    return np.array_equal(a[::16], b[::16]) and np.array_equal(a, b) and bool(a.min() != a.max())


def _size(image: Image) -> str:
    return f"{image.shape[1]} × {image.shape[0]}"


def _pictures(count: int) -> str:
    return f"{count} picture" if count == 1 else f"{count} pictures"
