"""The motions of a dry run: all those of a cycle, at any share of their speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from cell.plan.measuring import Measuring, Move, measuring_path
from cell.plan.paths import (
    SAME_ANGLE_RAD,
    MotionLimits,
    identification_path,
    insertion_path,
    retreat_path,
)
from cell.run.station import Task
from cell.run.steps import APPROACH_SLOWER, AT_GOAL_M
from drivers.interfaces import Pose, Trajectory


@dataclass(frozen=True)
class Leg:
    """One motion to `goal`: level, then upright within `limits`; or along `path`, and filmed."""

    name: str
    goal: Pose
    limits: MotionLimits | None = None
    path: Trajectory | None = None

    def path_from(self, here: Pose, rate_hz: float) -> Trajectory | None:
        """From where the hand is; None = it is at the goal already."""
        if self.path is not None:
            return self.path
        assert self.limits is not None
        away_m = max(abs(here.x_m - self.goal.x_m), abs(here.y_m - self.goal.y_m))
        if away_m < AT_GOAL_M and abs(here.angle_rad - self.goal.angle_rad) < SAME_ANGLE_RAD:
            return None
        return retreat_path(here, self.goal, self.limits, rate_hz)


def slowed(task: Task, speed: float) -> Task:
    """The same motions at `speed` times the speed, hence in 1/speed of the time.

    raises  ValueError: a speed that is not > 0 and ≤ 1
    """
    _check_speed(speed)
    return replace(
        task,
        lowering=task.lowering.slowed(1.0 / speed),
        insertion=task.insertion.slowed(1.0 / speed),
        lower_s=task.lower_s / speed,
    )


def slowed_motion(motion: Measuring, speed: float) -> Measuring:
    """A measuring motion at `speed` times the speed.  Raises ValueError as `slowed`."""
    _check_speed(speed)
    moves = tuple(Move(move.goal, move.duration_s / speed) for move in motion.moves)
    return replace(motion, moves=moves)


def cycle_legs(task: Task, rate_hz: float) -> tuple[Leg, ...]:
    """All motions of a cycle with the least and with the greatest offset, to home first and last.

    Both end as a cable that is put aside does: that way is the longer one.
    """
    down = identification_path(
        task.home, task.lower_m, task.lowering, rate_hz, duration_s=task.lower_s, hold_s=0.0
    )
    legs = [Leg("go_home", task.home, task.lowering)]
    for offset_m in sorted({task.offsets_m[0], task.offsets_m[-1]}):
        left = insertion_path(task.lowered, offset_m, task.advance_m, task.insertion, rate_hz)
        legs += [
            Leg("go_down", _end(down), path=down),
            Leg("go_in", _end(left), path=left),
            Leg("go_aside", task.aside, task.lowering),
            Leg("go_home", task.home, task.lowering),
        ]
    return tuple(legs)


def measuring_legs(task: Task, motion: Measuring, rate_hz: float) -> tuple[Leg, ...]:
    """The motions of a measuring cycle, to home first and last."""
    path = measuring_path(motion.start, motion.moves, rate_hz)
    return (
        Leg("go_home", task.home, task.lowering),
        Leg("go_to_start", motion.start, task.insertion.slowed(APPROACH_SLOWER)),
        Leg("go_through", _end(path), path=path),
        Leg("go_home", task.home, task.lowering),
    )


def paths_from(
    here: Pose, task: Task, legs: Sequence[Leg], rate_hz: float
) -> tuple[tuple[str, Trajectory], ...]:
    """What the hand will do from `here` on, and could do in a cycle: the legs, and every offset."""
    paths = []
    for leg in legs:
        path = leg.path_from(here, rate_hz)
        if path is not None:
            paths.append((leg.name, path))
        here = leg.goal
    if any(leg.name == "go_in" for leg in legs):
        for offset_m in task.offsets_m[1:-1]:
            left = insertion_path(task.lowered, offset_m, task.advance_m, task.insertion, rate_hz)
            paths.append((f"go_in with offset {offset_m:g} m", left))
    return tuple(paths)


def _end(path: Trajectory) -> Pose:
    return path.at(float(path.t_s[-1]))


def _check_speed(speed: float) -> None:
    if not 0.0 < speed <= 1.0:
        raise ValueError(f"speed is {speed}: must be > 0 and ≤ 1")
