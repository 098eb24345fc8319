"""The steps of a cycle, one function each.

With `waiting` and `filming`, and beside the `dry_run` and the `watch`, all that calls devices.

grasp → lower → hold and capture → identify → simulate → choose → execute → verify → release.
A measuring cycle: grasp → approach → measure → go home → release.
Every step takes the station (devices and task) and what the steps before it found, and returns what
it found itself; nothing is kept here.
"""

from __future__ import annotations

from concurrent.futures import BrokenExecutor
from dataclasses import replace

import numpy as np

from cell.identify.identified import Identified
from cell.identify.individual import CableRejectedError
from cell.identify.individual import identify as identify_cable
from cell.plan.choose import Choice
from cell.plan.choose import choose as choose_offset
from cell.plan.measuring import Measuring, measuring_path
from cell.plan.passage import Passage, measured_passage
from cell.plan.paths import (
    SAME_ANGLE_RAD,
    MotionLimits,
    identification_path,
    retreat_path,
)
from cell.run.early_estimate import EarlyEstimator
from cell.run.early_estimate import prospect as foretell
from cell.run.filming import capture, film
from cell.run.station import Candidates, Devices, EarlyEstimate, Filmed, Filming, Station
from cell.run.waiting import POLL_S, REST_TIMEOUT_S, await_rest, check_arm, wait_until
from cell.run.warm_up import warm_up as warm_up_engine
from cell.run.warm_up import warm_up_eyes
from cell.study.data import Trial
from drivers.interfaces import ArmMode, DeviceError, DeviceLostError, GripError, Pose, Trajectory

#: A hand this close to where it is sent is there already, m: an arm's repeatability, and too little
#: to set a cable swinging when the arm is brought the rest of the way.
AT_GOAL_M = 5e-5
#: One frame in so many is kept as a picture, during the hold and during the execution.
KEEP_EVERY_HELD, KEEP_EVERY_MOVING = 20, 4
#: So many times slower than an insertion a cable is brought to where it is measured, at rest.
APPROACH_SLOWER = 4.0
#: The arm is told so long before it is to start, because it first checks where a path leads, s.
AHEAD_S = 0.1
#: A forecast is corrected to first order, without simulating again, if its tips move less, m.
SMALL_SHIFT_M = 5e-4


# --- around the steps ---------------------------------------------------------------------------


def connect(station: Station) -> None:
    """Connect all devices, the one that moves last.  Raises ConnectError."""
    station.devices.gripper.connect()
    station.devices.camera.connect()
    station.devices.arm.connect()


def close(devices: Devices) -> None:
    """Disconnect all devices, each whatever happens to the others."""
    try:
        devices.arm.close()
    finally:
        try:
            devices.camera.close()
        finally:
            devices.gripper.close()


def stop(devices: Devices, reason: str) -> None:
    """Stop the arm now; from any thread; latched until `reset`."""
    devices.arm.stop(reason)


def halt(devices: Devices, reason: str) -> ArmMode:
    """Stop the arm and the recording, and wait until the arm rests; the jaws stay as they are.

    returns  the arm's mode at rest; LOST if it does not answer, and then nothing more is known
    """
    devices.arm.stop(reason)
    devices.camera.stop()
    end_s = devices.clock.now_s() + REST_TIMEOUT_S
    try:
        while (state := devices.arm.state()).moving and devices.clock.now_s() < end_s:
            devices.clock.sleep_s(POLL_S)
    except DeviceError:
        return ArmMode.LOST
    return state.mode


def is_past(station: Station, t_s: float) -> bool:
    """Whether it is too late to tell the arm to start at a moment."""
    return station.devices.clock.now_s() > t_s - AHEAD_S


def reset(station: Station) -> None:
    """Clear our own stop, empty the jaws and bring the hand home, level strokes first."""
    station.devices.arm.reset()
    station.commands.check()  # after the reset, so that a stop given meanwhile is not lost
    station.devices.gripper.release()
    go_home(station)


def go_home(station: Station) -> None:
    """Bring the hand from wherever it is to where cables are grasped."""
    _move(station, station.task.home, station.task.lowering)


def check_ready(station: Station) -> None:
    """Whether a cycle may begin: arm ready, jaws empty.  Raises a DeviceError that says why not."""
    check_arm(station)
    if station.devices.gripper.state().holding:
        raise GripError(station.devices.gripper.name, "holds something already", "empty the jaws")


def warm_up(station: Station) -> None:
    """Have everything compiled and loaded where it will be needed.  Raises DeviceLostError."""
    cable, kind = station.task.cable, station.task.identification.kind
    warm_up_engine(cable, kind)
    warm_up_eyes(station.task.vision)
    try:
        station.computer.submit(warm_up_engine, cable, kind).result()
    except BrokenExecutor as error:
        raise DeviceLostError(
            "computer",
            "the process that computes ahead ended as it began",
            "free memory; a script of your own must begin under `if __name__ == '__main__':`",
        ) from error


# --- the steps ----------------------------------------------------------------------------------


def grasp(station: Station) -> None:
    """Close the jaws on the cable and let it calm down.  Raises GripError."""
    station.devices.gripper.grip(station.task.force_n)
    wait_until(station, station.devices.clock.now_s() + station.task.calm_s)


def lower(station: Station) -> Filming:
    """Begin to film the cable at rest, then move it down so that it swings."""
    task = station.task
    path = identification_path(
        task.home,
        task.lower_m,
        task.lowering,
        station.devices.arm.rate_hz,
        duration_s=task.lower_s,
        hold_s=0.0,
    )
    return film(station, path, task.still_s, task.hold_s, KEEP_EVERY_HELD)


def hold_and_capture(station: Station, filming: Filming) -> Filmed:
    """Hold still while the cable swings, and find it in every frame as it comes.

    Somebody else computes ahead, so that little is left to be computed after the last frame.
    """
    ahead = EarlyEstimator(station, filming)
    try:
        filmed = capture(station, filming, KEEP_EVERY_HELD, ahead.look)
        return replace(filmed, early=ahead.found())
    finally:
        ahead.close()


def identify(station: Station, trial: Trial, early: EarlyEstimate | None = None) -> Identified:
    """This cable's parameters.  Raises CableRejectedError."""
    task = station.task
    return identify_cable(
        trial,
        task.arc_length_m,
        task.cable,
        previous=None if early is None else early.identified,
        predicted=None if early is None else early.predicted,
        options=task.identification,
    )


def settled(station: Station, trial: Trial, identified: Identified) -> Identified:
    """The same cable without haste, for the record: no step is left linear from early frames.

    As it was if the fit finds nothing better; the choice was made with that.
    """
    task = station.task
    try:
        return identify_cable(
            trial, task.arc_length_m, task.cable, previous=identified, options=task.identification
        )
    except CableRejectedError:
        return identified


def simulate(
    station: Station, filmed: Filmed, trial: Trial, identified: Identified, lead_s: float
) -> Candidates:
    """What every offset would do, `lead_s` from now, or as simulated early if that still holds."""
    now_s = station.devices.clock.now_s()
    early = filmed.early
    if early is not None and not is_past(station, early.prospect.start_s):
        expected = early.prospect.forecast
        shift_m = expected.moved_to(identified.mean).tip_m - expected.tip_m
        if np.abs(shift_m).max() < SMALL_SHIFT_M:
            return early.prospect
    return foretell(station.task, station.timing, filmed, trial, identified, now_s + lead_s)


def choose(station: Station, prospect: Candidates, identified: Identified) -> Choice:
    """The offset that passes most probably, or why none does."""
    task = station.task
    return choose_offset(prospect.forecast, identified, task.destination, task.choice)


def verify(station: Station, filmed: Filmed, prospect: Candidates, choice: Choice) -> Passage:
    """Whether the tip was seen to pass the destination, and how far the forecast was off."""
    return measured_passage(
        station.task.destination,
        np.array([s.t_s for s in filmed.sightings]),
        np.array([s.nodes_m[0] for s in filmed.sightings]),
        prospect.start_s + choice.t_s,
        choice.tip_m,
    )


def execute(station: Station, path: Trajectory, start_s: float) -> Filmed:
    """Follow the chosen path from `start_s` on and film it until the hand has settled."""
    task, arm, camera = station.task, station.devices.arm, station.devices.camera
    duration_s = float(path.t_s[-1]) + arm.lag_s + task.settle_s
    frame_count = int(np.ceil(duration_s * camera.frame_rate_hz))
    end_s = start_s + duration_s
    arm.follow(path, start_s)
    wait_until(station, start_s)
    camera.start(frame_count)
    filming = Filming(start_s, end_s - task.settle_s, end_s, frame_count)
    return capture(station, filming, KEEP_EVERY_MOVING)


def approach(station: Station, motion: Measuring) -> None:
    """Bring the cable slowly to where a measuring motion begins, and let it calm down."""
    _move(station, motion.start, station.task.insertion.slowed(APPROACH_SLOWER))
    wait_until(station, station.devices.clock.now_s() + station.task.calm_s)


def measure(station: Station, motion: Measuring) -> Filmed:
    """Film the cable at rest, during the moves and while the hand is held after them."""
    path = measuring_path(motion.start, motion.moves, station.devices.arm.rate_hz)
    filming = film(station, path, motion.still_s, motion.hold_s, KEEP_EVERY_HELD)
    return capture(station, filming, KEEP_EVERY_HELD)


def release(station: Station, *, aside: bool) -> None:
    """Let go of the cable: aside, or where it is."""
    if aside:
        _move(station, station.task.aside, station.task.lowering)
    station.devices.gripper.release()


# --- what the steps share -----------------------------------------------------------------------


def _move(station: Station, goal: Pose, limits: MotionLimits) -> None:
    """Move to `goal`: level first, then up or down, then turning, and rest there."""
    arm = station.devices.arm
    here = arm.state().pose
    away_m = max(abs(here.x_m - goal.x_m), abs(here.y_m - goal.y_m))
    if away_m < AT_GOAL_M and abs(here.angle_rad - goal.angle_rad) < SAME_ANGLE_RAD:
        return
    path = retreat_path(here, goal, limits, arm.rate_hz)
    arm.follow(path)
    wait_until(station, station.devices.clock.now_s() + float(path.t_s[-1]) + arm.lag_s)
    await_rest(station)
