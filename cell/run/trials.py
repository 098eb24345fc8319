"""Converts filmed motions to trials of a study; time counts from the first frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Motion
from cell.identify.individual import hold_trial
from cell.identify.noise import estimate_noise, still_frames
from cell.run.findings import FilmedMotion
from cell.run.station import Task
from cell.study.data import Markers, Study, Trial
from cell.vision.marks import pixels_per_metre
from cell.vision.sighting import steady_nodes
from drivers.interfaces import Trajectory

#: Error of one coordinate of a node in motion.  At rest it shows less, because the position of
#: the tip between the pixels is then the same in every frame.
NODE_ERROR_PX = 0.1


def held_trial(filmed: FilmedMotion) -> Trial:
    """The hold as a trial, time counted from the first frame; the gripper as the
    camera detected it."""
    sightings, hand, zero_s = filmed.sightings, filmed.gripper_log, filmed.begin_s
    return hold_trial(
        Motion(hand.t_s - zero_s, hand.x_m, hand.y_m, hand.angle_rad),
        np.array([s.t_s - zero_s for s in sightings]),
        steady_nodes(sightings),
        np.array([s.grip_m for s in sightings]),
        np.array([s.clamp_angle_rad for s in sightings]),
    )


def executed_trial(held: Trial, before: FilmedMotion, after: FilmedMotion) -> Trial:
    """The execution as a trial: it begins in equilibrium, hence with the gripper's motion
    before."""
    offset = camera_offset_m_rad(before.gripper_log, held.grip)
    zero_s = before.begin_s
    later = after.gripper_log.t_s > before.gripper_log.t_s[-1]
    hands = [moved(before.gripper_log, offset), moved(after.gripper_log, offset)]
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
    """Study of one cable's trials; noise: the camera's in motion, or that at rest if larger.

    The first trial begins at rest.
    """
    markers, grip = trials[0].markers, trials[0].grip
    at_rest = estimate_noise([markers.xy_m[still_frames(markers.t_s, grip)]])
    grip_px = task.view.to_pixels(np.array([grip.x_m[0], grip.y_m[0]]))
    in_motion_m = NODE_ERROR_PX / pixels_per_metre(task.view, grip_px)
    noise_m = max(in_motion_m, 0.0 if at_rest is None else at_rest[0])
    noise_m = float(np.hypot(noise_m, task.map_std_m / np.sqrt(2.0)))
    return Study(name, task.cable, task.arc_length_m, tuple(trials), noise_std_m=noise_m)


def camera_offset_m_rad(logged: Trajectory, detected: Motion) -> FloatArray:
    """(3,) x, y, angle offset of the gripper as detected by the camera from its log."""
    return np.array(
        [
            detected.x_m[0] - logged.x_m[0],
            detected.y_m[0] - logged.y_m[0],
            detected.angle_rad[0] - logged.angle_rad[0],
        ]
    )


def moved(path: Trajectory, by: FloatArray) -> Trajectory:
    """Trajectory with `by` (3,) added to x, y and angle."""
    return Trajectory(path.t_s, path.x_m + by[0], path.y_m + by[1], path.angle_rad + by[2])
