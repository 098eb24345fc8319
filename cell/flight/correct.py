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

#: The hand is led up or down by so much at most, in such steps, m, and in one of these times, s.
MOST_M, COARSE_M, FINE_M = 6e-3, 5e-4, 1e-4
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
    none = _judged(destination, tips_m, repeatability_m)

    def tail(rise_m: float, lasts_s: float, some: slice) -> tuple[float, float, Tail]:
        answer = made[lasts_s]
        changed_m = tips_m[some] + rise_m * answer[first:]
        chance, margin_m, std_m = _judged(destination, changed_m, repeatability_m)
        worth = chance + margin_m - COST * abs(rise_m)
        tip_m = likely_m + rise_m * answer
        return worth, std_m, Tail(from_s, rise_m, lasts_s, chance, margin_m, none[0], tip_m)

    made = {s: tail_answer(answers, from_s, s, lag_s)[:, 0] for s in LASTS_S}
    coarse = np.arange(-MOST_M, MOST_M + 0.5 * COARSE_M, COARSE_M)
    few, every = slice(None, None, 4), slice(None)
    best = max((tail(float(r), s, few) for s in LASTS_S for r in coarse), key=_worth)
    around, lasts_s = best[2].rise_m, best[2].lasts_s
    fine = around + np.arange(-COARSE_M, COARSE_M + 0.5 * FINE_M, FINE_M)
    best = max((tail(float(r), lasts_s, every) for r in fine), key=_worth)
    worth, std_m, chosen = best
    surely = chosen.margin_m - none[1] > max(WORTH_M, WORTH_STD * std_m)
    likely = chosen.probability >= max(LEAST, none[0])
    if worth <= none[0] + none[1] or not likely:
        return None
    return chosen if chosen.probability - none[0] > WORTH or surely else None


def _worth(judged: tuple[float, float, Tail]) -> float:
    return judged[0]


def decisions_s(answers: Answers, destination: Destination) -> tuple[float, ...]:
    """When to decide on a change, from when the hand is told to move; none if no tip gets there."""
    through = np.flatnonzero(answers.nodes_m[:, 0, 0] <= destination.x_max_m)
    if not through.size:
        return ()
    at_s = float(answers.t_s[through[0]])
    return tuple(at_s - ahead_s for ahead_s in AHEAD_S if at_s > ahead_s)


def tail_answer(answers: Answers, from_s: float, lasts_s: float, lag_s: float) -> FloatArray:
    """(T, nodes, 2) per metre that the hand is led up from a moment on."""
    t_s = np.arange(0.0, lasts_s + INTERVAL_S, INTERVAL_S / 2.0)
    up = Trajectory(t_s, 0.0 * t_s, _smooth(t_s / lasts_s), 0.0 * t_s)
    led = servo_response(up, lag_s)
    place = np.interp(answers.t_s - from_s, led.t_s, led.y_m)
    moved = np.diff(place, prepend=0.0)
    out: FloatArray = np.zeros_like(answers.rise)
    for k in np.flatnonzero(moved):
        out[k:] += moved[k] * answers.rise[: len(out) - k]
    return out


def moved_by(answers: Answers, tail: Tail, lag_s: float) -> Answers:
    """The expected motion once a change was told."""
    led = tail.rise_m * tail_answer(answers, tail.from_s, tail.lasts_s, lag_s)
    return replace(answers, nodes_m=answers.nodes_m + led)


def _judged(
    destination: Destination, tips_m: FloatArray, repeatability_m: float
) -> tuple[float, float, float]:
    """Probability, mean margin and its standard deviation, m, of (samples, T, 2) tips."""
    margins = destination.margin_m(tips_m)
    chance = ndtr(margins / repeatability_m)
    return float(np.mean(chance)), float(np.mean(margins)), float(np.std(margins))


def _smooth(u: FloatArray) -> FloatArray:
    """From 0 to 1 with no speed and no acceleration at either end: the least jerk."""
    u = np.clip(u, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u**2))
