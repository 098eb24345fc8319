"""The steps of a dry run, which moves the hand through a whole cycle with empty jaws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.records.result import Check
from cell.run.legs import Leg, paths_from
from cell.run.station import Station
from cell.run.steps import AHEAD_S
from cell.run.waiting import await_rest, wait_until
from cell.vision.marks import find_jaw
from drivers.interfaces import Frame, GripError, LimitError, Trajectory

FloatArray = NDArray[np.float64]

#: A path is given to the arm so long before it is to start, and by this share of its duration: the
#: arm looks at all of it first.
AHEAD_SHARE = 0.03
#: The jaw is looked for in about so many frames of a motion.
LOOKS = 300


@dataclass(frozen=True, eq=False)
class Film:
    """What the camera saw of a motion.

    frame_s     (n,) times of all frames
    looked_s    (m,) times of those in which the jaw was looked for
    jaw_m       (m, 2) where its marks were seen, nan = not found
    pictures    the first and the last frame
    """

    frame_s: FloatArray
    looked_s: FloatArray
    jaw_m: FloatArray
    pictures: tuple[Frame, Frame]


@dataclass(frozen=True, eq=False)
class Followed:
    """A motion that was made, on the cell's clock.

    began_s  when the arm was told to start
    hand     measured poses, from before the motion to after it
    film     None = not filmed
    """

    name: str
    path: Trajectory
    began_s: float
    hand: Trajectory
    film: Film | None


def reset(station: Station) -> tuple[Check, ...]:
    """Clear our own stop; the jaws stay as they are, and must be empty.  Raises GripError."""
    station.devices.arm.reset()
    station.commands.check()  # after the reset, so that a stop given meanwhile is not lost
    gripper = station.devices.gripper
    state = gripper.state()
    if state.holding:
        raise GripError(gripper.name, "holds something", "a dry run needs empty jaws; empty them")
    return (Check("gripper: opening", state.opening_m, "m"),)


def check_paths(station: Station, legs: Sequence[Leg]) -> tuple[Check, ...]:
    """Every path against limits and reach, before anything moves.  Raises LimitError."""
    arm = station.devices.arm
    paths = paths_from(arm.state().pose, station.task, legs, arm.rate_hz)
    for name, path in paths:
        try:
            arm.check(path)
        except LimitError as error:
            cause = f"on the way '{name.replace('_', ' ')}' {error.cause}"
            raise LimitError(error.device, cause, error.remedy) from error
    x_m, y_m = (
        np.concatenate([getattr(path, axis) for _, path in paths]) for axis in ("x_m", "y_m")
    )
    return (
        Check("arm: paths within reach", float(len(paths))),
        Check("hand: least x", float(x_m.min()), "m"),
        Check("hand: greatest x", float(x_m.max()), "m"),
        Check("hand: least y", float(y_m.min()), "m"),
        Check("hand: greatest y", float(y_m.max()), "m"),
    )


def follow(station: Station, leg: Leg) -> Followed | None:
    """Make a motion, filmed if a cycle films it; None = the hand is there already."""
    arm, camera, clock = station.devices.arm, station.devices.camera, station.devices.clock
    path = leg.path_from(arm.state().pose, arm.rate_hz)
    if path is None:
        return None
    lasts_s = float(path.t_s[-1]) + arm.lag_s
    before_s = clock.now_s()
    film = None
    if leg.path is None:
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
    return Followed(leg.name, path, began_s, arm.log(before_s, clock.now_s()), film)


def _watch(station: Station, look_every: int) -> Film:
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
    return Film(np.array(frame_s), np.array(looked_s), np.array(jaw_m), (first, last))
