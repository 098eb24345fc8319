"""The steps of a dry run, which moves the hand through a whole cycle with empty jaws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.computer.memory import freeze_loaded_objects
from cell.records.result import AgreementCheck
from cell.run.findings import Findings, JawFilm, RehearsedMotion
from cell.run.movements import Movement
from cell.run.station import Station
from cell.run.steps import allowed_paths
from cell.run.waiting import AHEAD_S, await_rest, wait_until
from cell.run.warm_up import warm_up_servo, warm_up_vision
from cell.vision.marks import find_jaw
from drivers.interfaces import Frame, GripError

#: A path is given to the arm so long before it is to start, and by this share of its duration: the
#: arm looks at all of it first.
AHEAD_SHARE = 0.03
#: The jaw is looked for in about so many frames of a motion.
LOOKS = 300


def warm_up(station: Station, findings: Findings) -> Findings:
    """Load what looks at pictures, and at motions, before any are to be looked at."""
    warm_up_vision(station.task.vision)
    warm_up_servo()
    freeze_loaded_objects()
    return findings


def reset(station: Station, findings: Findings) -> Findings:
    """Clear our own stop; the jaws stay as they are, and must be empty.  Raises GripError."""
    station.devices.arm.reset()
    station.commands.check()  # after the reset, so that a stop given meanwhile is not lost
    gripper = station.devices.gripper
    state = gripper.state()
    if state.holding:
        raise GripError(gripper.name, "holds something", "a dry run needs empty jaws; empty them")
    return _with_checks(findings, AgreementCheck("gripper: opening", state.opening_m, "m"))


def check_paths(movements: Sequence[Movement], station: Station, findings: Findings) -> Findings:
    """Every path against limits and reach, before anything moves.  Raises LimitError."""
    paths = allowed_paths(station, movements)
    x_m, y_m = (
        np.concatenate([getattr(path, axis) for _, path in paths]) for axis in ("x_m", "y_m")
    )
    return _with_checks(
        findings,
        AgreementCheck("arm: paths within reach", float(len(paths))),
        AgreementCheck("hand: least x", float(x_m.min()), "m"),
        AgreementCheck("hand: greatest x", float(x_m.max()), "m"),
        AgreementCheck("hand: least y", float(y_m.min()), "m"),
        AgreementCheck("hand: greatest y", float(y_m.max()), "m"),
    )


def follow(movement: Movement, station: Station, findings: Findings) -> Findings:
    """Make a movement, filmed if a cycle films it, unless the hand is there already."""
    arm, camera, clock = station.devices.arm, station.devices.camera, station.devices.clock
    path = movement.path_from(arm.state().pose, arm.rate_hz)
    if path is None:
        return findings
    lasts_s = float(path.t_s[-1]) + arm.lag_s
    before_s = clock.now_s()
    film = None
    if movement.path is None:
        arm.follow(path)
        began_s = clock.now_s()
    else:
        began_s = before_s + station.task.still_s + AHEAD_S + AHEAD_SHARE * lasts_s
        arm.follow(path, began_s)
        filmed_s = began_s - clock.now_s() + lasts_s + station.task.settle_s
        frame_count = int(np.ceil(filmed_s * camera.frame_rate_hz))
        camera.start(frame_count)
        film = _watch(station, max(1, frame_count // LOOKS))
    wait_until(station, began_s + lasts_s)
    await_rest(station)
    hand = arm.log(before_s, clock.now_s())
    made = RehearsedMotion(movement.name, path, began_s, hand, film)
    return replace(findings, followed=(*findings.followed, made))


def _with_checks(findings: Findings, *checks: AgreementCheck) -> Findings:
    return replace(findings, checks=(*findings.checks, *checks))


def _watch(station: Station, look_every: int) -> JawFilm:
    """See a recording to its end, looking for the jaw in some of its frames."""
    task, camera = station.task, station.devices.camera
    frame_s: list[float] = []
    looked_s: list[float] = []
    jaw_m: list[FloatArray] = []
    pictures: list[Frame] = []
    near: FloatArray | None = None
    while (frame := camera.read()) is not None:
        station.commands.check()
        frame_s.append(frame.t_s)
        pictures = [pictures[0] if pictures else frame, frame]
        if frame.index % look_every == 0:
            jaw = find_jaw(frame.image, task.view, task.vision.marks, near)
            near = None if jaw is None else jaw.grip_m
            looked_s.append(frame.t_s)
            jaw_m.append(np.full(2, np.nan) if near is None else near)
    first, last = pictures
    return JawFilm(np.array(frame_s), np.array(looked_s), np.array(jaw_m), (first, last))
