"""Motion of held cables whose gripping points are moved: many at once."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from cell.cable import camera
from cell.cable import layout as at
from cell.cable.assembly import DEFAULT_SEGMENTS, Block, assemble, marker_weights
from cell.cable.clamp import Instants, base_rows, pose_of
from cell.cable.effects.base import ActiveEffect
from cell.cable.effects.own import run_engine
from cell.cable.geometry import Motion, Start
from cell.cable.model import CableModel
from cell.cable.modes import mode_curvature
from cell.cable.statics import settle
from cell.cable.stepping import integrate, nodes, weave

FloatArray = NDArray[np.float64]

_MOST_STEPS = 5_000_000
#: Poses of the hand this near to each other are the same, m or rad.
_ALIKE = 1e-9


@dataclass(frozen=True)
class Solver:
    """Mesh and step of a simulation, and how much of the computer it may take.

    segments  4 … 10000
    step_s    the grid of steps is shared by all lanes of a batch
    damping   ρ∞ of generalised-α, 0 … 1: what is left after a step of an infinitely fast mode
    threads   at most so many at a time; None = as many as this process may use cores
    """

    segments: int = DEFAULT_SEGMENTS
    step_s: float = 0.75e-3
    damping: float = 0.8
    threads: int | None = None

    def __post_init__(self) -> None:
        if not 4 <= self.segments <= 10_000:
            raise ValueError(f"solver.segments = {self.segments}: must be 4 … 10000")
        if not 1e-6 <= self.step_s <= 0.05:
            raise ValueError(f"solver.step_s = {self.step_s} s: must be 1e-6 … 0.05 s")
        if not 0.0 <= self.damping <= 1.0:
            raise ValueError(f"solver.damping = {self.damping}: must be 0 … 1")
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"solver.threads = {self.threads}: must be at least 1, or None")


DEFAULT_SOLVER = Solver()


class DivergedError(RuntimeError):
    """A simulation left the possible.  Scenario: a step far too long for a fast, soft cable."""

    def __init__(self, lane: int, time_s: float, step_s: float) -> None:
        super().__init__(
            f"lane {lane} diverged at t = {time_s:.4f} s (not finite, or a hinge bent by half a "
            f"turn); use a shorter step than {step_s * 1e3:g} ms or check the parameters"
        )
        self.lane = lane
        self.time_s = time_s


def simulate(
    models: CableModel | Sequence[CableModel],
    motions: Motion | Sequence[Motion],
    times_s: FloatArray,
    arc_length_m: FloatArray,
    *,
    solver: Solver = DEFAULT_SOLVER,
    start: Start = "equilibrium",
    release_s: float | None = None,
    bent: Sequence[FloatArray] = (),
) -> FloatArray:
    """Positions of markers on cables against time.

    models, motions  one of either for all lanes, or as many of both as there are lanes.  Before
                     and after its log a motion is held.
    times_s          (times,) increasing
    arc_length_m     (markers,) from the gripping point
    start            from rest, or held straight along the clamp angle until `release_s`, or from
                     rest with `bent` added: held so until `release_s`, or moving so at the first
                     of all times
    bent             (2, modes) of each lane that is held or moving: places and velocities of the
                     modes of `modes.mode_curvature`, as the tip's, in free lengths and per second
    returns          (lanes, times, markers, 2) x, y in m
    raises           ValueError: bad input; DivergedError; statics.UnsettledError
    """
    batch, paths = _lanes(models, motions)
    times = _checked(times_s)
    out = np.empty((len(batch), times.size, np.size(arc_length_m), 2))
    begin = _Begin.of(start, release_s, bent, len(batch))
    _simulate(batch, paths, [times] * len(batch), arc_length_m, list(out), solver, begin)
    return out


def simulate_each(
    models: CableModel | Sequence[CableModel],
    motions: Motion | Sequence[Motion],
    times_s: Sequence[FloatArray],
    arc_length_m: FloatArray,
    *,
    solver: Solver = DEFAULT_SOLVER,
    start: Start = "equilibrium",
    release_s: float | None = None,
    bent: Sequence[FloatArray] = (),
) -> list[FloatArray]:
    """Positions of markers of each lane at its own times, (times, markers, 2); as `simulate`.

    All lanes begin when the first of them does, and share one grid of steps.
    """
    batch, paths = _lanes(models, motions)
    times = [_checked(t) for t in times_s]
    if len(times) != len(batch):
        raise ValueError(f"times of {len(times)} lanes for {len(batch)}: give one array per lane")
    out = [np.empty((t.size, np.size(arc_length_m), 2)) for t in times]
    begin = _Begin.of(start, release_s, bent, len(batch))
    _simulate(batch, paths, times, arc_length_m, out, solver, begin)
    return out


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

    What the motions have in common is simulated once per model, not once per motion; only where a
    camera shows other times than its pictures', everything is simulated.

    alike_until_s  until then all motions are the same, as logged; an effect on the hand may part
                   them earlier
    times_s        (times,) increasing, none of them before that
    returns        (motions, models, times, markers, 2) x, y in m
    raises         as `simulate`; ValueError: a time before the motions part
    """
    times = _checked(times_s)
    if times.size and times[0] < alike_until_s:
        raise ValueError(f"a marker is asked for at {times[0]} s: the motions part later")
    batch, paths = list(models) * len(motions), [m for m in motions for _ in models]
    begin_s = float(min(m.t_s[0] for m in motions))
    steps = int((alike_until_s - begin_s) / solver.step_s + 1e-9)
    steps = _steps_alike(models, motions, begin_s + solver.step_s * np.arange(steps + 1.0))
    shape = (len(motions), len(models), times.size, np.size(arc_length_m), 2)
    if steps < 1 or camera.shifts_time(models):
        return simulate(batch, paths, times, arc_length_m, solver=solver).reshape(shape)
    fork_s = begin_s + steps * solver.step_s
    workers = threads() if solver.threads is None else solver.threads
    trunk = assemble(models, solver.segments, begin_s, workers)
    _swing(
        _Swing(list(models), [motions[0]] * len(models), [np.empty(0)] * len(models), solver),
        trunk,
        [_Grid(begin_s, steps, np.empty(0), True, solver)] * len(trunk),
        arc_length_m,
        [],
    )
    swing = _Swing(batch, paths, [times] * len(batch), solver)
    branches = assemble(batch, solver.segments, fork_s, workers)
    for block in branches:
        block.go_on_from(trunk)
    grids = [_Grid.of(fork_s, [times], batch[b.lanes[0]], False, solver) for b in branches]
    out = np.empty((len(batch), *shape[2:]))
    _swing(swing, branches, grids, arc_length_m, list(out))
    return out.reshape(shape)


def _steps_alike(models: Sequence[CableModel], motions: Sequence[Motion], t_s: FloatArray) -> int:
    """Of the steps between these times, how many are done before the hand's motions part.

    The log's splines join all samples: what differs by less than a nanometre is the same.
    """
    steps = len(t_s) - 1
    for acting in {_on_hand(model) for model in models if _on_hand(model)}:
        first, *others = (np.stack(pose_of(m, acting)(t_s)) for m in motions)
        for other in others:
            apart = np.flatnonzero(np.any(np.abs(other - first) > _ALIKE, axis=0))
            # a step's acceleration looks half a step ahead
            steps = min(steps, max(0, int(apart[0]) - 2)) if apart.size else steps
    return steps


def _on_hand(model: CableModel) -> tuple[ActiveEffect, ...]:
    """The effects that change how the hand moves."""
    return tuple(a for a in model.effects if a.effect.clamp is not None)


def _lanes(
    models: CableModel | Sequence[CableModel], motions: Motion | Sequence[Motion]
) -> tuple[list[CableModel], list[Motion]]:
    """One model and one motion per lane.  Raises ValueError: their numbers do not go together."""
    batch = [models] if isinstance(models, CableModel) else list(models)
    paths = [motions] if isinstance(motions, Motion) else list(motions)
    lanes = max(len(batch), len(paths))
    for name, given in (("models", batch), ("motions", paths)):
        if len(given) not in (1, lanes) or not given:
            raise ValueError(f"{len(given)} {name} for {lanes} lanes: give one, or one per lane")
    return batch * (lanes // len(batch)), paths * (lanes // len(paths))


def _checked(times_s: FloatArray) -> FloatArray:
    times = np.ascontiguousarray(times_s, dtype=np.float64)
    if times.ndim != 1 or not np.all(np.isfinite(times)) or np.any(np.diff(times) <= 0.0):
        raise ValueError("times_s must be one-dimensional, finite and strictly increasing")
    return times


def _simulate(
    batch: list[CableModel],
    paths: list[Motion],
    times_s: list[FloatArray],
    arc_length_m: FloatArray,
    out: list[FloatArray],
    solver: Solver,
    how: _Begin,
) -> None:
    """Write (times, markers, 2) of each lane to `out`."""
    first = [float(t[0]) for t in times_s if t.size]
    if not first:
        return
    begin = how.time_s(first, paths)
    workers = threads() if solver.threads is None else solver.threads
    blocks = assemble(batch, solver.segments, begin, workers)
    rests = how.start != "straight"
    grids = [
        _Grid.of(begin, [times_s[i] for i in b.lanes], batch[b.lanes[0]], rests, solver)
        for b in blocks
    ]
    _swing(_Swing(batch, paths, times_s, solver, how.bent), blocks, grids, arc_length_m, out)


@dataclass(frozen=True)
class _Swing:
    """Model, motion, times and, if it begins bent, the modes of each lane."""

    models: list[CableModel]
    paths: list[Motion]
    times_s: list[FloatArray]
    solver: Solver
    bent: tuple[FloatArray, ...] = ()


def _swing(
    swing: _Swing,
    blocks: Sequence[Block],
    grids: Sequence[_Grid],
    arc_length_m: FloatArray,
    out: list[FloatArray],
) -> None:
    """Move all blocks along; write (times, markers, 2) of each lane to `out`, if it has any."""
    cell, weights = marker_weights(swing.models, arc_length_m, swing.solver.segments)
    rows = _rows(swing.paths, swing.models, max(grids, key=lambda grid: grid.steps))

    def run(block: Block, grid: _Grid) -> None:
        seen = _run(block, grid, rows, swing, cell, weights)
        if not out:
            return
        for lane, points in zip(block.lanes, seen, strict=True):
            times = swing.times_s[lane]
            shared = len(times) == len(grid.times_s)
            out[lane][:] = points if shared else points[np.searchsorted(grid.times_s, times)]

    workers = threads() if swing.solver.threads is None else swing.solver.threads
    if len(blocks) == 1 or workers == 1:
        for block, grid in zip(blocks, grids, strict=True):
            run(block, grid)
    else:
        list(_pool(os.getpid(), workers).map(run, blocks, grids))


def threads() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@lru_cache(maxsize=2)
def _pool(process: int, workers: int) -> ThreadPoolExecutor:
    """Threads of this process; a forked child makes its own."""
    return ThreadPoolExecutor(workers, thread_name_prefix="cable")


@dataclass(frozen=True)
class _Begin:
    """How all lanes of a batch begin; `bent` as in `simulate`."""

    start: Start
    release_s: float | None
    bent: tuple[FloatArray, ...]

    @staticmethod
    def of(start: Start, release_s: float | None, bent: Sequence[FloatArray], lanes: int) -> _Begin:
        """Checked.  Raises ValueError: they do not go together."""
        released = start in ("straight", "held")
        if start not in get_args(Start) or released != (release_s is not None):
            raise ValueError(
                f"start = {start!r}, release_s = {release_s}: 'straight' and 'held' have a release"
            )
        if len(bent) != (lanes if start in ("held", "moving") else 0):
            raise ValueError(
                f"start = {start!r} with the bends of {len(bent)} of {lanes} lanes: each that is "
                "held or moving has its own, and no other"
            )
        return _Begin(start, release_s, tuple(bent))

    def time_s(self, first_s: Sequence[float], paths: Sequence[Motion]) -> float:
        """When lanes whose first pictures are at `first_s` begin to be simulated."""
        if self.release_s is not None:
            return float(self.release_s)
        if self.start == "moving":
            return min(first_s)
        return float(min(*first_s, *(m.t_s[0] for m in paths)))


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


@dataclass(frozen=True)
class _Grid:
    """Steps of a block, from the beginning that all blocks share, and the times of its pictures.

    rests  whether it begins in equilibrium, not in the state that the block is in
    """

    begin_s: float
    steps: int
    times_s: FloatArray
    rests: bool
    solver: Solver

    @staticmethod
    def of(
        begin_s: float,
        times_s: Sequence[FloatArray],
        model: CableModel,
        rests: bool,
        solver: Solver,
    ) -> _Grid:
        """Of lanes with these times and models of one kind.  Raises ValueError: too many steps."""
        alike = all(t is times_s[0] for t in times_s)
        times = times_s[0] if alike else np.unique(np.concatenate(times_s))
        last = float(times[-1]) if times.size else begin_s
        end = last + (camera.LOOK_AHEAD_S if camera.shifts_time([model]) else 0.0)
        steps = max(1, int(np.ceil((end - begin_s) / solver.step_s - 1e-9)))
        if steps > _MOST_STEPS:
            raise ValueError(f"{steps} steps of {solver.step_s} s from {begin_s} s to {last} s")
        return _Grid(begin_s, steps, times, rests, solver)

    @property
    def end_s(self) -> float:
        """Time of the last step's end."""
        return self.begin_s + self.steps * self.solver.step_s


def generalised_alpha(step_s: float, damping: float) -> FloatArray:
    """Coefficients of a step: see `stepping.predict` and `stepping.advance`.

    [0] h, [1] ∂q/∂a, [2] ∂v/∂a at the collocation time, [3] v, [4] a_old in q, [5] a_old in v,
    [6], [7] a_new from a and a_old, [8], [9] a_old, a_new in q, [10], [11] in v, [12] the
    collocation time in steps.
    """
    h = step_s
    mass = (2.0 * damping - 1.0) / (damping + 1.0)
    force = damping / (damping + 1.0)
    gamma = 0.5 - mass + force
    beta = 0.25 * (1.0 - mass + force) ** 2
    c = 1.0 - force
    new, old = 1.0 / (1.0 - mass), -mass / (1.0 - mass)
    q_old, v_old = h * h * (0.5 - beta), h * (1.0 - gamma)
    q_new, v_new = h * h * beta, h * gamma
    return np.array(
        [
            h,
            c * q_new * new,
            c * v_new * new,
            c * h,
            c * (q_old + q_new * old),
            c * (v_old + v_new * old),
            new,
            old,
            q_old,
            q_new,
            v_old,
            v_new,
            c,
        ]
    )


def _rows(paths: Sequence[Motion], batch: Sequence[CableModel], grid: _Grid) -> list[FloatArray]:
    """Clamp motion of each lane; equal ones are computed once."""
    known: dict[object, FloatArray] = {}
    rows = []
    c = float(generalised_alpha(grid.solver.step_s, grid.solver.damping)[12])
    of_grid = (grid.begin_s, grid.solver.step_s, grid.steps, c)
    instants = Instants(*of_grid)
    for motion, model in zip(paths, batch, strict=True):
        acting = _on_hand(model)
        key = (id(motion), *acting)
        if key not in known:
            known[key] = base_rows(motion, acting, *of_grid, instants)
        rows.append(known[key])
    return rows


def _hand(motion: Motion, model: CableModel) -> tuple[object, ...]:
    """What the motion of the hand depends on."""
    return (id(motion), *_on_hand(model))


def interleave(rows: Sequence[FloatArray], shape: tuple[int, int]) -> FloatArray:
    """(shape…, LANES) with lane k from the first of rows[k]; cheap when lanes share one array."""
    result = np.zeros((*shape, at.LANES))
    if all(r is rows[0] for r in rows):
        result[:] = rows[0][: shape[0], :, None]
    else:
        weave(np.stack([r[: shape[0]] for r in rows]), result)
    return result


def _run(
    block: Block,
    grid: _Grid,
    rows: Sequence[FloatArray],
    lanes: _Swing,
    cell: NDArray[np.int64],
    weights: FloatArray,
) -> FloatArray:
    """(lanes of the block, times, markers, 2) as the camera sees them."""
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
    models = [batch[lane] for lane in block.lanes]
    times = camera.scene_times(models[0], grid.times_s, grid.begin_s, grid.end_s, solver.step_s)
    moving = times > grid.begin_s
    bends = np.empty((times.size, n + 1, at.LANES))
    bends[~moving] = block.state.reshape(n + 1, at.FIELDS, at.LANES)[:, at.BEND]
    swing = np.empty((int(np.count_nonzero(moving)), n + 1, at.LANES))
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
        # rounding must not put the last time behind the last step: it would never be written
        np.minimum((times[moving] - grid.begin_s) / solver.step_s, grid.steps),
        swing.ravel(),
    )
    if bad >= 0:
        final = block.state.reshape(n + 1, at.FIELDS, at.LANES)[:, at.BEND, :w]
        broken = ~np.all(np.abs(final) < np.pi, axis=0)
        lane = block.lanes[int(np.argmax(broken))]
        raise DivergedError(lane, grid.begin_s + (bad + 1) * solver.step_s, solver.step_s)
    bends[moving] = swing
    known: dict[object, FloatArray] = {}
    for lane, pose in zip(order, poses, strict=True):
        key = _hand(paths[lane], batch[lane])
        if key not in known:
            known[key] = np.stack(pose(times), axis=1)
    clamp = interleave([known[_hand(paths[lane], batch[lane])] for lane in order], (times.size, 3))
    out = np.empty((block.width, times.size, len(cell), 2))
    nodes(bends.ravel(), block.width, n, block.lengths, clamp.ravel(), cell, weights, out)
    return camera.seen(models, grid.times_s, times, out[:w])
