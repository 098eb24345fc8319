"""Motion of held cables whose gripping points are moved: many at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.assembly import ParameterBlock, assemble, slipped_out
from cell.cable.geometry import Motion, Start
from cell.cable.model import CableModel
from cell.cable.solver import DEFAULT_SOLVER, LanesError, Solver, threads
from cell.cable.swing import Grid, Swing, each_once, failures
from cell.cable.wrench import AS_POINTS, Gauge, RowMeans


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
    times = increasing(times_s)
    out = np.empty((len(batch), times.size, np.size(arc_length_m), 2))
    begin = Beginning.of(start, release_s, bent, len(batch))
    swing = begin.swing(batch, paths, [times] * len(batch), solver)
    _simulate(swing, begin, arc_length_m, out)
    return out


def simulate_each(
    models: CableModel | Sequence[CableModel],
    motions: Motion | Sequence[Motion],
    times_s: Sequence[FloatArray],
    arc_length_m: FloatArray,
    *,
    solver: Solver = DEFAULT_SOLVER,
    begin: Beginning | None = None,
    gauge: Gauge | None = None,
    means: Sequence[RowMeans | None] = (),
) -> list[FloatArray]:
    """Positions of markers of each lane at its own times, (times, markers, 2); as `simulate`.

    All lanes begin when the first of them does, and share one grid of steps.  Lanes that cannot be
    simulated are nan instead of raising, and do not affect the others.

    begin    of all lanes; None = from rest
    gauge    sensor of the wrench at the clamp: two further points follow the markers, the force
             x, y, N, that clamp and sensor exert on cable and tool, and its moment about the
             gripping point, N·m, with a 0.  Before a cable is let go its wrench is that of the
             moment after
    means    of each lane: the times with means of the sensor's rows instead of its value then;
             () = none
    """
    batch, paths = _lanes(models, motions)
    times = each_once(increasing, times_s)
    if len(times) != len(batch):
        raise ValueError(f"times of {len(times)} lanes for {len(batch)}: give one array per lane")
    points = np.size(arc_length_m) + (0 if gauge is None else AS_POINTS)
    out = [np.empty((t.size, points, 2)) for t in times]
    begin = Beginning.of("equilibrium", None, (), len(batch)) if begin is None else begin
    swing = replace(begin.swing(batch, paths, times, solver), gauge=gauge, means=tuple(means))
    _simulate(swing, begin, arc_length_m, out, spared=True)
    return out


def _lanes(
    models: CableModel | Sequence[CableModel], motions: Motion | Sequence[Motion]
) -> tuple[list[CableModel], list[Motion]]:
    """One model and one motion per lane.  Raises ValueError: their numbers do not match."""
    batch = [models] if isinstance(models, CableModel) else list(models)
    paths = [motions] if isinstance(motions, Motion) else list(motions)
    lanes = max(len(batch), len(paths))
    for name, items in (("models", batch), ("motions", paths)):
        if len(items) not in (1, lanes) or not items:
            raise ValueError(f"{len(items)} {name} for {lanes} lanes: give one, or one per lane")
    return batch * (lanes // len(batch)), paths * (lanes // len(paths))


def increasing(times_s: FloatArray) -> FloatArray:
    """The times, (times,), contiguous.  Raises ValueError: they do not increase."""
    times = np.ascontiguousarray(times_s, dtype=np.float64)
    if times.ndim != 1 or not np.all(np.isfinite(times)) or np.any(times[1:] <= times[:-1]):
        raise ValueError("times_s must be one-dimensional, finite and strictly increasing")
    return times


def _simulate(
    swing: Swing,
    how: Beginning,
    arc_length_m: FloatArray,
    out: Sequence[FloatArray] | FloatArray,
    *,
    spared: bool = False,
) -> None:
    """Write (times, markers, 2) of each lane to `out`.

    spared  lanes that cannot be simulated become nan instead of raising
    """
    first = [float(t[0]) for t in swing.times_s if t.size]
    if not first:
        return
    begin_s, rests = how.time_s(first, swing.paths), how.start != "straight"
    todo = list(range(len(swing.models)))
    if spared:
        for lane in [i for i in todo if slipped_out(swing.models[i])]:
            out[lane][:] = np.nan
            todo.remove(lane)
    while todo:
        part, places = swing.of(todo), [out[i] for i in todo]
        failed = _moved(part, begin_s, rests, arc_length_m, out if part is swing else places)
        for _, error in failed:
            if not spared:
                raise error
            for lane in error.lanes:
                places[lane][:] = np.nan
        todo = [todo[i] for block, error in failed for i in block.lanes if i not in error.lanes]


def _moved(
    swing: Swing,
    begin_s: float,
    rests: bool,
    arc_length_m: FloatArray,
    out: Sequence[FloatArray] | FloatArray,
) -> list[tuple[ParameterBlock, LanesError]]:
    """Write (times, markers, 2) of each lane to `out`; returns the blocks that failed."""
    solver, times_s, models = swing.solver, swing.times_s, swing.models
    workers = threads() if solver.threads is None else solver.threads
    blocks = assemble(models, solver.segments, begin_s, workers)
    gauged = swing.gauge is not None
    grids = [
        Grid.of(
            begin_s,
            [times_s[i] for i in b.lanes],
            models[b.lanes[0]],
            rests,
            solver,
            gauged=gauged,
        )
        for b in blocks
    ]
    return failures(swing, blocks, grids, arc_length_m, out)


@dataclass(frozen=True)
class Beginning:
    """Initial condition of all lanes of a batch; the fields are arguments of `simulate`."""

    start: Start
    release_s: float | None
    bent: tuple[FloatArray, ...]

    @staticmethod
    def of(
        start: Start, release_s: float | None, bent: Sequence[FloatArray], lanes: int
    ) -> Beginning:
        """Checked initial condition.  Raises ValueError: inconsistent arguments."""
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
        return Beginning(start, release_s, tuple(bent))

    def swing(
        self, models: list[CableModel], paths: list[Motion], times_s: list[FloatArray], how: Solver
    ) -> Swing:
        """Lanes that begin like this."""
        return Swing(models, paths, times_s, how, self.bent, self.start == "moving")

    def time_s(self, first_s: Sequence[float], paths: Sequence[Motion]) -> float:
        """Start of the simulation, s, of lanes whose first pictures are at `first_s`."""
        if self.release_s is not None:
            return float(self.release_s)
        if self.start == "moving":
            return min(first_s)
        return float(min(*first_s, *(m.t_s[0] for m in paths)))
