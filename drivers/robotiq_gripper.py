"""Common part of the drivers of a Robotiq-type gripper (2F-85): states, motions and faults.

source  Robotiq, "2F-85 & 2F-140 Instruction Manual"

The gripper itself decides whether something is between its jaws, by being stopped before they
meet.  It cannot tell 0.1 mm from nothing: the fingertips must be made so that empty jaws close
further than jaws on a cable.
"""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from drivers.interfaces import (
    Clock,
    ConnectError,
    DeviceError,
    DeviceLostError,
    DeviceTimeoutError,
    GripError,
    GripperState,
    LimitError,
)

_LOG = logging.getLogger(__name__)

_ACTIVE = 3
_MOVING, _STOPPED_CLOSING = 0, 2
_FASTEST = 255

_FAULTS = {
    0x05: "action delayed until the activation is complete",
    0x07: "not activated",
    0x08: "too hot",
    0x09: "no communication for 1 s",
    0x0A: "supply voltage too low",
    0x0B: "automatic release in progress",
    0x0C: "internal fault",
    0x0D: "activation fault: something blocks the jaws",
    0x0E: "overcurrent",
    0x0F: "automatic release completed",
}
#: Lowest fault codes that hinder a motion, and that only an activation clears; upper bound of all
#: codes.
_FAULT, _NEEDS_ACTIVATION, _NO_FAULT = 0x08, 0x0A, 0x100


@dataclass(frozen=True, kw_only=True)
class RobotiqOptions:
    """Scales of the gripper's counts, and its longest time of motion.

    motion_s      time that a motion or the activation may take
    stroke_m      opening at count 0
    closed_count  count at which empty jaws meet
    force_n       forces of the counts 0 and 255
    """

    motion_s: float = 5.0
    poll_s: float = 0.005
    stroke_m: float = 0.085
    closed_count: int = 230
    force_n: tuple[float, float] = (20.0, 235.0)


@dataclass(frozen=True)
class GripperStatus:
    """Reported state of the gripper.

    activation  3 = active
    object      0 = the jaws move, 2 = stopped while closing, 3 = arrived
    requested   commanded count
    """

    activation: int
    object: int
    going: bool
    fault: int
    requested: int
    count: int

    @property
    def active(self) -> bool:
        """Whether it is activated."""
        return self.activation == _ACTIVE

    @property
    def moving(self) -> bool:
        """Whether the jaws move."""
        return self.going and self.object == _MOVING

    @property
    def holding(self) -> bool:
        """Whether something between the jaws has stopped them."""
        return self.going and self.object == _STOPPED_CLOSING


@dataclass(frozen=True)
class GripperAction:
    """Command to the gripper; all counts 0 … 255."""

    active: bool
    going: bool = False
    count: int = 0
    speed: int = 0
    force: int = 0


class RobotiqGripper(ABC):
    """A gripper over any connection.  Its state may be read from any thread.

    place   address of the connection, for messages
    remedy  for a person when there is no gripper
    """

    def __init__(
        self, options: RobotiqOptions, clock: Clock, name: str, place: str, remedy: str
    ) -> None:
        self.name = name
        self._jaws = options
        self._clock = clock
        self._place = place
        self._remedy = remedy
        self._lock = threading.RLock()

    # --- connection -----------------------------------------------------------------------------

    @abstractmethod
    def _open(self) -> None:
        """Open the connection.  Raises OSError, DeviceError."""

    @abstractmethod
    def close(self) -> None:
        """Close the connection, leaving the jaws as they are."""

    @abstractmethod
    def _status(self) -> GripperStatus:
        """Raises DeviceLostError, the connection being closed then."""

    @abstractmethod
    def _act(self, action: GripperAction) -> None:
        """Raises DeviceLostError, the connection being closed then."""

    # --- gripper --------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open the connection and activate, unless it is active: activation would open the jaws.

        Raises ConnectError.
        """
        with self._lock:
            self.close()
            try:
                self._open()
                if not self._status().active:
                    self._activate()
            except (OSError, DeviceError) as error:
                self.close()
                cause = error.cause if isinstance(error, DeviceError) else str(error)
                raise ConnectError(
                    self.name, f"no gripper on {self._place}: {cause}", self._remedy
                ) from error
        _LOG.info("%s: connected on %s", self.name, self._place)

    def grip(self, force_n: float) -> GripperState:
        """Raises LimitError: not a force of this gripper; GripError; DeviceTimeoutError."""
        low, high = self._jaws.force_n
        if not low <= force_n <= high:
            raise LimitError(
                self.name, f"force = {force_n} N, allowed {low}..{high} N", "nothing was moved"
            )
        _LOG.info("%s: grip with %g N", self.name, force_n)
        state = self._move(255, round(255 * (force_n - low) / (high - low)))
        if not state.holding:
            raise GripError(
                self.name, "nothing between the jaws", "present a cable at the grasping place"
            )
        return state

    def release(self) -> GripperState:
        """Raises DeviceTimeoutError; DeviceLostError."""
        _LOG.info("%s: release", self.name)
        return self._move(0, 0)

    def state(self) -> GripperState:
        """Raises DeviceLostError: no answer, or its power was off meanwhile."""
        status = self._status()
        if not status.active:
            self.close()
            raise DeviceLostError(self.name, "is no longer active", self._remedy)
        return GripperState(
            self._clock.now_s(), self._opening_m(status.count), status.holding, status.moving
        )

    def _opening_m(self, count: int) -> float:
        return self._jaws.stroke_m * max(0.0, 1.0 - count / self._jaws.closed_count)

    def _activate(self) -> None:
        self._act(GripperAction(active=False))
        self._wait(lambda status: status.activation == 0, "activation", hindering=_NO_FAULT)
        self._act(GripperAction(active=True))
        self._wait(lambda status: status.active, "activation")

    def _move(self, count: int, force: int) -> GripperState:
        with self._lock:
            self._act(GripperAction(True, True, count, _FASTEST, force))
            # the echo of the request distinguishes this motion's answer from the last one's
            self._wait(lambda s: s.requested == count and s.going and not s.moving, "motion")
            return self.state()

    def _wait(
        self, done: Callable[[GripperStatus], bool], action: str, hindering: int = _FAULT
    ) -> None:
        until_s = self._clock.now_s() + self._jaws.motion_s
        while True:
            status = self._status()
            finished = done(status)
            # a fault that only an activation clears stops the jaws in any case
            if status.fault >= (max(hindering, _NEEDS_ACTIVATION) if finished else hindering):
                reason = _FAULTS.get(status.fault, "unknown")
                raise DeviceError(
                    self.name, f"fault 0x{status.fault:02X}: {reason}", "clear it and connect again"
                )
            if finished:
                return
            if self._clock.now_s() > until_s:
                raise DeviceTimeoutError(
                    self.name,
                    f"{action} not finished within {self._jaws.motion_s:.1f} s",
                    "clear the jaws",
                )
            self._clock.sleep_s(self._jaws.poll_s)
