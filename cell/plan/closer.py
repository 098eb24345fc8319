"""Where between the offsets, and when, an insertion passes best: a coarse look at all of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from cell.cable.branches import simulate_branches
from cell.cable.geometry import Motion
from cell.cable.solver import Solver
from cell.identify.identified import Identified
from cell.plan.choose import ChoiceOptions, coarsened
from cell.plan.destination import Destination

FloatArray = NDArray[np.float64]

#: Insertions are simulated at moments so far apart, s, a fifth of the quickest swing …
EVERY_S = 0.03
#: … with so many offsets, the outermost so far from the one that is best at once, m.
NEAR, NEAR_M = 9, 8e-3
#: Between them the tip is interpolated, at moments and offsets so far apart, s and m.
FINE_S, FINE_M = 0.01, 1e-4
#: So many are to be simulated closely, no two of a pace within `EVERY_S`.
MOST = 6
#: (n,) offsets, m, delays, s, and paces.
Spots = tuple[FloatArray, FloatArray, FloatArray]


def closer_look(
    identified: Identified,
    offsets_m: FloatArray,
    at_once: Sequence[Motion],
    motion: Callable[[float, float], Motion],
    destination: Destination,
    *,
    begin_s: float,
    solver: Solver,
    options: ChoiceOptions,
) -> Spots:
    """Offsets, delays and paces of insertions that seem to pass by the widest margin.

    The tip of the most probable cable is simulated coarsely, and interpolated between offsets and
    between moments: counted from when the hand begins to move, it changes smoothly with both.

    offsets_m  (O,) ascending, m
    at_once    (O,) motions of the hand that begin at once, at the usual pace
    motion     the same of any offset, m, and pace
    begin_s    when they begin, on the clock of the motions
    returns    at most `MOST`, the widest margin first
    raises     what the engine raises
    """

    def tips(motions: Sequence[Motion]) -> FloatArray:
        return _tips(identified, motions, begin_s, solver, options)

    best_m = offsets_m[destination.margin_m(tips(at_once)).argmax()]
    ends_m = np.clip([best_m - NEAR_M, best_m + NEAR_M], offsets_m[0], offsets_m[-1])
    near_m = np.unique(np.linspace(ends_m[0], ends_m[1], NEAR))
    moments = round(options.freely.window_s / EVERY_S)
    delays_s = np.linspace(0.0, moments * EVERY_S, moments + 1)
    paces = (1.0, *options.freely.paces)
    near = [[motion(float(o), pace) for o in near_m] for pace in paces]
    later = [_delayed(m, begin_s, float(d)) for of_pace in near for d in delays_s for m in of_pace]
    found = tips(later)
    shift = round(EVERY_S / options.interval_s)
    found = found.reshape(len(paces), moments + 1, -1, *found.shape[1:])
    steps = found.shape[3] - shift * moments
    moving = np.stack(
        [found[:, k, :, shift * k : shift * k + steps] for k in range(moments + 1)], 1
    )
    fine_s, by_delay = _between(delays_s, FINE_S)
    fine_m, by_offset = _between(near_m, FINE_M)
    margins_m = [
        destination.margin_m(
            np.einsum("di,oj,ijtx->dotx", by_delay, by_offset, of_pace, optimize=True)
        )
        for of_pace in moving
    ]
    return _widest(np.array(margins_m), fine_m, fine_s, np.array(paces))


def _delayed(motion: Motion, begin_s: float, delay_s: float) -> Motion:
    """The hand rests for so long at a moment, and then goes on."""
    before = motion.t_s <= begin_s
    return replace(motion, t_s=np.where(before, motion.t_s, motion.t_s + delay_s))


def _between(known: FloatArray, step: float) -> tuple[FloatArray, FloatArray]:
    """(f,) places at this step, and (f, known) weights of a cubic spline there."""
    fine = np.arange(known[0], known[-1] + 1e-3 * step, step)
    if len(known) == 1:
        return known, np.ones((1, 1))
    if len(known) < 4:
        return fine, np.array([np.interp(fine, known, row) for row in np.eye(len(known))]).T
    return fine, CubicSpline(known, np.eye(len(known)))(fine)


def _widest(
    margins_m: FloatArray, offsets_m: FloatArray, delays_s: FloatArray, paces: FloatArray
) -> Spots:
    """Of (paces, delays, offsets) margins the widest, then the widest at another moment …"""
    left, best = margins_m.max(axis=2), margins_m.argmax(axis=2)
    chosen: list[tuple[int, int]] = []
    while len(chosen) < MOST and np.isfinite(left).any():
        pace, at = (int(i) for i in np.unravel_index(left.argmax(), left.shape))
        chosen.append((pace, at))
        left[pace, np.abs(delays_s - delays_s[at]) < EVERY_S - 1e-9] = -np.inf
    of_pace, at_moment = np.array(chosen).T
    return offsets_m[best[of_pace, at_moment]], delays_s[at_moment], paces[of_pace]


def _tips(
    identified: Identified,
    motions: Sequence[Motion],
    begin_s: float,
    solver: Solver,
    options: ChoiceOptions,
) -> FloatArray:
    """(motions, times, 2) of the most probable cable, m."""
    end_s = max(float(m.t_s[-1]) for m in motions)
    at_s = np.arange(begin_s, end_s + options.interval_s, options.interval_s)
    space = identified.space
    tip_at_m = np.array([space.cable.free_length_m])
    models = [space.model(identified.mean)]
    found = simulate_branches(models, motions, begin_s, at_s, tip_at_m, solver=coarsened(solver))
    return np.ascontiguousarray(found[:, 0, :, 0])
