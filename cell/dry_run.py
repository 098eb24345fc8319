"""The steps of a dry run, which moves the hand through a whole cycle with empty jaws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.bench import Bench
from cell.legs import Leg, paths_from
from cell.records.result import Check
from cell.steps import AHEAD_S
from cell.vision.marks import find_jaw
from cell.waiting import await_rest, wait_until
from drivers.interfaces import Frame, GripError, LimitError, Path

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
    path: Path
    began_s: float
    hand: Path
    film: Film | None


def reset(bench: Bench) -> tuple[Check, ...]:
    """Clear our own stop; the jaws stay as they are, and must be empty.  Raises GripError."""
    bench.devices.arm.reset()
    bench.commands.check()  # after the reset, so that a stop given meanwhile is not lost
    gripper = bench.devices.gripper
    state = gripper.state()
    if state.holding:
        raise GripError(gripper.name, "holds something", "a dry run needs empty jaws; empty them")
    return (Check("gripper: opening", state.opening_m, "m"),)


def check_paths(bench: Bench, legs: Sequence[Leg]) -> tuple[Check, ...]:
    """Every path against limits and reach, before anything moves.  Raises LimitError."""
    arm = bench.devices.arm
    paths = paths_from(arm.state().pose, bench.task, legs, arm.rate_hz)
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


def follow(bench: Bench, leg: Leg) -> Followed | None:
    """Make a motion, filmed if a cycle films it; None = the hand is there already."""
    arm, camera, clock = bench.devices.arm, bench.devices.camera, bench.devices.clock
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
        began_s = before_s + bench.task.still_s + AHEAD_S + AHEAD_SHARE * lasts_s
        arm.follow(path, began_s)
        filmed_s = began_s - clock.now_s() + lasts_s + bench.task.settle_s
        frame_count = int(np.ceil(filmed_s * camera.frame_rate_hz))
        camera.start(frame_count)
        film = _watch(bench, max(1, frame_count // LOOKS))
    wait_until(bench, began_s + lasts_s)
    await_rest(bench)
    return Followed(leg.name, path, began_s, arm.log(before_s, clock.now_s()), film)


def _watch(bench: Bench, look_every: int) -> Film:
    """See a recording to its end, looking for the jaw in some of its frames."""
    task, camera = bench.task, bench.devices.camera
    frame_s: list[float] = []
    looked_s: list[float] = []
    jaw_m: list[FloatArray] = []
    pictures: list[Frame] = []
    near: FloatArray | None = None
    while (frame := camera.read()) is not None:
        bench.commands.check()
        frame_s.append(frame.t_s)
        pictures = [pictures[0] if pictures else frame, frame]
        if frame.index % look_every == 0:
            jaw = find_jaw(frame.image, task.view, task.vision.marks, near)
            near = None if jaw is None else jaw.grip_m
            looked_s.append(frame.t_s)
            jaw_m.append(np.full(2, np.nan) if near is None else near)
    first, last = pictures
    return Film(np.array(frame_s), np.array(looked_s), np.array(jaw_m), (first, last))
