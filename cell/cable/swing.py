"""Cables moved along with their hands: blocks of lanes on one grid of steps."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cell.cable import camera
from cell.cable import layout as at
from cell.cable.assembly import Block, marker_weights
from cell.cable.clamp import Instants, base_rows, pose_of
from cell.cable.effects.base import ActiveEffect
from cell.cable.effects.own import run_engine
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.cable.modes import mode_curvature
from cell.cable.solver import DivergedError, Solver, generalised_alpha, threads
from cell.cable.statics import settle
from cell.cable.stepping import integrate, looks, nodes, weave

FloatArray = NDArray[np.float64]

_MOST_STEPS = 5_000_000


@dataclass(frozen=True)
class Swing:
    """Model, motion, times and, if it begins bent, the modes of each lane."""

    models: list[CableModel]
    paths: list[Motion]
    times_s: list[FloatArray]
    solver: Solver
    bent: tuple[FloatArray, ...] = ()


def move(
    swing: Swing,
    blocks: Sequence[Block],
    grids: Sequence[Grid],
    arc_length_m: FloatArray,
    out: list[FloatArray],
) -> None:
    """Move all blocks along; write (times, markers, 2) of each lane to `out`, if it has any."""
    cell, weights = marker_weights(swing.models, arc_length_m, swing.solver.segments)
    rows = _rows(swing.paths, swing.models, max(grids, key=lambda grid: grid.steps))

    def run(block: Block, grid: Grid) -> None:
        seen = _run(block, grid, rows, swing, cell, weights)
        if not out:
            return
        for lane, points in zip(block.lanes, seen, strict=True):
            out[lane][:] = points

    workers = threads() if swing.solver.threads is None else swing.solver.threads
    if len(blocks) == 1 or workers == 1:
        for block, grid in zip(blocks, grids, strict=True):
            run(block, grid)
    else:
        list(_pool(os.getpid(), workers).map(run, blocks, grids))


@lru_cache(maxsize=2)
def _pool(process: int, workers: int) -> ThreadPoolExecutor:
    """Threads of this process; a forked child makes its own."""
    return ThreadPoolExecutor(workers, thread_name_prefix="cable")


@dataclass(frozen=True)
class Grid:
    """Steps of a block, from the beginning that all blocks share.

    rests  whether it begins in equilibrium, not in the state that the block is in
    """

    begin_s: float
    steps: int
    rests: bool
    solver: Solver

    @staticmethod
    def of(
        begin_s: float,
        times_s: Sequence[FloatArray],
        model: CableModel,
        rests: bool,
        solver: Solver,
    ) -> Grid:
        """Of lanes with these times and models of one kind.  Raises ValueError: too many steps."""
        last = max((float(t[-1]) for t in times_s if t.size), default=begin_s)
        end = last + (camera.LOOK_AHEAD_S if camera.shifts_time([model]) else 0.0)
        steps = max(1, int(np.ceil((end - begin_s) / solver.step_s - 1e-9)))
        if steps > _MOST_STEPS:
            raise ValueError(f"{steps} steps of {solver.step_s} s from {begin_s} s to {last} s")
        return Grid(begin_s, steps, rests, solver)

    @property
    def end_s(self) -> float:
        """Time of the last step's end."""
        return self.begin_s + self.steps * self.solver.step_s


def on_hand(model: CableModel) -> tuple[ActiveEffect, ...]:
    """The effects that change how the hand moves."""
    return tuple(a for a in model.effects if a.effect.clamp is not None)


def _rows(paths: Sequence[Motion], batch: Sequence[CableModel], grid: Grid) -> list[FloatArray]:
    """Clamp motion of each lane; equal ones are computed once."""
    known: dict[object, FloatArray] = {}
    rows = []
    c = float(generalised_alpha(grid.solver.step_s, grid.solver.damping)[12])
    of_grid = (grid.begin_s, grid.solver.step_s, grid.steps, c)
    instants = Instants(*of_grid)
    for motion, model in zip(paths, batch, strict=True):
        acting = on_hand(model)
        key = (id(motion), *acting)
        if key not in known:
            known[key] = base_rows(motion, acting, *of_grid, instants)
        rows.append(known[key])
    return rows


def interleave(rows: Sequence[FloatArray], shape: tuple[int, int]) -> FloatArray:
    """(shape…, LANES) with lane k from the first of rows[k]; cheap when lanes share one array."""
    result = np.zeros((*shape, at.LANES))
    if all(r is rows[0] for r in rows):
        result[:] = rows[0][: shape[0], :, None]
    else:
        weave(np.stack([r[: shape[0]] for r in rows]), result)
    return result


def _bend(block: Block, order: Sequence[int], bent: Sequence[FloatArray], length_m: float) -> None:
    """Add the places and velocities of the modes to the state of a block."""
    n = block.segments
    state = block.state.reshape(n + 1, at.FIELDS, at.LANES)
    fraction = np.concatenate(([0.0], (np.arange(1, n + 1) - 0.5) / n))
    for lane, number in enumerate(order):
        places, velocities = np.asarray(bent[number]).reshape(2, -1)
        shape = mode_curvature(fraction, len(places)) / length_m
        per_length = state[1:, at.PER_LENGTH, lane]
        state[1:, at.BEND, lane] += shape[1:] @ places / per_length
        state[1:, at.RATE, lane] += shape[1:] @ velocities / per_length


def _run(
    block: Block,
    grid: Grid,
    rows: Sequence[FloatArray],
    lanes: Swing,
    cell: NDArray[np.int64],
    weights: FloatArray,
) -> list[FloatArray]:
    """(times, markers, 2) of every lane of the block as the camera sees it."""
    batch, paths = lanes.models, lanes.paths
    solver, n, w = grid.solver, block.segments, len(block.lanes)
    order = block.lanes + block.lanes[:1] * (block.width - w)
    base = interleave([rows[lane] for lane in order], (grid.steps, at.BASE_FIELDS))
    poses = [pose_of(paths[lane], batch[lane].effects) for lane in order]
    if grid.rests:
        first = np.zeros((1, at.BASE_FIELDS, at.LANES))
        for k, pose in enumerate(poses):
            x, y, angle = pose(np.array([grid.begin_s]))
            first[0, :3, k] = x[0], y[0], angle[0]
        settle(block, first.ravel())
    if lanes.bent:
        _bend(block, order, lanes.bent, batch[0].cable.free_length_m)
    times = _needed(block, grid, lanes)
    bends = np.zeros((max(map(len, times)), n + 1, at.LANES))
    begun = block.state.reshape(n + 1, at.FIELDS, at.LANES)[:, at.BEND]
    for k, t in enumerate(times):
        bends[: int(np.searchsorted(t, grid.begin_s, "right")), :, k] = begun[:, k]
    bad = run_engine(
        integrate,
        block.own,
        block.state,
        block.width,
        n,
        base.ravel(),
        generalised_alpha(solver.step_s, solver.damping),
        block.nonlinear,
        block.passes,
        block.effects,
        looks(_in_steps(times, grid)),
        bends.ravel(),
    )
    if bad >= 0:
        final = block.state.reshape(n + 1, at.FIELDS, at.LANES)[:, at.BEND, :w]
        broken = ~np.all(np.abs(final) < np.pi, axis=0)
        lane = block.lanes[int(np.argmax(broken))]
        raise DivergedError(lane, grid.begin_s + (bad + 1) * solver.step_s, solver.step_s)
    clamp = np.zeros((len(bends), 3, at.LANES))
    known: dict[object, FloatArray] = {}
    for k, (lane, pose, t) in enumerate(zip(order, poses, times, strict=True)):
        key = (id(paths[lane]), *on_hand(batch[lane]), id(t))
        if key not in known:
            known[key] = np.stack(pose(t), axis=1)
        clamp[: len(t), :, k] = known[key]
    out = np.empty((block.width, len(bends), len(cell), 2))
    nodes(bends.ravel(), block.width, n, block.lengths, clamp.ravel(), cell, weights, out)
    return [
        camera.seen(batch[lane], lanes.times_s[lane], t, points[: len(t)])
        for lane, t, points in zip(block.lanes, times[:w], out[:w], strict=True)
    ]


def _needed(block: Block, grid: Grid, lanes: Swing) -> list[FloatArray]:
    """When positions are needed of all lanes computed: at the pictures, or on a fine grid."""
    times = [lanes.times_s[lane] for lane in block.lanes]
    earliest = min(times, key=lambda t: float(t[0]) if t.size else np.inf)
    model, step_s = lanes.models[block.lanes[0]], grid.solver.step_s
    if camera.shifts_time([model]):
        scene = camera.scene_times(model, earliest, grid.begin_s, grid.end_s, step_s)
        times = [scene] * len(times)
    return times + times[-1:] * (block.width - len(times))


def _in_steps(times_s: Sequence[FloatArray], grid: Grid) -> list[FloatArray]:
    """Times of every lane in steps from the beginning; what was one array is one again."""
    known: dict[int, FloatArray] = {}
    for t in times_s:
        if id(t) not in known:
            # rounding must not put the last time behind the last step: it would never be written
            known[id(t)] = np.minimum((t - grid.begin_s) / grid.solver.step_s, grid.steps)
    return [known[id(t)] for t in times_s]
