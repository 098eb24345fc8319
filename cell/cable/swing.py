"""Simulation of moved cables: blocks of lanes on a common grid of steps."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cell.cable import camera
from cell.cable import layout as at
from cell.cable.arrays import FloatArray
from cell.cable.assembly import ParameterBlock, marker_weights
from cell.cable.effects.own import run_engine
from cell.cable.geometry import Motion
from cell.cable.gripper_motions import GripperMotions
from cell.cable.model import CableModel
from cell.cable.solver import DivergedError, LanesError, Solver, generalised_alpha, threads
from cell.cable.splines import Steps
from cell.cable.statics import settle
from cell.cable.stepping import integrate, nodes, sample_times
from cell.cable.wrench import AXES, Gauge, RowMeans, as_points, at_places

_MOST_STEPS = 5_000_000
#: Further steps after the last time of a wrench, which is interpolated between steps.
_STEPS_AROUND = 3


@dataclass(frozen=True)
class Swing:
    """Inputs of a batch: model, motion and times of each lane, and modes if it begins bent.

    moving  whether the cable also moves before the start, and is not held still until then
    gauge   sensor of the wrench at the clamp; with it, `wrench.AS_POINTS` further points follow the
            markers of a lane
    means   of each lane, the values of the wrench that are means of rows; () = none
    """

    models: list[CableModel]
    paths: list[Motion]
    times_s: list[FloatArray]
    solver: Solver
    bent: tuple[FloatArray, ...] = ()
    moving: bool = False
    gauge: Gauge | None = None
    means: tuple[RowMeans | None, ...] = ()

    def of(self, lanes: Sequence[int]) -> Swing:
        """The same of some of the lanes, in order; of all of them itself."""
        if len(lanes) == len(self.models):
            return self
        return Swing(
            [self.models[i] for i in lanes],
            [self.paths[i] for i in lanes],
            [self.times_s[i] for i in lanes],
            self.solver,
            tuple(self.bent[i] for i in lanes if self.bent),
            self.moving,
            self.gauge,
            tuple(self.means[i] for i in lanes if self.means),
        )


def move(
    swing: Swing,
    blocks: Sequence[ParameterBlock],
    grids: Sequence[Grid],
    arc_length_m: FloatArray,
    out: Sequence[FloatArray] | FloatArray,
) -> None:
    """Move all blocks along; write (times, markers, 2) of each lane to `out`, if it has any.

    raises  DivergedError, statics.UnsettledError: of the first block with such a lane
    """
    for _, error in failures(swing, blocks, grids, arc_length_m, out):
        raise error


def failures(
    swing: Swing,
    blocks: Sequence[ParameterBlock],
    grids: Sequence[Grid],
    arc_length_m: FloatArray,
    out: Sequence[FloatArray] | FloatArray,
) -> list[tuple[ParameterBlock, LanesError]]:
    """As `move`; returns blocks with lanes that cannot be simulated, which are not written."""
    cell, weights = marker_weights(swing.models, arc_length_m, swing.solver.segments)
    longest = max(grids, key=lambda grid: grid.steps)
    hands = GripperMotions(swing.paths, swing.models, longest.in_equal_steps)

    def run(block: ParameterBlock, grid: Grid) -> LanesError | None:
        try:
            _run(block, grid, hands, swing, (cell, weights), out)
        except LanesError as error:
            return error
        return None

    workers = threads() if swing.solver.threads is None else swing.solver.threads
    if len(blocks) == 1 or workers == 1:
        errors = [run(block, grid) for block, grid in zip(blocks, grids, strict=True)]
    else:
        errors = list(_pool(os.getpid(), workers).map(run, blocks, grids))
    return [(b, error) for b, error in zip(blocks, errors, strict=True) if error is not None]


@lru_cache(maxsize=2)
def _pool(process: int, workers: int) -> ThreadPoolExecutor:
    """Threads of this process; a forked child makes its own."""
    return ThreadPoolExecutor(workers, thread_name_prefix="cable")


@dataclass(frozen=True)
class Grid:
    """Steps of a block, from the beginning that all blocks share.

    at_rest  whether it begins in equilibrium, not in the state that the block is in
    """

    begin_s: float
    steps: int
    at_rest: bool
    solver: Solver

    @staticmethod
    def of(
        begin_s: float,
        times_s: Sequence[FloatArray],
        model: CableModel,
        rests: bool,
        solver: Solver,
        *,
        gauged: bool = False,
    ) -> Grid:
        """Grid of lanes with these times and such models.  Raises ValueError: too many steps.

        gauged  whether the wrench at these times is computed, too
        """
        last = max((float(t[-1]) for t in times_s if t.size), default=begin_s)
        end = last + (camera.LOOK_AHEAD_S if camera.shifts_time([model]) else 0.0)
        steps = max(1, int(np.ceil((end - begin_s) / solver.step_s - 1e-9)))
        steps += _STEPS_AROUND if gauged else 0
        if steps > _MOST_STEPS:
            raise ValueError(f"{steps} steps of {solver.step_s} s from {begin_s} s to {last} s")
        return Grid(begin_s, steps, rests, solver)

    @property
    def end_s(self) -> float:
        """Time of the last step's end."""
        return self.begin_s + self.steps * self.solver.step_s

    @property
    def in_equal_steps(self) -> Steps:
        """The steps, and when in each of them the solver's equation holds."""
        collocation = float(generalised_alpha(self.solver.step_s, self.solver.damping)[12])
        return Steps(self.begin_s, self.solver.step_s, self.steps, collocation)


def _bend(
    block: ParameterBlock, order: Sequence[int], bent: Sequence[FloatArray], length_m: float
) -> None:
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
    block: ParameterBlock,
    grid: Grid,
    hands: GripperMotions,
    swing: Swing,
    markers: tuple[NDArray[np.int64], FloatArray],
    out: Sequence[FloatArray] | FloatArray,
) -> None:
    """Move a block along, and write what the camera sees of each lane to `out`, if it has any."""
    lanes = block.lanes
    order = lanes + lanes[:1] * (block.width - len(lanes))
    times = _needed(block, grid, swing)
    held = hands.at_times(order, each_once(lambda t: np.append(grid.begin_s, t), times))
    if grid.at_rest:
        first = np.zeros((at.BASE_FIELDS, at.LANES))
        first[: held.shape[1]] = held[0]
        settle(block, first.ravel())
    if swing.bent:
        _bend(block, order, swing.bent, swing.models[0].cable.free_length_m)
    base = hands.at_steps(order, grid.in_equal_steps)
    wrench = np.empty(0) if swing.gauge is None else at.vectors(grid.steps, AXES)
    bends = _integrate(block, grid, base, times, wrench)
    if not len(out):
        return
    place = out[lanes[0] : lanes[0] + len(lanes)]
    alike = all(t is swing.times_s[lanes[0]] for t in times)
    direct = isinstance(place, np.ndarray) and alike and lanes[-1] == lanes[0] + len(lanes) - 1
    direct = direct and swing.gauge is None
    fresh = (len(lanes), len(bends), len(markers[0]), 2)
    points = place if isinstance(place, np.ndarray) and direct else np.empty(fresh)
    seen_from = held[1:].ravel()
    nodes(bends.ravel(), block.width, block.segments, block.lengths, seen_from, *markers, points)
    for lane, t, here in zip(lanes, times, points, strict=False):
        there = here[: len(t)]
        observed = camera.image_positions(
            swing.models[lane], swing.times_s[lane], t, there, in_motion=swing.moving
        )
        if observed is not there or not direct:
            out[lane][:, : len(markers[0])] = observed
    if swing.gauge is not None:
        for k, lane in enumerate(lanes):
            shown = swing.gauge.measured(
                wrench[:, :, k], base[:, :, k], swing.models[lane].gravity_m_per_s2
            )
            held = at_places(shown, _among(grid, swing.times_s[lane]))
            means = swing.means[lane] if swing.means else None
            if means is not None:
                of_rows = means.of(at_places(shown, _among(grid, means.t_s)))
                held[means.among] = np.where(np.isnan(of_rows), held[means.among], of_rows)
            out[lane][:, len(markers[0]) :] = as_points(held)


def _among(grid: Grid, times_s: FloatArray) -> FloatArray:
    """(T,) times, counted in steps from the first one's collocation time."""
    steps = grid.in_equal_steps
    return np.asarray((times_s - steps.start_s) / steps.step_s - steps.collocation)


def _integrate(
    block: ParameterBlock,
    grid: Grid,
    base: FloatArray,
    times_s: Sequence[FloatArray],
    wrench: FloatArray,
) -> FloatArray:
    """(times, n + 1, LANES) bends of all lanes at their times.  Raises DivergedError.

    wrench  (steps, 3, LANES) is filled with the wrench on the cables; (0,) = not computed
    """
    solver, n = grid.solver, block.segments
    bends = at.vectors(max(map(len, times_s)), n + 1)
    bend = block.state.reshape(n + 1, at.FIELDS, at.LANES)[:, at.BEND]
    for k, t in enumerate(times_s):
        bends[: int(np.searchsorted(t, grid.begin_s, "right")), :, k] = bend[:, k]
    bad = run_engine(
        integrate,
        block.own,
        block.state,
        block.width,
        n,
        base.ravel(),
        generalised_alpha(solver.step_s, solver.damping),
        block.nonlinear,
        block.iterations,
        block.effects,
        sample_times(_in_steps(times_s, grid)),
        bends.ravel(),
        wrench.ravel(),
    )
    if bad >= 0:
        final = bend[:, : len(block.lanes)]
        broken = ~np.all(np.abs(final) < np.pi, axis=0)
        lanes = [lane for lane, diverged in zip(block.lanes, broken, strict=True) if diverged]
        time_s = grid.begin_s + (bad + 1) * solver.step_s
        raise DivergedError(lanes or block.lanes, time_s, solver.step_s)
    return bends


def _needed(block: ParameterBlock, grid: Grid, lanes: Swing) -> list[FloatArray]:
    """Times of the needed positions, of each computed lane: the pictures', or a fine grid."""
    times = [lanes.times_s[lane] for lane in block.lanes]
    earliest = min(times, key=lambda t: float(t[0]) if t.size else np.inf)
    model, step_s = lanes.models[block.lanes[0]], grid.solver.step_s
    if earliest.size and camera.shifts_time([model]):
        scene = camera.scene_times(model, earliest, grid.begin_s, grid.end_s, step_s)
        times = [scene] * len(times)
    return times + times[-1:] * (block.width - len(times))


def _in_steps(times_s: Sequence[FloatArray], grid: Grid) -> list[FloatArray]:
    """Times of every lane in steps from the beginning."""
    # a last time rounded to after the last step would not be recorded
    return each_once(
        lambda t: np.minimum((t - grid.begin_s) / grid.solver.step_s, grid.steps), times_s
    )


def each_once(
    function: Callable[[FloatArray], FloatArray], arrays: Sequence[FloatArray]
) -> list[FloatArray]:
    """Apply a function to arrays; an array that occurs several times is computed once."""
    made = {id(a): a for a in arrays}
    made = {number: function(a) for number, a in made.items()}
    return [made[id(a)] for a in arrays]


#: Roots of cosh β cos β = −1.
ROOTS = (1.87510407, 4.69409113, 7.85475744, 10.99554073, 14.13716839, 17.27875953)


def mode_curvature(fraction: FloatArray, modes: int) -> FloatArray:
    """(fractions, modes) curvature times free length that moves the tip by one free length.

    To first order in the bending; at fractions 0 … 1 of the length from the clamp.
    source  Blevins 1979, Formulas for Natural Frequency and Mode Shape, table 8-1, clamped–free
    """
    roots = np.array(ROOTS[:modes])
    x = np.asarray(fraction, dtype=np.float64)[:, None] * roots
    ratio = (np.sinh(roots) - np.sin(roots)) / (np.cosh(roots) + np.cos(roots))
    shape = np.cosh(x) + np.cos(x) - ratio * (np.sinh(x) + np.sin(x))
    tip = np.cosh(roots) - np.cos(roots) - ratio * (np.sinh(roots) - np.sin(roots))
    return np.asarray(roots**2 * shape / tip)
