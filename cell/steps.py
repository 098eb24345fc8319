"""The steps of a cycle, one function each.

With `waiting` and `filming`, and beside the `dry_run` and the `watch`, all that calls devices.

grasp → lower → hold and capture → identify → simulate → choose → execute → verify → release.
A measuring cycle: grasp → approach → measure → go home → release.
Every step takes the bench (devices and task) and what the steps before it found, and returns what
it found itself; nothing is kept here.
"""

from __future__ import annotations

from concurrent.futures import BrokenExecutor
from dataclasses import replace

import numpy as np

from cell.ahead import Ahead
from cell.ahead import prospect as foretell
from cell.bench import Bench, Devices, Early, Filmed, Filming, Prospect
from cell.filming import capture, film
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
from cell.study.data import Trial
from cell.waiting import POLL_S, REST_TIMEOUT_S, await_rest, check_arm, wait_until
from cell.warmup import warm_up as warm_up_engine
from cell.warmup import warm_up_eyes
from drivers.interfaces import ArmMode, DeviceError, DeviceLostError, GripError, Path, Pose

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


def connect(bench: Bench) -> None:
    """Connect all devices, the one that moves last.  Raises ConnectError."""
    bench.devices.gripper.connect()
    bench.devices.camera.connect()
    bench.devices.arm.connect()


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


def is_past(bench: Bench, t_s: float) -> bool:
    """Whether it is too late to tell the arm to start at a moment."""
    return bench.devices.clock.now_s() > t_s - AHEAD_S


def reset(bench: Bench) -> None:
    """Clear our own stop, empty the jaws and bring the hand home, level strokes first."""
    bench.devices.arm.reset()
    bench.commands.check()  # after the reset, so that a stop given meanwhile is not lost
    bench.devices.gripper.release()
    go_home(bench)


def go_home(bench: Bench) -> None:
    """Bring the hand from wherever it is to where cables are grasped."""
    _move(bench, bench.task.home, bench.task.lowering)


def check_ready(bench: Bench) -> None:
    """Whether a cycle may begin: arm ready, jaws empty.  Raises a DeviceError that says why not."""
    check_arm(bench)
    if bench.devices.gripper.state().holding:
        raise GripError(bench.devices.gripper.name, "holds something already", "empty the jaws")


def warm_up(bench: Bench) -> None:
    """Have everything compiled and loaded where it will be needed.  Raises DeviceLostError."""
    warm_up_engine(bench.task.cable)
    warm_up_eyes(bench.task.vision)
    try:
        bench.computer.submit(warm_up_engine, bench.task.cable).result()
    except BrokenExecutor as error:
        raise DeviceLostError(
            "computer",
            "the process that computes ahead ended as it began",
            "free memory; a script of your own must begin under `if __name__ == '__main__':`",
        ) from error


# --- the steps ----------------------------------------------------------------------------------


def grasp(bench: Bench) -> None:
    """Close the jaws on the cable and let it calm down.  Raises GripError."""
    bench.devices.gripper.grip(bench.task.force_n)
    wait_until(bench, bench.devices.clock.now_s() + bench.task.calm_s)


def lower(bench: Bench) -> Filming:
    """Begin to film the cable at rest, then move it down so that it swings."""
    task = bench.task
    path = identification_path(
        task.home,
        task.lower_m,
        task.lowering,
        bench.devices.arm.rate_hz,
        duration_s=task.lower_s,
        hold_s=0.0,
    )
    return film(bench, path, task.still_s, task.hold_s, KEEP_EVERY_HELD)


def hold_and_capture(bench: Bench, filming: Filming) -> Filmed:
    """Hold still while the cable swings, and find it in every frame as it comes.

    Somebody else computes ahead, so that little is left to be computed after the last frame.
    """
    ahead = Ahead(bench, filming)
    try:
        filmed = capture(bench, filming, KEEP_EVERY_HELD, ahead.look)
        return replace(filmed, early=ahead.found())
    finally:
        ahead.close()


def identify(bench: Bench, trial: Trial, early: Early | None = None) -> Identified:
    """This cable's parameters.  Raises CableRejectedError."""
    task = bench.task
    return identify_cable(
        trial,
        task.arc_length_m,
        task.cable,
        previous=None if early is None else early.identified,
        foreseen=None if early is None else early.foreseen,
        options=task.identification,
    )


def settled(bench: Bench, trial: Trial, identified: Identified) -> Identified:
    """The same cable without haste, for the record: no step is left linear from early frames.

    As it was if the fit finds nothing better; the choice was made with that.
    """
    task = bench.task
    try:
        return identify_cable(
            trial, task.arc_length_m, task.cable, previous=identified, options=task.identification
        )
    except CableRejectedError:
        return identified


def simulate(
    bench: Bench, filmed: Filmed, trial: Trial, identified: Identified, lead_s: float
) -> Prospect:
    """What every offset would do, `lead_s` from now, or as simulated early if that still holds."""
    now_s = bench.devices.clock.now_s()
    early = filmed.early
    if early is not None and not is_past(bench, early.prospect.start_s):
        expected = early.prospect.forecast
        shift_m = expected.moved_to(identified.mean).tip_m - expected.tip_m
        if np.abs(shift_m).max() < SMALL_SHIFT_M:
            return early.prospect
    return foretell(bench.task, bench.timing, filmed, trial, identified, now_s + lead_s)


def choose(bench: Bench, prospect: Prospect, identified: Identified) -> Choice:
    """The offset that passes most probably, or why none does."""
    task = bench.task
    return choose_offset(prospect.forecast, identified, task.destination, task.choice)


def verify(bench: Bench, filmed: Filmed, prospect: Prospect, choice: Choice) -> Passage:
    """Whether the tip was seen to pass the destination, and how far the forecast was off."""
    return measured_passage(
        bench.task.destination,
        np.array([s.t_s for s in filmed.sightings]),
        np.array([s.nodes_m[0] for s in filmed.sightings]),
        prospect.start_s + choice.t_s,
        choice.tip_m,
    )


def execute(bench: Bench, path: Path, start_s: float) -> Filmed:
    """Follow the chosen path from `start_s` on and film it until the hand has settled."""
    task, arm, camera = bench.task, bench.devices.arm, bench.devices.camera
    duration_s = float(path.t_s[-1]) + arm.lag_s + task.settle_s
    frame_count = int(np.ceil(duration_s * camera.frame_rate_hz))
    end_s = start_s + duration_s
    arm.follow(path, start_s)
    wait_until(bench, start_s)
    camera.start(frame_count)
    filming = Filming(start_s, end_s - task.settle_s, end_s, frame_count)
    return capture(bench, filming, KEEP_EVERY_MOVING)


def approach(bench: Bench, motion: Measuring) -> None:
    """Bring the cable slowly to where a measuring motion begins, and let it calm down."""
    _move(bench, motion.start, bench.task.insertion.slowed(APPROACH_SLOWER))
    wait_until(bench, bench.devices.clock.now_s() + bench.task.calm_s)


def measure(bench: Bench, motion: Measuring) -> Filmed:
    """Film the cable at rest, during the moves and while the hand is held after them."""
    path = measuring_path(motion.start, motion.moves, bench.devices.arm.rate_hz)
    filming = film(bench, path, motion.still_s, motion.hold_s, KEEP_EVERY_HELD)
    return capture(bench, filming, KEEP_EVERY_HELD)


def release(bench: Bench, *, aside: bool) -> None:
    """Let go of the cable: aside, or where it is."""
    if aside:
        _move(bench, bench.task.aside, bench.task.lowering)
    bench.devices.gripper.release()


# --- what the steps share -----------------------------------------------------------------------


def _move(bench: Bench, goal: Pose, limits: MotionLimits) -> None:
    """Move to `goal`: level first, then up or down, then turning, and rest there."""
    arm = bench.devices.arm
    here = arm.state().pose
    away_m = max(abs(here.x_m - goal.x_m), abs(here.y_m - goal.y_m))
    if away_m < AT_GOAL_M and abs(here.angle_rad - goal.angle_rad) < SAME_ANGLE_RAD:
        return
    path = retreat_path(here, goal, limits, arm.rate_hz)
    arm.follow(path)
    wait_until(bench, bench.devices.clock.now_s() + float(path.t_s[-1]) + arm.lag_s)
    await_rest(bench)
