"""What the steps of a cycle work with: devices and task, and what is handed from step to step."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib.plane import PlaneView
from cell.cable.geometry import Cable, Motion, node_arc_lengths
from cell.identify.identified import Identified
from cell.identify.individual import IdentifyOptions, hold_trial
from cell.identify.noise import estimate_noise, still_frames
from cell.identify.predicted_frames import PredictedFrames
from cell.plan.choose import ChoiceOptions, Forecast
from cell.plan.destination import Destination
from cell.plan.paths import MotionLimits
from cell.run.commands import Commands
from cell.study.data import Markers, Study, Trial
from cell.vision.detect import VisionOptions
from cell.vision.marks import pixels_per_metre
from cell.vision.recording import steady_nodes
from cell.vision.sighting import Sighting
from drivers.interfaces import Arm, Camera, Clock, Frame, Gripper, Pose, Trajectory

FloatArray = NDArray[np.float64]

#: Error of one coordinate of a node in motion.  At rest less is seen of it, because how the tip
#: falls between the pixels is then the same in every frame.
NODE_ERROR_PX = 0.1


@dataclass(frozen=True)
class Devices:
    """Everything that moves, sees or holds, and the clock they share."""

    arm: Arm
    camera: Camera
    gripper: Gripper
    clock: Clock


@dataclass(frozen=True)
class Task:
    """What is to be done with every cable."""

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

    @property
    def lowered(self) -> Pose:
        """Where the hand is held while the cable swings."""
        return Pose(self.home.x_m, self.home.y_m - self.lower_m, self.home.angle_rad)

    @property
    def arc_length_m(self) -> FloatArray:
        """(nodes,) where on the cable the camera measures, tip first."""
        return node_arc_lengths(self.cable.free_length_m, self.vision.nodes)


@dataclass(frozen=True)
class Timing:
    """Rates of arm and camera, and by how much the arm follows late."""

    arm_rate_hz: float
    arm_lag_s: float
    frame_rate_hz: float


@dataclass(frozen=True)
class Station:
    """Devices, the task, the commands that may interrupt it, and who computes meanwhile."""

    devices: Devices
    task: Task
    commands: Commands
    computer: Executor

    @property
    def timing(self) -> Timing:
        """That of the devices."""
        arm, camera = self.devices.arm, self.devices.camera
        return Timing(arm.rate_hz, arm.lag_s, camera.frame_rate_hz)


@dataclass(frozen=True)
class Filming:
    """A motion that is being filmed.

    It began at `begin_s`, the hand rests from `rest_s`, and it is filmed until `end_s`; sightings
    and pictures are those of the frames so far.
    """

    begin_s: float
    rest_s: float
    end_s: float
    frame_count: int
    sightings: tuple[Sighting, ...] = ()
    pictures: tuple[Frame, ...] = field(default=(), repr=False)


@dataclass(frozen=True, eq=False)
class Candidates:
    """What each offset would do if its path began at `start_s`: paths in the arm's own frame."""

    start_s: float
    paths: tuple[Trajectory, ...]
    forecast: Forecast


@dataclass(frozen=True, eq=False)
class EarlyEstimate:
    """What the first frames of a hold say: nearly the last word, and ready when it is needed.

    predicted   what the frames to come will show, if this is the cable
    """

    identified: Identified
    predicted: PredictedFrames
    prospect: Candidates


@dataclass(frozen=True)
class Filmed:
    """A motion that was filmed, on the cell's clock.

    begin_s     when filming began
    sightings   one per frame
    hand        measured poses, from before the first frame to after the last
    pictures    a few of the frames, to look at later
    seen_at_s   when the last frame was taken, by the computer's own clock
    early       what was computed while the filming went on, if anything
    """

    begin_s: float
    sightings: tuple[Sighting, ...]
    hand: Trajectory
    pictures: tuple[Frame, ...] = field(repr=False)
    seen_at_s: float
    early: EarlyEstimate | None = None


def held_trial(filmed: Filmed) -> Trial:
    """The hold as a trial, time counted from the first frame; the hand where the camera saw it."""
    sightings, hand, zero_s = filmed.sightings, filmed.hand, filmed.begin_s
    return hold_trial(
        Motion(hand.t_s - zero_s, hand.x_m, hand.y_m, hand.angle_rad),
        np.array([s.t_s - zero_s for s in sightings]),
        steady_nodes(sightings),
        np.array([s.grip_m for s in sightings]),
        np.array([s.clamp_angle_rad for s in sightings]),
    )


def executed_trial(held: Trial, before: Filmed, after: Filmed) -> Trial:
    """The execution as a trial: it begins in equilibrium, hence with the hand's motion before."""
    beside = hand_offset_m_rad(before.hand, held.grip)
    zero_s = before.begin_s
    later = after.hand.t_s > before.hand.t_s[-1]
    hands = [moved(before.hand, beside), moved(after.hand, beside)]
    grip = [
        np.concatenate([getattr(hands[0], name), getattr(hands[1], name)[later]])
        for name in ("t_s", "x_m", "y_m", "angle_rad")
    ]
    return Trial(
        "execute",
        "validate",
        "equilibrium",
        Motion(grip[0] - zero_s, *grip[1:]),
        Markers(
            np.array([s.t_s - zero_s for s in after.sightings]),
            steady_nodes(after.sightings),
        ),
    )


def study_of(name: str, task: Task, trials: Sequence[Trial]) -> Study:
    """Trials of one cable as a study; its noise is the camera's in motion, or more if seen at rest.

    The first trial begins at rest.
    """
    markers, grip = trials[0].markers, trials[0].grip
    at_rest = estimate_noise([markers.xy_m[still_frames(markers.t_s, grip)]])
    grip_px = task.view.to_pixels(np.array([grip.x_m[0], grip.y_m[0]]))
    in_motion_m = NODE_ERROR_PX / pixels_per_metre(task.view, grip_px)
    noise_m = max(in_motion_m, 0.0 if at_rest is None else at_rest[0])
    return Study(name, task.cable, task.arc_length_m, tuple(trials), noise_std_m=noise_m)


def hand_offset_m_rad(logged: Trajectory, seen: Motion) -> FloatArray:
    """(3,) x, y, angle by which the camera sees the hand beside where the arm says it is."""
    return np.array(
        [
            seen.x_m[0] - logged.x_m[0],
            seen.y_m[0] - logged.y_m[0],
            seen.angle_rad[0] - logged.angle_rad[0],
        ]
    )


def moved(path: Trajectory, by: FloatArray) -> Trajectory:
    """Trajectory with `by` (3,) added to x, y and angle."""
    return Trajectory(path.t_s, path.x_m + by[0], path.y_m + by[1], path.angle_rad + by[2])
