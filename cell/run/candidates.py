"""Simulates the insertions that may be executed, with the gripper's motion as it will be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Motion
from cell.cable.solver import Solver
from cell.identify.identified import Identified
from cell.plan.choose import choose, forecast
from cell.plan.paths import executed_motion, insertion_path
from cell.plan.refinement import refined_candidates, widest_between
from cell.run.findings import Candidates, FilmedMotion
from cell.run.station import Task, Timing
from cell.run.trials import camera_offset_m_rad, moved
from cell.study.data import Trial
from drivers.interfaces import Trajectory

#: With a margin of so many standard deviations an offset passes almost certainly: other start times
#: are not searched, and the offset is only refined.
SURE_SIGMAS = 4.0


@dataclass(frozen=True, eq=False)
class Executing:
    """State of the gripper at the moment at which an insertion is commanded.

    The cable still swings from the gripper's motion before; the gripper follows with its known lag,
    and the camera detects it at a constant offset from the arm's pose.  Time continues that of the
    hold, in which the cable was identified: an effect may depend on it.

    begin_s  start of the command, on the clock of the identification
    history  of the gripper until now, counted from then
    camera_offset  (3,) x, y, angle of the gripper as detected by the camera, minus those that the
                   arm reports
    """

    task: Task
    timing: Timing
    begin_s: float
    history: Motion
    camera_offset: FloatArray

    @staticmethod
    def of(
        task: Task, timing: Timing, filmed: FilmedMotion, trial: Trial, start_s: float
    ) -> Executing:
        """After a hold, from `start_s` on the cell's clock on."""
        begin_s = start_s - filmed.begin_s
        offset = camera_offset_m_rad(filmed.gripper_log, trial.grip)
        return Executing(task, timing, begin_s, trial.grip.later(-begin_s), offset)

    def path(
        self, offset_m: float, delay_s: float = 0.0, pace: float = 1.0, further_m: float = 0.0
    ) -> Trajectory:
        """Path that the arm would be commanded."""
        task, limits = self.task, self.task.insertion.slowed(pace)
        advance_m, rate_hz = task.advance_m + further_m, self.timing.arm_rate_hz
        return insertion_path(task.lowered, offset_m, advance_m, limits, rate_hz, delay_s=delay_s)

    def motion(self, path: Trajectory) -> Motion:
        """Motion of the gripper under a path, on the clock of the identification."""
        hand = executed_motion(
            moved(path, self.camera_offset),
            self.timing.arm_lag_s,
            settle_s=self.task.settle_s,
            history=self.history,
        )
        return hand.later(self.begin_s)


def simulate_offsets(
    task: Task,
    timing: Timing,
    filmed: FilmedMotion,
    trial: Trial,
    identified: Identified,
    start_s: float,
    solver: Solver = Solver(),  # noqa: B008
) -> Candidates:
    """Simulate every offset as it would be executed from `start_s` on, see `Executing`.

    start_s  on the cell's clock, s
    raises   DivergedError, UnsettledError
    """
    executing = Executing.of(task, timing, filmed, trial, start_s)
    path, motion = executing.path, executing.motion
    choice, freely = task.choice, task.choice.freely
    end_s = None
    if freely.window_s > 0.0:
        slowest = max((1.0, *freely.paces))
        latest = path(task.offsets_m[-1], freely.window_s, slowest, freely.further_m)
        end_s = float(motion(latest).t_s[-1])
    simulate = partial(forecast, identified, begin_s=executing.begin_s, end_s=end_s, solver=solver)
    paths = [path(o) for o in task.offsets_m]
    expected = simulate(np.array(task.offsets_m), [motion(p) for p in paths])
    if freely.window_s == 0.0:
        return Candidates(start_s, tuple(paths), expected)
    at_once = choose(expected, identified, task.destination, choice).best
    if at_once.margin_m > SURE_SIGMAS * at_once.margin_std_m:
        spots = np.array([widest_between(expected, task.destination)]), np.zeros(1), np.ones(1)
        further_m = 0.0
    else:
        further_m = freely.further_m
        spots = refined_candidates(
            identified,
            expected,
            lambda offset_m, pace: motion(path(offset_m, pace=pace, further_m=further_m)),
            task.destination,
            begin_s=executing.begin_s,
            solver=solver,
            options=choice,
        )
    new = [
        path(float(offset_m), float(delay_s), float(pace), further_m)
        for offset_m, delay_s, pace in zip(*spots, strict=True)
    ]
    offsets_m, delays_s, paces = spots
    motions = [motion(p) for p in new]
    closer = simulate(offsets_m, motions)
    beyond_m = np.full(len(new), further_m)
    closer = replace(closer, delays_s=delays_s, paces=paces, further_m=beyond_m)
    return Candidates(start_s, (*paths, *new), expected.joined_with(closer))
