"""Motions of one cable with a common beginning: it is simulated once, up to their branching."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cell.cable import camera
from cell.cable.arrays import FloatArray
from cell.cable.assembly import assemble
from cell.cable.clamp import pose_of
from cell.cable.dynamics import increasing, simulate
from cell.cable.geometry import Motion
from cell.cable.gripper_motions import at_gripper
from cell.cable.model import CableModel
from cell.cable.solver import DEFAULT_SOLVER, Solver, threads
from cell.cable.swing import Grid, Swing, move

#: Motions are compared at one step of so many, and at each of so many last ones.
_STRIDE, _LAST = 16, 128
#: Largest difference between poses of the gripper that count as the same, m or rad.
_ALIKE = 1e-9


def simulate_branches(
    models: Sequence[CableModel],
    motions: Sequence[Motion],
    alike_until_s: float,
    times_s: FloatArray,
    arc_length_m: FloatArray,
    *,
    solver: Solver = DEFAULT_SOLVER,
) -> FloatArray:
    """Positions of markers for every model on every motion, from equilibrium.

    What the motions have in common is simulated once per model, not once per motion; where a camera
    shows other times than its pictures', the motions are taken apart as much before.

    alike_until_s  until then all motions are the same, as logged; an effect on the gripper may part
                   them earlier
    times_s        (times,) increasing, none of them before that
    returns        (motions, models, times, markers, 2) x, y in m
    raises         as `simulate`; ValueError: a time before the motions part
    """
    times = increasing(times_s)
    if times.size and times[0] < alike_until_s:
        raise ValueError(f"a marker is asked for at {times[0]} s: the motions part later")
    batch, paths = list(models) * len(motions), [m for m in motions for _ in models]
    begin_s = float(min(m.t_s[0] for m in motions))
    steps = int((alike_until_s - begin_s) / solver.step_s + 1e-9)
    steps = _steps_alike(models, motions, begin_s + solver.step_s * np.arange(steps + 1.0))
    steps -= camera.earlier_steps(models, solver.step_s)
    if camera.shifts_time(models):
        steps -= steps % camera.EVERY  # scenes are stored at the same times as without branches
    shape = (len(motions), len(models), times.size, np.size(arc_length_m), 2)
    if steps < 1:
        return simulate(batch, paths, times, arc_length_m, solver=solver).reshape(shape)
    fork_s = begin_s + steps * solver.step_s
    workers = threads() if solver.threads is None else solver.threads
    trunk = assemble(models, solver.segments, begin_s, workers)
    move(
        Swing(list(models), [motions[0]] * len(models), [np.empty(0)] * len(models), solver),
        trunk,
        [Grid(begin_s, steps, True, solver)] * len(trunk),
        arc_length_m,
        [],
    )
    swing = Swing(batch, paths, [times] * len(batch), solver)
    branches = assemble(batch, solver.segments, fork_s, workers)
    for block in branches:
        block.resume_from(trunk)
    grids = [Grid.of(fork_s, [times], batch[b.lanes[0]], False, solver) for b in branches]
    out = np.empty((len(batch), *shape[2:]))
    move(swing, branches, grids, arc_length_m, out)
    return out.reshape(shape)


def _steps_alike(models: Sequence[CableModel], motions: Sequence[Motion], t_s: FloatArray) -> int:
    """Number of the steps between these times that end before the gripper's motions differ.

    The log's splines depend on all samples: differences below a nanometre are ignored.
    """
    steps = len(t_s) - 1
    # with an effect the motions can differ only a little before their logs do
    checked = np.unique(np.append(np.arange(0, steps, _STRIDE), np.arange(len(t_s))[-_LAST:]))
    for acting in {at_gripper(model) for model in models if at_gripper(model)}:
        first, *poses = (np.stack(pose_of(m, acting)(t_s[checked])) for m in motions)
        for pose in poses:
            different = checked[np.any(np.abs(pose - first) > _ALIKE, axis=0)]
            if different.size:
                # the last checked step without a difference; a step needs poses two steps ahead
                alike = checked[checked < different[0]]
                steps = min(steps, max(0, int(alike[-1]) - 2 if alike.size else 0))
    return steps
