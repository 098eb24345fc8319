"""The gripper's movements in a plan, at any share of their speed, for dry runs and path
checks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from cell.plan.measuring import Measuring, Move, measuring_path
from cell.plan.paths import MotionLimits, identification_path, insertion_path, path_to
from cell.run.station import Task
from drivers.interfaces import Pose, Trajectory

#: Factor by which a cable's way to a measuring motion is slower than an insertion.
APPROACH_SLOWER = 4.0

#: Names of the movements, which are steps of a dry run.
HOME, DOWN, IN, ASIDE = "go_home", "go_down", "go_in", "go_aside"
TO_START, THROUGH = "go_to_start", "go_through"


@dataclass(frozen=True)
class Movement:
    """One movement to `goal`: level, then upright within `limits`; or along `path`, and filmed."""

    name: str
    goal: Pose
    limits: MotionLimits | None = None
    path: Trajectory | None = None

    def path_from(self, start: Pose, rate_hz: float) -> Trajectory | None:
        """Path from where the gripper is; None = it is at the goal already."""
        if self.path is not None:
            return self.path
        assert self.limits is not None
        return path_to(self.goal, start, self.limits, rate_hz)


#: The movements of a plan: task, the arm's rate in Hz, factor of the speed → movements.
Movements = Callable[[Task, float, float], tuple[Movement, ...]]


def slowed(task: Task, speed: float) -> Task:
    """The task with all motions at `speed` times their speed, hence 1/speed as long.

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


def inserting_movements(task: Task, rate_hz: float, speed: float = 1.0) -> tuple[Movement, ...]:
    """All movements of an insertion with the least and with the greatest offset, home at both ends.

    Both end with the cable put aside, which is the longer way.
    raises  ValueError as `slowed`
    """
    task = slowed(task, speed)
    down = identification_path(
        task.home, task.lower_m, task.lowering, rate_hz, duration_s=task.lower_s, hold_s=0.0
    )
    home = Movement(HOME, task.home, task.lowering)
    movements = [home]
    for offset_m in sorted({task.offsets_m[0], task.offsets_m[-1]}):
        insertion = insertion_path(
            task.lowered, offset_m, task.longest_advance_m, task.insertion, rate_hz
        )
        movements += [
            Movement(DOWN, _end(down), path=down),
            Movement(IN, _end(insertion), path=insertion),
            Movement(ASIDE, task.aside, task.lowering),
            home,
        ]
    return tuple(movements)


def measuring_movements(
    motion: Measuring, task: Task, rate_hz: float, speed: float = 1.0
) -> tuple[Movement, ...]:
    """The movements of a measuring cycle, home at both ends.  Raises ValueError as `slowed`."""
    task, motion = slowed(task, speed), slowed_motion(motion, speed)
    path = measuring_path(motion.start, motion.moves, rate_hz)
    home = Movement(HOME, task.home, task.lowering)
    return (
        home,
        Movement(TO_START, motion.start, task.insertion.slowed(APPROACH_SLOWER)),
        Movement(THROUGH, _end(path), path=path),
        home,
    )


def paths_from(
    start: Pose, task: Task, movements: Sequence[Movement], rate_hz: float
) -> tuple[tuple[str, Trajectory], ...]:
    """Names and paths that the gripper may follow in a cycle from `start`, for all offsets."""
    paths = []
    for movement in movements:
        path = movement.path_from(start, rate_hz)
        if path is not None:
            paths.append((movement.name, path))
        start = movement.goal
    if any(movement.name == IN for movement in movements):
        for offset_m in task.offsets_m[1:-1]:
            insertion = insertion_path(
                task.lowered, offset_m, task.longest_advance_m, task.insertion, rate_hz
            )
            paths.append((f"{IN} with offset {offset_m:g} m", insertion))
    return tuple(paths)


def _end(path: Trajectory) -> Pose:
    return path.at(float(path.t_s[-1]))


def _check_speed(speed: float) -> None:
    if not 0.0 < speed <= 1.0:
        raise ValueError(f"speed is {speed}: must be > 0 and ≤ 1")
