"""Coarse search between the offsets, delays and paces for the insertion of widest margin."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from cell.cable.arrays import FloatArray
from cell.cable.branches import simulate_branches
from cell.cable.geometry import Motion
from cell.cable.solver import Solver
from cell.identify.identified import Identified
from cell.plan.choose import INTERVAL_S, ChoiceOptions, Forecast, coarsened
from cell.plan.destination import Destination

#: Fewest delays at which insertions are simulated, and their largest spacing, s.
MOMENTS, MOMENTS_S = 3, 0.13
#: Number of offsets simulated at each, and their largest distance from the best undelayed one, m.
NEAR, NEAR_M = 5, 8e-3
#: Spacing of the delays, s, and offsets, m, at which the tip is interpolated between these, and of
#: the offsets around the best of them.
FINE_S, FINE_M, FINEST_M = 0.01, 4e-4, 5e-5
#: Delays closer than a fifth of the fastest swing's period, s, count as the same candidate.
ALIKE_S = 0.03
#: Most candidates, which differ in delay or pace.
MOST = 6
#: (n,) offsets, m, delays, s, and paces.
Spots = tuple[FloatArray, FloatArray, FloatArray]


def refined_candidates(
    identified: Identified,
    at_once: Forecast,
    motion: Callable[[float, float], Motion],
    destination: Destination,
    *,
    begin_s: float,
    solver: Solver,
    options: ChoiceOptions,
) -> Spots:
    """Candidate offsets, delays and paces of insertions, predicted to pass by the widest margin.

    The tip of the most probable cable is simulated coarsely.  Its path is nearly the sum of the
    response to the insertion and of the continuing previous swing; their remainder changes smoothly
    with offset and delay, and is interpolated.  (The error of the sum alone is 0.16 mm rms for the
    softest of three cables of `fake.yaml`.)

    at_once    forecast of the offsets, ascending, without delay at the usual pace
    motion     of the gripper, without delay, of any offset, m, and pace
    begin_s    begin of the insertion, on the clock of the motions
    returns    at most `MOST`, the widest margin first
    raises     as the engine
    """

    def tips(motions: Sequence[Motion]) -> FloatArray:
        return _tips(identified, motions, begin_s, solver)

    freely, offsets_m = options.freely, at_once.offsets_m
    best_m = offsets_m[destination.margin_m(at_once.tip_m).argmax()]
    ends_m = np.clip([best_m - NEAR_M, best_m + NEAR_M], offsets_m[0], offsets_m[-1])
    near_m = np.unique(np.linspace(ends_m[0], ends_m[1], NEAR))
    fine_s = np.arange(0.0, freely.window_s + 1e-3 * FINE_S, FINE_S)
    count = max(MOMENTS, 1 + int(np.ceil(freely.window_s / MOMENTS_S)))
    # multiples of the interval at which the tip is simulated
    moments = np.unique(np.rint(np.linspace(0.0, freely.window_s, count) / INTERVAL_S))
    moments_s, paces = INTERVAL_S * moments, (1.0, *freely.paces)
    near = [[motion(float(o), pace) for o in near_m] for pace in paces]
    later = [_delayed(m, begin_s, float(d)) for of_pace in near for d in moments_s for m in of_pace]
    longest_s = max(float(m.t_s[-1]) for of_pace in near for m in of_pace) - begin_s
    *tips_m, swing = tips([*later, _delayed(near[0][0], begin_s, longest_s + freely.window_s)])
    steps = int(longest_s / INTERVAL_S)

    def from_moment(path: FloatArray, moment_s: float) -> FloatArray:
        first = round(moment_s / INTERVAL_S)
        return path[first : first + steps]

    every_s = np.tile(np.repeat(moments_s, len(near_m)), len(paces))
    responses = np.array(
        [from_moment(t, d) - from_moment(swing, d) for t, d in zip(tips_m, every_s, strict=True)]
    ).reshape(len(paces), len(moments_s), len(near_m), steps, 2)
    fine_m = np.arange(near_m[0], near_m[-1] + 1e-3 * FINE_M, FINE_M)
    fine_m, by_offset = _between(near_m, fine_m)
    by_moment = _between(moments_s, fine_s)[1]
    swings = np.array([from_moment(swing, float(d)) for d in fine_s])[:, None]
    interpolated = _Interpolated(near_m, by_moment, responses, swings)
    spots = [
        (interpolated.best_offset_m(pace, moment, float(fine_m[offset]), destination), moment, pace)
        for pace, moment, offset in _widest(interpolated.margins_m(by_offset, destination), fine_s)
    ]
    chosen_m, moment, pace = (np.array(column) for column in zip(*spots, strict=True))
    return chosen_m, fine_s[moment], np.array(paces)[pace]


@dataclass(frozen=True, eq=False)
class _Interpolated:
    """Tips interpolated between simulated motions.

    near_m     (j,) simulated offsets
    by_moment  (d, i) weights of the simulated delays
    responses  (paces, i, j, T, 2) response of the tip to the insertion, m
    swings     (d, 1, T, 2) the previous swing, m
    """

    near_m: FloatArray
    by_moment: FloatArray
    responses: FloatArray
    swings: FloatArray

    def margins_m(self, by_offset: FloatArray, destination: Destination) -> FloatArray:
        """(paces, d, o) for (o, j) weights of offsets."""
        margins_m = [
            destination.margin_m(
                np.einsum("di,oj,ijtx->dotx", self.by_moment, by_offset, of_pace, optimize=True)
                + self.swings
            )
            for of_pace in self.responses
        ]
        return np.array(margins_m)

    def best_offset_m(
        self, pace: int, moment: int, about_m: float, destination: Destination
    ) -> float:
        """The offset of the widest margin within `FINE_M` of `about_m`."""
        ends_m = np.clip([about_m - FINE_M, about_m + FINE_M], self.near_m[0], self.near_m[-1])
        offsets_m = np.arange(ends_m[0], ends_m[1] + 1e-3 * FINEST_M, FINEST_M)
        offsets_m, weights = _between(self.near_m, offsets_m)
        tips_m = np.einsum("i,oj,ijtx->otx", self.by_moment[moment], weights, self.responses[pace])
        return float(offsets_m[destination.margin_m(tips_m + self.swings[moment]).argmax()])


def widest_between(at_once: Forecast, destination: Destination) -> float:
    """The offset predicted to pass by the widest margin, without delay, at the usual pace, m.

    Tips are interpolated between the offsets around the best one.
    at_once  of the offsets, ascending
    """
    best = int(destination.margin_m(at_once.tip_m).argmax())
    near = slice(max(0, best - 2), best + 3)
    known_m = at_once.offsets_m[near]
    ends_m = at_once.offsets_m[[max(0, best - 1), min(best + 1, len(at_once.offsets_m) - 1)]]
    fine_m, weights = _between(known_m, np.arange(ends_m[0], ends_m[1] + 1e-3 * FINE_M, FINE_M))
    tips_m = np.einsum("oj,jtx->otx", weights, at_once.tip_m[near])
    return float(fine_m[destination.margin_m(tips_m).argmax()])


def _delayed(motion: Motion, begin_s: float, delay_s: float) -> Motion:
    """The motion with a rest of `delay_s` inserted at `begin_s`."""
    before = motion.t_s <= begin_s
    return replace(motion, t_s=np.where(before, motion.t_s, motion.t_s + delay_s))


def _between(known: FloatArray, fine: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fine places and (f, known) weights of a cubic spline; a single known place is itself fine."""
    if len(known) == 1:
        return known, np.ones((1, 1))
    if len(known) < 3:
        return fine, np.array([np.interp(fine, known, row) for row in np.eye(len(known))]).T
    return fine, CubicSpline(known, np.eye(len(known)))(fine)


def _widest(margins_m: FloatArray, delays_s: FloatArray) -> list[tuple[int, int, int]]:
    """Indices of the widest of (paces, delays, offsets) margins, of different delays or paces."""
    remaining, best = margins_m.max(axis=2), margins_m.argmax(axis=2)
    chosen: list[tuple[int, int, int]] = []
    while len(chosen) < MOST and np.isfinite(remaining).any():
        pace, at = (int(i) for i in np.unravel_index(remaining.argmax(), remaining.shape))
        chosen.append((pace, at, int(best[pace, at])))
        remaining[pace, np.abs(delays_s - delays_s[at]) < ALIKE_S - 1e-9] = -np.inf
    return chosen


def _tips(
    identified: Identified,
    motions: Sequence[Motion],
    begin_s: float,
    solver: Solver,
) -> FloatArray:
    """(motions, times, 2) of the most probable cable, m."""
    end_s = max(float(m.t_s[-1]) for m in motions)
    at_s = np.arange(begin_s, end_s + INTERVAL_S, INTERVAL_S)
    space = identified.space
    tip_at_m = np.array([space.cable.length_m])
    models = [space.model(identified.mean)]
    tips_m = simulate_branches(models, motions, begin_s, at_s, tip_at_m, solver=coarsened(solver))
    return np.ascontiguousarray(tips_m[:, 0, :, 0])
