"""Limits around an arm, a gripper and a camera, real and simulated alike.

A guard has the interface of its device, and requests only necessary data from it.  It guards
the cable and the tooling from mistakes of the program; it is not a safety function.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from drivers.around import ArmAround, CameraAround, GripperAround
from drivers.interfaces import (
    Arm,
    Camera,
    CameraError,
    Clock,
    FloatArray,
    Frame,
    Gripper,
    GripperState,
    Image,
    LimitError,
    Pose,
    Trajectory,
    nothing_to_revise,
)

_LOG = logging.getLogger(__name__)

_NOTHING_MOVED = "nothing was moved"

#: Shortest time over which speed, acceleration and jerk of a sampled path are judged: below it,
#: rounding of its times would count as jerk.
_SPAN_S = 0.008

#: Share of a limit that finite differences may exceed it by, if the sampled motion itself keeps it.
_DERIVATIVE_TOLERANCE = 0.01


@dataclass(frozen=True)
class ArmLimits:
    """Limits of the gripping point's place and motion.

    tolerance_m, tolerance_rad  allowed excess of a pose over its range: a path that begins at a
                                measured pose on the limit has the arm's noise and rounding;
                                several times an arm's repeatability of 0.03 mm
    """

    x_min_m: float
    x_max_m: float
    y_min_m: float
    y_max_m: float
    angle_min_rad: float
    angle_max_rad: float
    max_speed_m_per_s: float
    max_acceleration_m_per_s2: float
    max_jerk_m_per_s3: float
    max_angular_speed_rad_per_s: float = 1.0
    max_angular_acceleration_rad_per_s2: float = 20.0
    max_angular_jerk_rad_per_s3: float = 1000.0
    start_tolerance_m: float = 0.001
    start_tolerance_rad: float = 0.01
    tolerance_m: float = 1e-4
    tolerance_rad: float = 1e-3


#: Paths count as equal within this distance, m or rad.
SAME_PATH = 1e-6


class GuardedArm(ArmAround):
    """An arm that refuses a path outside its limits before anything of it is sent."""

    def __init__(self, arm: Arm, limits: ArmLimits) -> None:
        super().__init__(arm)
        self._limits = limits
        self._followed: tuple[Trajectory, float] | None = None

    def check(self, path: Trajectory) -> None:
        """Raises LimitError naming point, value and limit; else as the arm."""
        check_path(path, self._limits, self.name)
        self._arm.check(path)

    def follow(self, path: Trajectory, start_s: float | None = None) -> None:
        """Raises LimitError naming point, value and limit; else as the arm."""
        here = self._arm.state().pose
        not_begun = f"this path was not begun; the gripper is at {_described(here)}"
        check_path(path, self._limits, self.name, not_begun)
        self._check_start(path, here, not_begun)
        end = Pose(float(path.x_m[-1]), float(path.y_m[-1]), float(path.angle_rad[-1]))
        _LOG.info("%s: %.2f s to %s", self.name, path.t_s[-1] - path.t_s[0], _described(end))
        self._arm.follow(path, start_s)
        self._followed = None if start_s is None else (path, start_s)

    def revise(self, path: Trajectory, from_s: float) -> None:
        """Raises LimitError naming point, value and limit; else as the arm."""
        if self._followed is None:
            raise nothing_to_revise(self.name)
        present, start_s = self._followed
        remedy = "its path is followed as it was"
        check_path(path, self._limits, self.name, remedy)
        until_s = from_s - start_s + float(present.t_s[0])
        # both are linear between their points: no other times need a comparison
        points_s = np.union1d(present.t_s, path.t_s)
        t_s = np.append(points_s[points_s < until_s], until_s)
        for name in ("x_m", "y_m", "angle_rad"):
            then, now = (np.interp(t_s, p.t_s, getattr(p, name)) for p in (present, path))
            at = int(np.argmax(np.abs(now - then)))
            if abs(now[at] - then[at]) > SAME_PATH:
                raise LimitError(
                    self.name,
                    f"the new path leaves the present one {until_s - t_s[at]:.3f} s too early: "
                    f"{name} = {now[at]:.6f} instead of {then[at]:.6f}",
                    remedy,
                )
        self._arm.revise(path, from_s)
        self._followed = path, start_s
        _LOG.info("%s: path changed from %.3f s on", self.name, until_s)

    def stop(self, reason: str) -> None:
        """Stop now; latched."""
        self._arm.stop(reason)
        _LOG.warning("%s: stop: %s", self.name, reason)  # which may wait for a disk

    def _check_start(self, path: Trajectory, pose: Pose, not_begun: str) -> None:
        start = path.at(float(path.t_s[0]))
        limits = self._limits
        for name, unit, value, present, tolerance in (
            ("x", "m", start.x_m, pose.x_m, limits.start_tolerance_m),
            ("y", "m", start.y_m, pose.y_m, limits.start_tolerance_m),
            ("angle", "rad", start.angle_rad, pose.angle_rad, limits.start_tolerance_rad),
        ):
            if abs(value - present) > tolerance:
                raise LimitError(
                    self.name,
                    f"the path starts at {name} = {value:.4f} {unit}, but the arm is at "
                    f"{present:.4f} {unit} (tolerance {tolerance:.4f} {unit})",
                    not_begun,
                )


def _described(pose: Pose) -> str:
    return f"x = {pose.x_m:.4f} m, y = {pose.y_m:.4f} m, angle = {pose.angle_rad:.4f} rad"


def check_path(
    path: Trajectory, limits: ArmLimits, device: str = "arm", remedy: str = _NOTHING_MOVED
) -> None:
    """Check that a path may be sent.

    A pose may exceed its range by the stated tolerance; speed, acceleration and jerk their limit by
    1 %.  These are divided differences over at least 8 ms, with the arm at rest before the first
    and after the last point.

    remedy  of the error: the present situation and the next action
    raises  LimitError: naming the first point at fault, its value and the limit
    """
    columns = {"x": path.x_m, "y": path.y_m, "angle": path.angle_rad}

    def refuse(cause: str) -> NoReturn:
        raise LimitError(device, cause, remedy)

    for name, values in {"t": path.t_s, **columns}.items():
        if np.ndim(values) != 1 or np.shape(values) != np.shape(path.t_s):
            refuse(f"{name} has shape {np.shape(values)}, t {np.shape(path.t_s)}")
        if not np.all(np.isfinite(values)):
            at = int(np.argmin(np.isfinite(values)))
            refuse(f"point {at + 1} of {len(values)} has {name} = {values[at]}")
    count = len(path.t_s)
    if count < 2:
        refuse(f"the path has {count} points, at least 2 are needed")
    steps_s = np.diff(path.t_s)
    if np.any(steps_s <= 0.0):
        at = int(np.argmax(steps_s <= 0.0)) + 1
        refuse(
            f"point {at + 1} of {count} has t = {path.t_s[at]:.6f} s, "
            f"not later than {path.t_s[at - 1]:.6f} s"
        )
    travel = np.stack([path.x_m, path.y_m], axis=-1)
    turn = path.angle_rad[:, None]
    ranges = [
        ("x", "m", path.x_m, limits.x_min_m, limits.x_max_m, limits.tolerance_m),
        ("y", "m", path.y_m, limits.y_min_m, limits.y_max_m, limits.tolerance_m),
        ("angle", "rad", path.angle_rad, limits.angle_min_rad, limits.angle_max_rad,
         limits.tolerance_rad),
    ]  # fmt: skip
    for name, unit, values, order, high in (
        ("speed", "m/s", travel, 1, limits.max_speed_m_per_s),
        ("acceleration", "m/s²", travel, 2, limits.max_acceleration_m_per_s2),
        ("jerk", "m/s³", travel, 3, limits.max_jerk_m_per_s3),
        ("angular speed", "rad/s", turn, 1, limits.max_angular_speed_rad_per_s),
        ("angular acceleration", "rad/s²", turn, 2, limits.max_angular_acceleration_rad_per_s2),
        ("angular jerk", "rad/s³", turn, 3, limits.max_angular_jerk_rad_per_s3),
    ):
        size = _derivative_at_points(path.t_s, values, order)
        ranges.append((name, unit, size, 0.0, high, _DERIVATIVE_TOLERANCE * high))
    for name, unit, values, low, high, tolerance in ranges:
        outside = (values < low - tolerance) | (values > high + tolerance)
        if np.any(outside):
            at = int(np.argmax(outside))
            refuse(
                f"point {at + 1} of {count} has {name} = {values[at]:.4f} {unit}, "
                f"allowed {low:.4f}..{high:.4f} {unit}"
            )


def _derivative_at_points(t_s: FloatArray, values: FloatArray, order: int) -> FloatArray:
    """(T,) largest size of a derivative near each point; `values` (T, k), norm over k."""
    steps_s = np.diff(t_s)
    step_s = float(np.median(steps_s))
    stride = max(1, int(np.ceil(_SPAN_S / step_s / order)))
    # where a path has fewer points than elsewhere, fewer of them span as much
    least = max(1, min(stride, int(np.ceil(_SPAN_S / float(steps_s.max()) / order))))
    out = np.zeros(len(t_s))
    for k in range(least, stride + 1):
        np.maximum(out, _differences(t_s, values, order, k, step_s), out=out)
    return out


def _differences(
    t_s: FloatArray, values: FloatArray, order: int, stride: int, step_s: float
) -> FloatArray:
    """(T,) the same by every `stride`-th point, where such points span long enough.

    step_s  between the points, at rest, that are added before the first and after the last
    """
    pad = order * stride
    before = t_s[0] - step_s * np.arange(pad, 0, -1)
    after = t_s[-1] + step_s * np.arange(1, pad + 1)
    t = np.concatenate([before, t_s, after])
    difference = np.concatenate(
        [np.repeat(values[:1], pad, axis=0), values, np.repeat(values[-1:], pad, axis=0)]
    )
    for k in range(1, order + 1):
        reach = t[k * stride :] - t[: -k * stride]
        difference = k * (difference[stride:] - difference[:-stride]) / reach[:, None]
    size = np.linalg.norm(difference, axis=-1)
    if pad * step_s < _SPAN_S:  # only steps longer than usual make it long enough
        size[t[pad:] - t[:-pad] < _SPAN_S] = 0.0
    out = np.zeros(len(t_s))
    centre = np.arange(len(size)) + (order * stride) // 2 - pad
    np.maximum.at(out, np.clip(centre, 0, len(t_s) - 1), size)
    return out


@dataclass(frozen=True)
class GripperLimits:
    """Forces that hold a cable without crushing it."""

    min_force_n: float
    max_force_n: float


class GuardedGripper(GripperAround):
    """A gripper that refuses a force outside its limits."""

    def __init__(self, gripper: Gripper, limits: GripperLimits) -> None:
        super().__init__(gripper)
        self._limits = limits

    def grip(self, force_n: float) -> GripperState:
        """Raises LimitError naming force and limits; else as the gripper."""
        low, high = self._limits.min_force_n, self._limits.max_force_n
        if not low <= force_n <= high:
            raise LimitError(
                self.name,
                f"force = {force_n:.4f} N, allowed {low:.4f}..{high:.4f} N",
                _NOTHING_MOVED,
            )
        return self._gripper.grip(force_n)


@dataclass(frozen=True)
class CameraLimits:
    """Limits of a recording's frame times.

    period_tolerance  allowed departure of the time between frames from the camera's period, as a
                      fraction of that period
    max_latency_s     longest time from exposure until a frame is handed over, for a reader that
                      is waiting for it
    """

    period_tolerance: float = 0.5
    max_latency_s: float = 0.5


class GuardedCamera(CameraAround):
    """A camera whose missing, late, repeated or disordered frames are an error, never silence."""

    def __init__(self, camera: Camera, clock: Clock, limits: CameraLimits | None = None) -> None:
        super().__init__(camera)
        self._clock = clock
        self._limits = limits if limits is not None else CameraLimits()
        self._wanted = 0
        self._count = 0
        self._last: Frame | None = None

    def start(self, frame_count: int) -> None:
        """Raises LimitError: fewer than one frame; else as the camera."""
        if frame_count < 1:
            raise LimitError(self.name, f"{frame_count} frames asked for, at least 1 is needed")
        self._wanted, self._count, self._last = frame_count, 0, None
        self._camera.start(frame_count)

    def read(self) -> Frame | None:
        """Raises CameraError naming the frame that is missing, late, repeated or out of order."""
        called_s = self._clock.now_s()
        frame = self._camera.read()
        if frame is None:
            if self._count < self._wanted:
                self._fail(f"only {self._count} of {self._wanted} frames came")
            return None
        which = f"frame {frame.index + 1} of {self._wanted}"
        if frame.index != self._count:
            self._fail(f"{which} came where frame {self._count + 1} was due")
        waited_s = self._clock.now_s() - max(called_s, frame.t_s)
        if waited_s > self._limits.max_latency_s:
            self._fail(
                f"{which} came {waited_s:.3f} s late, allowed {self._limits.max_latency_s:.3f} s"
            )
        if self._last is not None:
            self._check_follows(frame, self._last, which)
        self._count, self._last = self._count + 1, frame
        return frame

    def stop(self) -> None:
        """End a recording early."""
        self._camera.stop()
        self._wanted = self._count = 0

    def _check_follows(self, frame: Frame, last: Frame, which: str) -> None:
        period_s = 1.0 / self.frame_rate_hz
        passed_s = frame.t_s - last.t_s
        if abs(passed_s - period_s) > self._limits.period_tolerance * period_s:
            self._fail(
                f"{which} was exposed {passed_s * 1e3:.3f} ms after the one before, "
                f"expected {period_s * 1e3:.3f} ms"
            )
        if _same(frame.image, last.image) and frame.image.min() != frame.image.max():
            self._fail(f"{which} repeats the picture before: the camera is frozen")

    def _fail(self, cause: str) -> NoReturn:
        self._camera.stop()
        raise CameraError(
            self.name, cause, "check cable, load and frame rate of the camera, then record again"
        )


def _same(image: Image, other: Image) -> bool:
    """Whether two pictures are equal; one pixel in 256 nearly always shows a difference."""
    return bool(
        np.array_equal(image[::16, ::16], other[::16, ::16]) and np.array_equal(image, other)
    )
