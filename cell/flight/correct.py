"""The change of a path that leads the tip through the destination most probably."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from cell.flight.answers import INTERVAL_S, Answers
from cell.flight.estimate import Deviation
from cell.plan.destination import Destination
from drivers.interfaces import Trajectory
from drivers.servo import servo_response

FloatArray = NDArray[np.float64]

#: The hand is led up or down by so much at most, m, in one of these times, s; so many heights are
#: tried at first, this far apart, m, and so many around the best.
MOST_M, COARSE, FINE = 6e-3, 25, 11
STEP_M = 2.0 * MOST_M / (COARSE - 1)
LASTS_S = (0.12, 0.2, 0.3)
#: So long before the tip reaches the mouth a change is decided, s.
AHEAD_S = (0.45, 0.32, 0.2)
#: Of two changes that do as well the smaller one: so much margin a metre of it must gain, m.
COST = 0.1
#: No change is made that does not pass with this probability.
LEAST = 0.5
#: A change is made if it raises the probability by so much, or the margin by so many of its own
#: standard deviations, and by so much, m.
WORTH, WORTH_STD, WORTH_M = 0.01, 2.0, 1e-4


@dataclass(frozen=True, eq=False)
class Tail:
    """A change of height of the hand from `from_s` on, by `rise_m` within `lasts_s`.

    probability, margin_m   of passing, with it
    before                  probability without it
    tip_m                   (T, 2) predicted with it
    """

    from_s: float
    rise_m: float
    lasts_s: float
    probability: float
    margin_m: float
    before: float
    tip_m: FloatArray

    def of(self, path: Trajectory) -> Trajectory:
        """The path with this change; longer if it ends before the change does."""
        step_s = float(path.t_s[1] - path.t_s[0])
        end_s = max(float(path.t_s[-1] - path.t_s[0]), self.from_s + self.lasts_s)
        t_s = step_s * np.arange(round(end_s / step_s) + 1.0)
        since = path.t_s - path.t_s[0]
        x_m, y_m, angle_rad = (
            np.interp(t_s, since, v) for v in (path.x_m, path.y_m, path.angle_rad)
        )
        y_m = y_m + self.rise_m * _smooth((t_s - self.from_s) / self.lasts_s)
        return Trajectory(t_s + path.t_s[0], x_m, y_m, angle_rad)


def best_tail(
    answers: Answers,
    beside: Deviation,
    destination: Destination,
    from_s: float,
    lag_s: float,
    repeatability_m: float,
) -> Tail | None:
    """The change from a moment on that makes the tip pass most probably; None = none is worth it.

    beside  how the cable moves beside the answers' expected motion, earlier changes included
    from_s  from when the hand was told to move
    """
    first = max(0, int(from_s / INTERVAL_S) - 1)
    likely_m = answers.nodes_m[:, 0] + beside.tip_m
    tips_m = answers.nodes_m[None, first:, 0] + beside.tips_m[:, first:]
    before, margin_m, _ = (v[0] for v in _judged(destination, tips_m[None], repeatability_m))
    made = {s: tail_answer(answers, from_s, s, lag_s, slice(1))[:, 0] for s in LASTS_S}

    def best(rises_m: FloatArray, lasts_s: float, some: FloatArray) -> tuple[float, float, Tail]:
        """Its worth and its margin's standard deviation."""
        answer = made[lasts_s]
        changed_m = some + rises_m[:, None, None, None] * answer[first:]
        chances, margins_m, stds_m = _judged(destination, changed_m, repeatability_m)
        worths = chances + margins_m - COST * np.abs(rises_m)
        at = int(worths.argmax())
        rise_m, chance = float(rises_m[at]), float(chances[at])
        tip_m = likely_m + rise_m * answer
        tail = Tail(from_s, rise_m, lasts_s, chance, float(margins_m[at]), float(before), tip_m)
        return float(worths[at]), float(stds_m[at]), tail

    coarse = np.linspace(-MOST_M, MOST_M, COARSE)
    near = max((best(coarse, s, tips_m[::4]) for s in LASTS_S), key=lambda b: b[0])[2]
    ends = np.clip([near.rise_m - STEP_M, near.rise_m + STEP_M], -MOST_M, MOST_M)
    fine = np.linspace(float(ends[0]), float(ends[1]), FINE)
    worth, std_m, tail = best(fine, near.lasts_s, tips_m)
    surely = tail.margin_m - margin_m > max(WORTH_M, WORTH_STD * std_m)
    likely = tail.probability >= max(LEAST, tail.before)
    if worth <= tail.before + margin_m or not likely:
        return None
    return tail if tail.probability - tail.before > WORTH or surely else None


def chance(
    answers: Answers, beside: Deviation, destination: Destination, repeatability_m: float
) -> float:
    """Probability of passing if the path stays as it is."""
    tips_m = answers.nodes_m[None, None, :, 0] + beside.tips_m
    return float(_judged(destination, tips_m, repeatability_m)[0][0])


def decisions_s(answers: Answers, destination: Destination) -> tuple[float, ...]:
    """When to decide on a change, from when the hand is told to move; none if no tip gets there."""
    through = np.flatnonzero(answers.nodes_m[:, 0, 0] <= destination.x_max_m)
    if not through.size:
        return ()
    at_s = float(answers.t_s[through[0]])
    return tuple(at_s - ahead_s for ahead_s in AHEAD_S if at_s > ahead_s)


def tail_answer(
    answers: Answers, from_s: float, lasts_s: float, lag_s: float, nodes: slice = slice(None)
) -> FloatArray:
    """(T, nodes, 2) per metre that the hand is led up from a moment on."""
    t_s = np.arange(0.0, lasts_s + INTERVAL_S, INTERVAL_S / 2.0)
    up = Trajectory(t_s, 0.0 * t_s, _smooth(t_s / lasts_s), 0.0 * t_s)
    led = servo_response(up, lag_s)
    moved = np.diff(np.interp(answers.t_s - from_s, led.t_s, led.y_m), prepend=0.0)
    rise = answers.rise[:, nodes]
    each = [np.convolve(moved, column)[: len(rise)] for column in rise.reshape(len(rise), -1).T]
    return np.stack(each, axis=-1).reshape(rise.shape)


def moved_by(answers: Answers, tail: Tail, lag_s: float) -> Answers:
    """The expected motion once a change was told."""
    led = tail.rise_m * tail_answer(answers, tail.from_s, tail.lasts_s, lag_s)
    return replace(answers, nodes_m=answers.nodes_m + led)


def _judged(
    destination: Destination, tips_m: FloatArray, repeatability_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(n,) probability, mean margin and its standard deviation, m, of (n, samples, T, 2) tips."""
    margins = destination.margin_m(tips_m)
    chances: FloatArray = ndtr(margins / repeatability_m)
    return chances.mean(axis=1), margins.mean(axis=1), margins.std(axis=1)


def _smooth(u: FloatArray) -> FloatArray:
    """From 0 to 1 with no speed and no acceleration at either end: the least jerk."""
    u = np.clip(u, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u**2))
