"""Motion of the clamp at the engine's steps: from a log, through the effects on the gripper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cell.cable import layout as at
from cell.cable import splines
from cell.cable.arrays import FloatArray
from cell.cable.effects.base import ActiveEffect, HandMotion
from cell.cable.effects.compiled import parameters
from cell.cable.geometry import Motion, MotionSplines, SmoothedMotion
from cell.cable.splines import Steps, spread_steps

#: Axes of a pose; also the distance between the three fields of an axis: see `layout`.
_AXES = 3
#: The only lane there is.
ONLY = np.zeros(1, dtype=np.int64)


def motions_like(motion: Motion, values: FloatArray) -> list[Motion]:
    """Motions logged at the same times with other values (motions, 3, T): x, y, angle.

    They are smoothed with the noise level of `motion`.
    """
    by_axis = [splines.refit(spline, values[:, axis]) for axis, spline in enumerate(motion.splines)]
    return [
        SmoothedMotion(motion.t_s, *logged, smoothed=(x, y, angle))
        for logged, x, y, angle in zip(values, *by_axis, strict=True)
    ]


@dataclass(frozen=True)
class _Logged:
    """Pose against time as logged; equal for equal splines, so that results can be cached.

    instants  times at which several effects evaluate it
    known     cached pose at `instants`: empty, or one entry
    """

    splines: MotionSplines
    instants: FloatArray | None = field(default=None, compare=False)
    known: list[tuple[FloatArray, ...]] = field(default_factory=list, compare=False)

    def __call__(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        x, y, angle = self.splines
        if t is not self.instants:
            return x(t), y(t), angle(t)
        if not self.known:
            self.known.append((x(t), y(t), angle(t)))
        at_x, at_y, at_angle = self.known[0]
        return at_x.copy(), at_y.copy(), at_angle.copy()  # an effect may write into them


class Instants:
    """Times at which the steps need the gripper's pose, with two before and two after.

    Each log is evaluated there once.
    """

    def __init__(self, steps: Steps) -> None:
        number = np.arange(-2.0, steps.number + 2.0) + steps.collocation
        self.time: FloatArray = steps.start_s + steps.step_s * number
        self._logged: dict[int, _Logged] = {}

    def logged(self, motion: Motion) -> _Logged:
        """The log of a motion that lives as long as this."""
        if id(motion) not in self._logged:
            self._logged[id(motion)] = _Logged(motion.splines, self.time)
        return self._logged[id(motion)]


def pose_of(
    motion: Motion, effects: Sequence[ActiveEffect] = (), logged: _Logged | None = None
) -> HandMotion:
    """Pose of the gripping point against time, after the effects on the gripper in their order.

    logged  the motion's log with its cached poses
    """
    logged = _Logged(motion.splines) if logged is None else logged
    begin, end = float(motion.t_s[0]), float(motion.t_s[-1])
    pose = HandMotion(logged, begin, end)
    for active in effects:
        if active.effect.clamp is not None:
            pose = HandMotion(active.effect.clamp(pose, parameters(active)), begin, end)
    return pose


def base_rows(
    motion: Motion,
    effects: Sequence[ActiveEffect],
    steps: Steps,
    instants: Instants | None = None,
) -> FloatArray:
    """(steps, BASE_FIELDS) pose, velocity and acceleration at the steps' collocation times.

    The acceleration is the mean over a step's length, so that a jump in the log's velocity gives
    the momentum that it should, whatever the step.  A gripper that an effect moves may jump when it
    likes: there the mean is weighted towards the middle of two steps' length, so that an
    effect's instant counts, not only the step that it is in.

    instants  of these steps, if there are other effects on the same motions
    """
    rows = np.empty((steps.number, at.BASE_FIELDS))
    by_axis = [rows[:, axis::_AXES] for axis in range(_AXES)]  # value, rate and its change
    if not any(a.effect.clamp is not None for a in effects):
        for spline, out in zip(motion.splines, by_axis, strict=True):
            spread_steps(*spline.pieces, steps, ONLY, out[:, :, None])
        return rows
    instants = Instants(steps) if instants is None else instants
    pose = pose_of(motion, effects, instants.logged(motion))(instants.time)
    step_s = steps.step_s
    for out, place in zip(by_axis, pose, strict=True):
        bent = place[2:] - 2.0 * place[1:-1] + place[:-2]
        out[:, 0] = place[2:-2]
        out[:, 1] = (8.0 * (place[3:-1] - place[1:-3]) - (place[4:] - place[:-4])) / (12.0 * step_s)
        # as narrow a mean as that over one step, to the fourth order
        out[:, 2] = (bent[1:-1] - (bent[2:] - 2.0 * bent[1:-1] + bent[:-2]) / 24.0) / step_s**2
    return rows
