"""Interfaces of the devices: Arm, Camera, Gripper, Clock, their data and their errors.

All data of a device are in the cell's plane and on the cell's clock: x right, y up, metres,
radians, seconds.  The drivers map them to the frames of their robot or camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]


# --- data -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pose:
    """Gripping point in the cell's plane; `angle_rad` 0 = level, positive = pointing down."""

    x_m: float
    y_m: float
    angle_rad: float = 0.0


@dataclass(frozen=True)
class Trajectory:
    """Poses against time, from `t_s[0] = 0`; every array has shape (T,), T ≥ 2.

    Used for commanded paths and, with times on the cell's clock, for measured poses.
    """

    t_s: FloatArray
    x_m: FloatArray
    y_m: FloatArray
    angle_rad: FloatArray

    def at(self, t_s: float) -> Pose:
        """Pose at a time, by linear interpolation, held before the first and after the last."""
        return Pose(
            float(np.interp(t_s, self.t_s, self.x_m)),
            float(np.interp(t_s, self.t_s, self.y_m)),
            float(np.interp(t_s, self.t_s, self.angle_rad)),
        )


class ArmMode(StrEnum):
    """State of the robot's controller: ready, or why it refuses to move."""

    READY = "ready"
    STOPPED = "stopped"  # stopped by us, latched until reset()
    PROTECTIVE_STOP = "protective_stop"
    SAFEGUARD_STOP = "safeguard_stop"
    EMERGENCY_STOP = "emergency_stop"
    POWER_OFF = "power_off"  # or its brakes are on
    LOCAL_CONTROL = "local_control"
    REDUCED_SPEED = "reduced_speed"  # it would not follow commands in time
    LOST = "lost"

    @property
    def remedy(self) -> str:
        """Instruction to a person to make it ready."""
        return _REMEDIES[self]


_REMEDIES = {
    ArmMode.READY: "",
    ArmMode.STOPPED: "acknowledge and reset",
    ArmMode.PROTECTIVE_STOP: "find the cause, unlock at the pendant after 5 s, then reset",
    ArmMode.SAFEGUARD_STOP: "close the guard and acknowledge at the pendant, then reset",
    ArmMode.EMERGENCY_STOP: "release the button, power on at the pendant, then reset",
    ArmMode.POWER_OFF: "power on and release the brakes at the pendant, then reset",
    ArmMode.LOCAL_CONTROL: "switch the pendant to remote control, then reset",
    ArmMode.REDUCED_SPEED: "set the speed slider to 100 % at the pendant, then reset; for slow "
    "motions use `cell run --dry-run --speed`",
    ArmMode.LOST: "check the controller's power and network, then reset",
}


@dataclass(frozen=True)
class ArmState:
    """Measured state of an arm at `t_s` on the cell's clock."""

    t_s: float
    pose: Pose
    speed_m_per_s: float
    moving: bool
    mode: ArmMode


@dataclass(frozen=True)
class Frame:
    """One picture: `image` (H, W) grey levels, exposed at `t_s` (mid-exposure, cell's clock)."""

    index: int
    t_s: float
    image: Image


@dataclass(frozen=True)
class GripperState:
    """State of a gripper: jaw opening, and whether something is between the jaws."""

    t_s: float
    opening_m: float
    holding: bool
    moving: bool


# --- errors -----------------------------------------------------------------------------------


class DeviceError(Exception):
    """A device failed to carry out a command: its name, the cause, and the remedy for a person.

    Scenario: any of the errors below; catch this one to stop the cell for every device.

    code  kind of the error as a word, for statistics
    """

    code = "device"

    def __init__(self, device: str, cause: str, remedy: str = "") -> None:
        super().__init__(f"{device}: {cause}" + (f"; {remedy}" if remedy else ""))
        self.device = device
        self.cause = cause
        self.remedy = remedy


class ConnectError(DeviceError):
    """The device cannot be reached.  Scenario: cable unplugged, wrong address, power off."""

    code = "connect"


class DeviceLostError(DeviceError):
    """A connected device fell silent.  Scenario: network drop in the middle of a motion."""

    code = "lost"


class DeviceTimeoutError(DeviceError):
    """The device answers but did not finish in time.  Scenario: a jaw blocked half way."""

    code = "timeout"


class LimitError(DeviceError):
    """A command is outside the limits; nothing was sent.  Scenario: offset beyond the cell."""

    code = "limit"


class TooLateError(LimitError):
    """A command is for a moment that has gone by; nothing was sent.  Scenario: a busy computer."""


def too_late(device: str, late_s: float) -> TooLateError:
    """Error of an arm that is commanded to start at a moment in the past."""
    return TooLateError(
        device,
        f"told {late_s * 1e3:.1f} ms after the moment at which it was to start",
        "tell it earlier; nothing was moved",
    )


def revised_too_late(device: str, late_s: float) -> TooLateError:
    """Error of an arm that is commanded to change its path from a moment in the past."""
    return TooLateError(
        device,
        f"told {late_s * 1e3:.1f} ms after the moment from which its path was to change",
        "tell it earlier; its path is followed as it was",
    )


def nothing_to_revise(device: str) -> LimitError:
    """Error of an arm that is commanded to change its path while it follows none."""
    return LimitError(device, "follows no path that could be changed", "nothing was moved")


class StoppedError(DeviceError):
    """The device is stopped and must be reset by a person.  Scenario: protective stop.

    mode  cause of the stop; the code distinguishes a slowed speed slider from a protective stop
    """

    def __init__(
        self, device: str, cause: str, remedy: str = "", mode: ArmMode = ArmMode.STOPPED
    ) -> None:
        super().__init__(device, cause, remedy)
        self.code = mode.value


class GripError(DeviceError):
    """Nothing, or no longer anything, between the jaws.  Scenario: the cable was missed."""

    code = "grip"


class CameraError(DeviceError):
    """Frames are missing, late or unusable.  Scenario: a frozen or overloaded camera."""

    code = "frames"


# --- devices ----------------------------------------------------------------------------------


@runtime_checkable
class Clock(Protocol):
    """Time of the cell: real, or simulated and then forwarded without waiting."""

    def now_s(self) -> float:
        """Seconds since an arbitrary start; never goes back."""
        ...

    def sleep_s(self, duration_s: float) -> None:
        """Let `duration_s` ≥ 0 pass."""
        ...


@runtime_checkable
class Arm(Protocol):
    """A robot arm that carries the gripping point through the cell's plane."""

    name: str

    @property
    def lag_s(self) -> float:
        """Known delay between a commanded and the executed pose, s."""
        ...

    @property
    def rate_hz(self) -> float:
        """Rate at which poses are streamed, Hz."""
        ...

    def connect(self) -> None:
        """Open the connection.  Raises ConnectError."""
        ...

    def close(self) -> None:
        """Stop and disconnect; safe to call twice and on a lost device."""
        ...

    def state(self) -> ArmState:
        """Measured state.  Raises DeviceLostError."""
        ...

    def check(self, path: Trajectory) -> None:
        """Whether `path` may be followed, once the arm is where it begins; nothing is sent.

        Raises LimitError with the violated limit; DeviceLostError.
        """
        ...

    def follow(self, path: Trajectory, start_s: float | None = None) -> None:
        """Start to follow `path` (its first pose is the present one) and return at once.

        The times of `path` count from `start_s` on the cell's clock, None = now.  The checks
        before it take time, so a command for a certain start must come earlier.  Raises LimitError
        (outside the limits, still moving on another path, or the start has gone by; nothing was
        sent), StoppedError, DeviceLostError.
        """
        ...

    def revise(self, path: Trajectory, from_s: float) -> None:
        """Follow `path` instead of the present path from a moment on; returns at once.

        Its times count from where those of the present path count, and until `from_s`, on the
        cell's clock, it is the present path.  All of it is taken or nothing: when it is refused the
        present path is followed to its end.  Raises LimitError (outside the limits, another path
        before `from_s`, no path is followed, or `from_s` has gone by), StoppedError,
        DeviceLostError.
        """
        ...

    def log(self, start_s: float, end_s: float) -> Trajectory:
        """Measured poses with start_s ≤ t ≤ end_s on the cell's clock, as far as they are known."""
        ...

    def stop(self, reason: str) -> None:
        """Stop now; from any thread; latched until `reset`, so never lost.  Does not raise."""
        ...

    def reset(self) -> None:
        """Clear our own stop, after a person's acknowledgement; never one of the controller's.

        Raises StoppedError while the controller itself is stopped.
        """
        ...


@runtime_checkable
class Camera(Protocol):
    """A camera that looks at the cell's plane from the side."""

    name: str

    @property
    def frame_rate_hz(self) -> float:
        """Frame rate that was read back from the camera, Hz."""
        ...

    def connect(self) -> None:
        """Open the camera.  Raises ConnectError."""
        ...

    def close(self) -> None:
        """Release the camera; safe to call twice."""
        ...

    def check(self) -> None:
        """Check that pictures arrive; from any thread.

        Raises DeviceLostError; CameraError (a picture of the recording is missing or unusable).
        """
        ...

    def start(self, frame_count: int) -> None:
        """Begin to record `frame_count` frames from now on and return at once."""
        ...

    def read(self) -> Frame | None:
        """Next recorded frame, in order, waiting for it; None when all were read.

        Raises CameraError (a frame is missing or late), DeviceLostError.
        """
        ...

    def stop(self) -> None:
        """End a recording early; frames not read yet are dropped.  Does not raise."""
        ...


@runtime_checkable
class Gripper(Protocol):
    """A parallel gripper."""

    name: str

    def connect(self) -> None:
        """Open the connection and activate.  Raises ConnectError."""
        ...

    def close(self) -> None:
        """Disconnect, leaving the jaws as they are; safe to call twice."""
        ...

    def grip(self, force_n: float) -> GripperState:
        """Close the jaws and return when they rest.  Raises GripError if nothing is held."""
        ...

    def release(self) -> GripperState:
        """Open the jaws and return when they rest."""
        ...

    def state(self) -> GripperState:
        """Present state.  Raises DeviceLostError."""
        ...


@dataclass(frozen=True)
class Devices:
    """Arm, camera, gripper, and the clock they share."""

    arm: Arm
    camera: Camera
    gripper: Gripper
    clock: Clock
