"""Motion of the clamp at the engine's steps: from a log, through the effects on the hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cell.cable import layout as at
from cell.cable import splines
from cell.cable.effects.base import ActiveEffect, HandMotion
from cell.cable.effects.compiled import parameters
from cell.cable.geometry import Motion, MotionSplines, SmoothedMotion
from cell.cable.splines import Steps, spread_steps

FloatArray = NDArray[np.float64]

#: Axes of a pose.  Of an axis' three fields each is so many behind the one before: see `layout`.
_AXES = 3
#: The only lane there is.
ONLY = np.zeros(1, dtype=np.int64)
#: Half the interval over which a pose changed by an effect is differentiated, s.
_INSTANT = 1e-5


def motions_like(motion: Motion, values: FloatArray) -> list[Motion]:
    """Motions logged at the same times with other values (motions, 3, T): x, y, angle.

    As much is taken for noise in them as in `motion`.
    """
    by_axis = [splines.refit(spline, values[:, axis]) for axis, spline in enumerate(motion.splines)]
    return [
        SmoothedMotion(motion.t_s, *logged, smoothed=(x, y, angle))
        for logged, x, y, angle in zip(values, *by_axis, strict=True)
    ]


@dataclass(frozen=True)
class _Logged:
    """Pose against time as logged; equal for equal splines, so that what follows can be kept.

    instants  at which several effects will ask for it
    known     poses there, as far as they were asked for
    """

    splines: MotionSplines
    instants: tuple[FloatArray, ...] = field(default=(), compare=False)
    known: dict[int, tuple[FloatArray, ...]] = field(default_factory=dict, compare=False)

    def __call__(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        x, y, angle = self.splines
        for i, instants in enumerate(self.instants):
            if t is instants:
                if i not in self.known:
                    self.known[i] = (x(t), y(t), angle(t))
                at_x, at_y, at_angle = self.known[i]
                return at_x.copy(), at_y.copy(), at_angle.copy()  # an effect may write into them
        return x(t), y(t), angle(t)


class Instants:
    """When the steps of a grid ask for the hand's pose; what the logs say there is found once."""

    def __init__(self, steps: Steps) -> None:
        number = np.arange(steps.number + 1, dtype=np.float64) + steps.collocation
        self.time: FloatArray = steps.start_s + steps.step_s * number[:-1]
        edge: FloatArray = steps.start_s + steps.step_s * (number - 0.5)
        self.near: tuple[FloatArray, ...] = tuple(
            t + by for t in (edge, self.time) for by in (_INSTANT, -_INSTANT)
        )
        self._logged: dict[int, _Logged] = {}

    def logged(self, motion: Motion) -> _Logged:
        """The log of a motion that lives as long as this."""
        if id(motion) not in self._logged:
            self._logged[id(motion)] = _Logged(motion.splines, (self.time, *self.near))
        return self._logged[id(motion)]


def pose_of(
    motion: Motion, effects: Sequence[ActiveEffect] = (), logged: _Logged | None = None
) -> HandMotion:
    """Pose of the gripping point against time, after the effects on the hand in their order.

    logged  of the motion, with what is known of it
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
    the momentum that it should, whatever the step.

    instants  of these steps, if there are other effects on the same motions
    """
    rows = np.empty((steps.number, at.BASE_FIELDS))
    by_axis = [rows[:, axis::_AXES] for axis in range(_AXES)]  # value, rate and its change
    if not any(a.effect.clamp is not None for a in effects):
        for spline, out in zip(motion.splines, by_axis, strict=True):
            spread_steps(*spline.pieces, steps, ONLY, out[:, :, None])
        return rows
    instants = Instants(steps) if instants is None else instants
    pose = pose_of(motion, effects, instants.logged(motion))
    here = pose(instants.time)
    after, before, late, early = (pose(t) for t in instants.near)
    for c, out in enumerate(by_axis):
        out[:, 0] = here[c]
        out[:, 1] = (late[c] - early[c]) / (2.0 * _INSTANT)
        out[:, 2] = np.diff((after[c] - before[c]) / (2.0 * _INSTANT)) / steps.step_s
    return rows
