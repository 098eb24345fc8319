"""Twin of a gripper: takes the cables of the simulated world, misses them or lets them slip."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from drivers.interfaces import (
    ConnectError,
    DeviceLostError,
    DeviceTimeoutError,
    GripError,
    GripperState,
    LimitError,
)
from drivers.sim.world import SimWorld

_LOST_REMEDY = "check the gripper's cable and power, then reset"


@dataclass(frozen=True)
class GripperFaults:
    """Faults of a gripper; times on the cell's clock, None = never.

    They last until `faults` is set again.
    """

    refuses_to_connect: bool = False
    lost_at_s: float | None = None
    misses: bool = False  # the jaws miss the cable
    slips_at_s: float | None = None  # the cable falls out of the closed jaws
    slides_at_s: float | None = None  # the cable is pulled out by slides_m but stays held
    slides_m: float = 0.0
    jams: bool = False  # the jaws move, but never come to rest in time


@dataclass(frozen=True)
class GripperTwinOptions:
    """Properties of the simulated gripper."""

    open_m: float = 0.085
    cable_thickness_m: float = 0.0001
    closing_s: float = 0.4
    timeout_s: float = 3.0


class SimGripper:
    """A gripper in a simulated world."""

    def __init__(
        self, world: SimWorld, options: GripperTwinOptions | None = None, name: str = "gripper"
    ) -> None:
        self.name = name
        self._world = world
        self._clock = world.clock
        self._options = options if options is not None else GripperTwinOptions()
        self._opening_m = self._options.open_m
        self._faults = GripperFaults()
        self._connected = False

    @property
    def faults(self) -> GripperFaults:
        """Active faults; may be set at any time."""
        return self._faults

    @faults.setter
    def faults(self, faults: GripperFaults) -> None:
        self._faults = faults
        for t_s, act in ((faults.slips_at_s, self._slip), (faults.slides_at_s, self._slide)):
            if t_s is not None:
                self._clock.call_at(t_s, partial(self._unless_replaced, faults, act))
        self._clock.forward_to_s(self._clock.now_s())

    def connect(self) -> None:
        """Raises ConnectError."""
        if self._faults.refuses_to_connect or self._lost():
            raise ConnectError(self.name, "the gripper does not answer", _LOST_REMEDY)
        self._connected = True

    def close(self) -> None:
        """Disconnect, leaving the jaws as they are."""
        self._connected = False

    def grip(self, force_n: float) -> GripperState:
        """Raises LimitError: force ≤ 0; GripError; DeviceTimeoutError; DeviceLostError."""
        self._check_alive()
        if not force_n > 0.0:
            raise LimitError(self.name, f"force = {force_n} N, must be > 0", "nothing was moved")
        self._move_jaws()
        taken = not self._faults.misses and self._world.take()
        self._opening_m = self._options.cable_thickness_m if taken else 0.0
        if not taken:
            raise GripError(
                self.name, "nothing between the jaws", "present a cable at the grasping place"
            )
        return self.state()

    def release(self) -> GripperState:
        """Raises DeviceTimeoutError; DeviceLostError."""
        self._check_alive()
        if self._opening_m < self._options.open_m:
            self._world.drop()
            self._move_jaws()
            self._opening_m = self._options.open_m
        return self.state()

    def state(self) -> GripperState:
        """Raises DeviceLostError."""
        self._check_alive()
        return GripperState(self._clock.now_s(), self._opening_m, self._world.holds, moving=False)

    def _move_jaws(self) -> None:
        if self._faults.jams:
            self._clock.sleep_s(self._options.timeout_s)
            raise DeviceTimeoutError(
                self.name,
                f"the jaws did not come to rest within {self._options.timeout_s:.1f} s",
                "clear the jaws",
            )
        self._clock.sleep_s(self._options.closing_s)
        self._check_alive()

    def _lost(self) -> bool:
        return self._faults.lost_at_s is not None and (
            self._clock.now_s() >= self._faults.lost_at_s
        )

    def _check_alive(self) -> None:
        if self._lost():
            self._connected = False
            raise DeviceLostError(self.name, "the gripper fell silent", _LOST_REMEDY)
        if not self._connected:
            raise DeviceLostError(self.name, "not connected", "connect first")

    def _unless_replaced(self, faults: GripperFaults, act: Callable[[], None]) -> None:
        if faults is self._faults:
            act()

    def _slip(self) -> None:
        self._world.lose()
        if self._opening_m < self._options.open_m:
            self._opening_m = 0.0

    def _slide(self) -> None:
        self._world.slide(self._faults.slides_m)
