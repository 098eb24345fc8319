"""True motions of a simulated cable without pictures, and its measured nodes with noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.dynamics import simulate
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.identify.individual import hold_trial
from cell.plan.paths import executed_motion, identification_path, insertion_path
from cell.run.findings import FilmedMotion
from cell.run.station import Task
from cell.study.data import Markers, Trial
from drivers.interfaces import Trajectory
from tools.worlds.made_studies import WORLD, coloured, logged

RATE_HZ = 500.0


@dataclass(frozen=True)
class Errors:
    """Measurement errors: standard deviations; constant ones are drawn once per cable."""

    node_m: float = 5e-5
    colour: float = 0.3
    across_m: float = 4e-6
    end_m: float = 1e-4
    log_m: float = 1e-5
    grip_m: float = 1e-5
    angle_rad: float = 1e-4


def full_motion(task: Task, down: Motion, path: Trajectory, start_s: float, lag_s: float) -> Motion:
    """True motion of the gripper: a hold, then a path, followed with the arm's lag."""
    late = executed_motion(path, lag_s, settle_s=task.settle_s)
    rows = np.column_stack([late.t_s + start_s, late.x_m, late.y_m, late.angle_rad])
    before = np.column_stack([down.t_s, down.x_m, down.y_m, down.angle_rad])
    full = np.vstack([before, rows[rows[:, 0] > down.t_s[-1] + 1e-6]])
    return Motion(*(np.ascontiguousarray(c) for c in full.T))


def until(trial: Trial, end_s: float) -> Trial:
    """The trial cut at `end_s`."""
    early = trial.markers.t_s < end_s
    markers = replace(trial.markers, t_s=trial.markers.t_s[early], xy_m=trial.markers.xy_m[early])
    return replace(trial, grip=moved_until(trial.grip, end_s), markers=markers)


def moved_until(motion: Motion, end_s: float) -> Motion:
    moved = motion.t_s <= end_s + 1e-9
    return Motion(*(getattr(motion, n)[moved] for n in ("t_s", "x_m", "y_m", "angle_rad")))


def filmed_of(held: Trial) -> FilmedMotion:
    hand = Trajectory(held.grip.t_s, held.grip.x_m, held.grip.y_m, held.grip.angle_rad)
    return FilmedMotion(0.0, (), hand, (), 0.0)


@dataclass(frozen=True, eq=False)
class Truths:
    """The gripper's true motions for all offsets, with the hold before; gives the tips' paths."""

    task: Task
    hidden: CableModel
    motions: list[Motion]
    start_s: float

    @property
    def end_s(self) -> float:
        return max(float(m.t_s[-1]) for m in self.motions)

    def tips(self, at_s: FloatArray, which: Sequence[int] | None = None) -> FloatArray:
        """(offsets, times, 2) from the beginning of the execution on; None = of all offsets."""
        tip = np.array([self.task.cable.free_length_m])
        motions = self.motions if which is None else [self.motions[i] for i in which]
        return simulate(self.hidden, motions, self.start_s + at_s, tip, solver=WORLD)[:, :, 0]


def truths(
    task: Task,
    hidden: CableModel,
    down: Motion,
    start_s: float,
    lag_s: float,
    table: Sequence[tuple[float, float, float, float]],
) -> Truths:
    """Simulate the motions of a table: rows of offset, delay, pace and further advance."""
    motions = []
    for offset_m, delay_s, pace, further_m in table:
        limits, advance_m = task.insertion.slowed(pace), task.advance_m + further_m
        path = insertion_path(task.lowered, offset_m, advance_m, limits, RATE_HZ, delay_s=delay_s)
        motions.append(full_motion(task, down, path, start_s, lag_s))
    return Truths(task, hidden, motions, start_s)


def true_hold(task: Task, lag_s: float) -> Motion:
    path = identification_path(
        task.home,
        task.lower_m,
        task.lowering,
        RATE_HZ,
        duration_s=task.lower_s,
        hold_s=task.hold_s,
    )
    return after_rest(executed_motion(path, lag_s), task.still_s)


def after_rest(motion: Motion, still_s: float) -> Motion:
    """The motion preceded by a rest of `still_s`, from time 0."""
    t_s = np.arange(0.0, still_s + float(motion.t_s[-1]), 1.0 / RATE_HZ)
    poses = (motion.x_m, motion.y_m, motion.angle_rad)
    return Motion(t_s, *(np.interp(t_s - still_s, motion.t_s, v) for v in poses))


@dataclass(frozen=True, eq=False)
class Bias:
    """Measurement errors that are constant in all pictures of a cable."""

    stretch: FloatArray
    across_m: FloatArray

    @staticmethod
    def drawn(rng: np.random.Generator, errors: Errors, nodes: int) -> Bias:
        along = np.linspace(1.0, 0.0, nodes)
        return Bias(errors.end_m * rng.normal() * along, errors.across_m * rng.normal(size=nodes))


def pictured(nodes: FloatArray, bias: Bias, errors: Errors, rng: np.random.Generator) -> FloatArray:
    along = np.gradient(nodes, axis=1)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    shifted = nodes - bias.stretch[:, None] * along + bias.across_m[:, None] * across
    return np.asarray(shifted + errors.node_m * coloured(rng, nodes.shape, errors.colour))


def observed_gripper(
    motion: Motion, t_s: FloatArray, errors: Errors, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """(frames, 2) gripping points and (frames,) clamp angles relative to the log, as observed."""
    true_m = np.stack([np.interp(t_s, motion.t_s, v) for v in (motion.x_m, motion.y_m)], axis=-1)
    grip_m = true_m + errors.grip_m * rng.normal(size=true_m.shape)
    return grip_m, errors.angle_rad * rng.normal(size=len(t_s))


@dataclass(frozen=True, eq=False)
class Observer:
    """The camera's measurements of a hidden cable; `bias` is that of all its pictures."""

    task: Task
    hidden: CableModel
    bias: Bias
    errors: Errors
    rng: np.random.Generator

    def nodes_m(self, motion: Motion, t_s: FloatArray) -> FloatArray:
        """(frames, nodes, 2)."""
        nodes = simulate(self.hidden, motion, t_s, self.task.arc_length_m, solver=WORLD)[0]
        return pictured(nodes, self.bias, self.errors, self.rng)

    def hold(self, motion: Motion, t_s: FloatArray, hand: Motion) -> Trial:
        """Trial of a motion with a log."""
        observed_m = self.nodes_m(motion, t_s)
        gripper = observed_gripper(motion, t_s, self.errors, self.rng)
        return hold_trial(hand, t_s, observed_m, *gripper)

    def execution(self, motion: Motion, start_s: float, held: Trial) -> Trial:
        """Trial of an execution, as `cell.run.trials.executed_trial` makes it."""
        period_s = float(np.median(np.diff(held.markers.t_s)))
        t_s = np.arange(start_s + 0.001, float(motion.t_s[-1]), period_s)
        log = logged(self.rng, motion, self.errors.log_m)
        later, grip = log.t_s > held.grip.t_s[-1], []
        for name in ("t_s", "x_m", "y_m", "angle_rad"):
            before, after = getattr(held.grip, name), getattr(log, name)[later]
            by = 0.0 if name == "t_s" else before[0] - getattr(motion, name)[0]
            grip.append(np.concatenate([before, after + by]))
        markers = Markers(t_s, self.nodes_m(motion, t_s))
        return Trial("execute", "validate", "equilibrium", Motion(*grip), markers)
