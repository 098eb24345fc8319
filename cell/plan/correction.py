"""The decision in flight: keep the path, change it so that the tip passes, or stop."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from cell.cable.arrays import FloatArray
from cell.identify.identified import Identified
from cell.plan.choose import INTERVAL_S
from cell.plan.destination import Destination
from cell.plan.response import Deviation, Response, deviation
from drivers.interfaces import Trajectory
from drivers.servo import servo_response

#: Largest change of the gripper's height in each of two successive rises, m, and durations of a
#: rise, s.  Pairs of rises are compared on a coarse grid of this spacing, m, then on finer grids
#: around the best pair.
MOST_M = 6e-3
LASTS_S = (0.12, 0.2, 0.3)
COARSE_M, FINE_M = 1e-3, (5e-4, 2.5e-4)
#: Times of the decisions before the tip reaches the opening, s.
AHEAD_S = (0.45, 0.32, 0.2)
#: Penalty on the size of a change: margin, m, that it must gain per metre.
COST = 0.1
#: Least probability of passing of a change.
LEAST = 0.5
#: Least gain of a change in probability; or in margin, in its standard deviations and in m.
WORTH, WORTH_STD, WORTH_M = 0.01, 2.0, 1e-4


@dataclass(frozen=True, eq=False)
class Tail:
    """A change of the gripper's height from `from_s` on, as two successive rises.

    rise_m, then_m   first and second rise, each within `lasts_s`
    probability, margin_m   of passing, with the change
    before           probability without it
    tip_m            (T, 2) predicted with it
    """

    from_s: float
    rise_m: float
    then_m: float
    lasts_s: float
    probability: float
    margin_m: float
    before: float
    tip_m: FloatArray

    def of(self, path: Trajectory) -> Trajectory:
        """The path with this change; longer if it ends before the change does."""
        step_s = float(path.t_s[1] - path.t_s[0])
        duration_s = self.lasts_s * (1.0 if self.then_m == 0.0 else 2.0)
        end_s = max(float(path.t_s[-1] - path.t_s[0]), self.from_s + duration_s)
        t_s = step_s * np.arange(round(end_s / step_s) + 1.0)
        since = path.t_s - path.t_s[0]
        x_m, y_m, angle_rad = (
            np.interp(t_s, since, v) for v in (path.x_m, path.y_m, path.angle_rad)
        )
        u = (t_s - self.from_s) / self.lasts_s
        y_m = y_m + self.rise_m * _minimum_jerk(u) + self.then_m * _minimum_jerk(u - 1.0)
        return Trajectory(t_s + path.t_s[0], x_m, y_m, angle_rad)


def best_tail(
    response: Response,
    estimated: Deviation,
    destination: Destination,
    from_s: float,
    lag_s: float,
    repeatability_m: float,
) -> Tail | None:
    """The change with the most probable passage; None = no change gains enough.

    estimated  deviation of the cable from the expected motion, which has earlier changes in it
    from_s     start of the change, after the commanded start
    """
    first = max(0, int(from_s / INTERVAL_S) - 1)
    likely_m = response.nodes_m[:, 0] + estimated.tip_m
    tips_m = response.nodes_m[first:, 0] + estimated.tips_m[:, first:]
    best: tuple[float, float, FloatArray] | None = None
    responses = {s: _tip_responses(response, from_s, s, lag_s) for s in LASTS_S}
    for lasts_s, tip_response in responses.items():
        inputs = tip_response[:, first:], destination, repeatability_m
        _, rises_m = _best_rises(
            likely_m[None, first:], *inputs, _pairs(np.zeros(2), MOST_M, COARSE_M)
        )
        worth, rises_m = _best_rises(tips_m[::4], *inputs, _pairs(rises_m, COARSE_M, FINE_M[0]))
        if best is None or worth > best[0]:
            best = worth, lasts_s, rises_m
    assert best is not None
    _, lasts_s, rises_m = best
    inputs = responses[lasts_s][:, first:], destination, repeatability_m
    _, rises_m = _best_rises(tips_m[::2], *inputs, _pairs(rises_m, FINE_M[0], FINE_M[1]))
    led_m = np.tensordot(rises_m, responses[lasts_s], axes=1)
    scores = _scores(destination, np.stack([tips_m, tips_m + led_m[first:]]), repeatability_m)
    (before, probability), (margin_m, with_m), (_, std_m) = scores
    better = with_m - margin_m
    surely = better > max(WORTH_M, WORTH_STD * std_m)
    worth = probability - before + better - COST * np.abs(rises_m).sum()
    if worth <= 0.0 or probability < max(LEAST, before):
        return None
    if probability - before <= WORTH and not surely:
        return None
    rise_m, then_m = (float(r) for r in rises_m)
    passing = float(probability), float(with_m), float(before)
    return Tail(from_s, rise_m, then_m, lasts_s, *passing, likely_m + led_m)


def _pairs(about_m: FloatArray, reach_m: float, step_m: float) -> FloatArray:
    """(pairs, 2) rises up to `reach_m` from others, `step_m` apart, m."""
    count = round(reach_m / step_m)
    steps_m = step_m * np.arange(-count, count + 1.0)
    pairs_m = np.stack(np.meshgrid(steps_m, steps_m), axis=-1).reshape(-1, 2)
    return np.clip(about_m + pairs_m, -MOST_M, MOST_M)


def _best_rises(
    tips_m: FloatArray,
    response: FloatArray,
    destination: Destination,
    repeatability_m: float,
    pairs_m: FloatArray,
) -> tuple[float, FloatArray]:
    """Score of the best of (pairs, 2) rises, and its (2,) rises, m.

    tips_m    (samples, T, 2) without a change
    response  (2, T, 2) per metre of either rise
    """
    led_m = np.tensordot(pairs_m, response, axes=1)
    chances, margins_m, _ = _scores(destination, tips_m + led_m[:, None], repeatability_m)
    worths = chances + margins_m - COST * np.abs(pairs_m).sum(axis=1)
    at = int(worths.argmax())
    return float(worths[at]), pairs_m[at]


def probability_of_passing(
    response: Response, estimated: Deviation, destination: Destination, repeatability_m: float
) -> float:
    """Probability of passing without a change of the path."""
    tips_m = response.nodes_m[None, None, :, 0] + estimated.tips_m
    return float(_scores(destination, tips_m, repeatability_m)[0][0])


def decisions_s(response: Response, destination: Destination) -> tuple[float, ...]:
    """Times of decisions on a change, after the commanded start; none if no tip arrives."""
    through = np.flatnonzero(response.nodes_m[:, 0, 0] <= destination.x_max_m)
    if not through.size:
        return ()
    at_s = float(response.t_s[through[0]])
    return tuple(at_s - ahead_s for ahead_s in AHEAD_S if at_s > ahead_s)


def tail_response(
    response: Response, from_s: float, lasts_s: float, lag_s: float, nodes: slice = slice(None)
) -> FloatArray:
    """(T, nodes, 2) response of the nodes to a rise of the gripper from a time on, per metre."""
    t_s = np.arange(0.0, lasts_s + INTERVAL_S, INTERVAL_S / 2.0)
    up = Trajectory(t_s, 0.0 * t_s, _minimum_jerk(t_s / lasts_s), 0.0 * t_s)
    led = servo_response(up, lag_s)
    moved = np.diff(np.interp(response.t_s - from_s, led.t_s, led.y_m), prepend=0.0)
    rise = response.rise[:, nodes]
    each = [np.convolve(moved, column)[: len(rise)] for column in rise.reshape(len(rise), -1).T]
    return np.stack(each, axis=-1).reshape(rise.shape)


def _tip_responses(response: Response, from_s: float, lasts_s: float, lag_s: float) -> FloatArray:
    """(2, T, 2) of the tip, per metre of either rise of a change."""
    both = [
        tail_response(response, begin_s, lasts_s, lag_s, slice(1))[:, 0]
        for begin_s in (from_s, from_s + lasts_s)
    ]
    return np.array(both)


def moved_by(response: Response, tail: Tail, lag_s: float) -> Response:
    """The expected motion after a commanded change."""
    led = tail.rise_m * tail_response(response, tail.from_s, tail.lasts_s, lag_s)
    then_s = tail.from_s + tail.lasts_s
    led += tail.then_m * tail_response(response, then_s, tail.lasts_s, lag_s)
    return replace(response, nodes_m=response.nodes_m + led)


def _scores(
    destination: Destination, tips_m: FloatArray, repeatability_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(n,) probability, mean margin and its standard deviation, m, of (n, samples, T, 2) tips."""
    margins = destination.margin_m(tips_m)
    chances: FloatArray = ndtr(margins / repeatability_m)
    return chances.mean(axis=1), margins.mean(axis=1), margins.std(axis=1)


def _minimum_jerk(u: FloatArray) -> FloatArray:
    """From 0 to 1 with least jerk: no speed or acceleration at either end."""
    u = np.clip(u, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u**2))


#: Largest misfit of the frames with which a deviation is used, in standard deviations.
MOST_MISFIT = 5.0
#: Fewest frames with the tip detected for a decision.
LEAST_FRAMES = 10


@dataclass(frozen=True, eq=False)
class Decision:
    """The decision in flight, and the prediction that it is based on.

    tip_m        (T, 2) predicted without a change, at the response's times; None = unknown
    tail         the change to make; None = none
    probability  of passing without a change; None = unknown
    withheld     reason why nothing can be decided; None = it can
    """

    tip_m: FloatArray | None = None
    tail: Tail | None = None
    probability: float | None = None
    withheld: str | None = None

    @property
    def hopeless(self) -> bool:
        """Whether the tip will hardly pass unless the path is changed."""
        return self.probability is not None and self.probability < LEAST


@dataclass(frozen=True, eq=False)
class Flight:
    """An insertion in progress, with the cable's response to small deviations.

    noise_m          standard deviation of the detected nodes
    lag_s            of the arm
    repeatability_m  standard deviation of the tip's height for reasons that are not the cable's
    """

    response: Response
    destination: Destination
    noise_m: float
    lag_s: float
    repeatability_m: float

    def decide(self, t_s: FloatArray, nodes_m: FloatArray, from_s: float) -> Decision:
        """Decision from the frames so far.

        t_s      (frames,) increasing, after the commanded start; earlier frames are ignored
        nodes_m  (frames, nodes, 2) measured, nan = not detected
        from_s   earliest start of a change
        """
        used = np.isfinite(nodes_m[:, 0, 0]) & (t_s >= 0.0)
        if used.sum() < LEAST_FRAMES:
            return Decision(withheld=f"the cable is seen in {used.sum()} frames")
        estimated = deviation(self.response, t_s[used], nodes_m[used], self.noise_m)
        if estimated.misfit > MOST_MISFIT:
            return Decision(withheld=f"the frames are not explained: misfit {estimated.misfit:.1f}")
        inputs = self.response, estimated, self.destination
        return Decision(
            self.response.nodes_m[:, 0] + estimated.tip_m,
            best_tail(*inputs, from_s, self.lag_s, self.repeatability_m),
            probability_of_passing(*inputs, self.repeatability_m),
        )

    def changed(self, tail: Tail) -> Flight:
        """The same after a commanded change: the expected motion is moved by linear responses."""
        return replace(self, response=moved_by(self.response, tail, self.lag_s))

    def expecting(self, nodes_m: FloatArray) -> Flight:
        """The same with the expected motion (T, nodes, 2) simulated for a changed path."""
        return replace(self, response=replace(self.response, nodes_m=nodes_m))


def detection_std_m(identified: Identified) -> float:
    """Standard deviation of nodes in flight, m: detection is less exact in motion than at rest.

    It is the rms residual of the hold's frames, or the noise at rest if that is larger.
    """
    return max(identified.noise.std_m, identified.residual_rms_m)
