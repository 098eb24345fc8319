"""Context of the steps of a cycle: devices, task, commands, and the second process."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any

from calib.plane import PlaneView
from cell.cable.arrays import FloatArray
from cell.cable.geometry import Cable, node_arc_lengths
from cell.identify.individual import IdentifyOptions
from cell.plan.choose import ChoiceOptions
from cell.plan.destination import Destination
from cell.plan.paths import MotionLimits
from cell.run.clocks import CalibratedDelays
from cell.run.commands import Commands
from cell.vision.detect import VisionOptions
from drivers.interfaces import Devices, Pose


@dataclass(frozen=True)
class Task:
    """The task for every cable; `model` is the hash of the assumptions for all cables."""

    cable: Cable
    destination: Destination
    home: Pose
    aside: Pose
    calm_s: float
    still_s: float
    lower_m: float
    lower_s: float
    hold_s: float
    decide_s: float
    offsets_m: tuple[float, ...]
    advance_m: float
    settle_s: float
    lowering: MotionLimits
    insertion: MotionLimits
    force_n: float
    view: PlaneView
    vision: VisionOptions
    identification: IdentifyOptions
    choice: ChoiceOptions
    model: str
    map_std_m: float = 0.0
    """Standard deviation of a point's position by the view, both axes combined."""
    least_hold_s: float | None = None
    """A hold may end after this if more frames would not matter; None = always after `hold_s`."""
    feedback: bool = False
    """Whether an insertion is corrected while it is made."""
    retries: int = 0
    """Number of further tries for a cable that was stopped in front of the opening."""
    delays: CalibratedDelays | None = None
    """None = latency and lag are typed, without uncertainty."""

    @property
    def lowered(self) -> Pose:
        """Where the gripper is held while the cable swings."""
        return Pose(self.home.x_m, self.home.y_m - self.lower_m, self.home.angle_rad)

    @property
    def longest_advance_m(self) -> float:
        """Longest way of the gripper to the left."""
        return self.advance_m + self.choice.freely.further_m

    @property
    def arc_length_m(self) -> FloatArray:
        """(nodes,) arc lengths of the nodes that the camera measures, tip first."""
        return node_arc_lengths(self.cable.length_m, self.vision.nodes)


@dataclass(frozen=True)
class Timing:
    """Rates of arm and camera, and the arm's lag."""

    arm_rate_hz: float
    arm_lag_s: float
    frame_rate_hz: float


@dataclass(frozen=True)
class Station:
    """Devices, task, commands that may interrupt it, and the executor of computations.

    others  tasks that may replace this one
    """

    devices: Devices
    task: Task
    commands: Commands
    computer: Executor
    others: tuple[Task, ...] = ()

    @property
    def timing(self) -> Timing:
        """Timing of the devices."""
        arm, camera = self.devices.arm, self.devices.camera
        return Timing(arm.rate_hz, arm.lag_s, camera.frame_rate_hz)


@dataclass(frozen=True, eq=False)
class ProductTask:
    """Task for every cable of a product, with the settings that it comes from.

    name         None = the settings have no products
    settings     as resolved, for the records
    files        texts that the settings refer to, by path
    calibration  hash of the calibration's files; None = as typed
    """

    name: str | None
    task: Task
    settings: Mapping[str, Any]
    files: Mapping[str, str] = field(default_factory=dict)
    calibration: str | None = None
