"""Power: probability that a diagnosis finds a hidden effect, and the smallest size it finds.

A hidden effect changes the whitened residual by the part that the fitted parameters cannot imitate,
which one fit without noise gives.  The scores of all effects are linear in that change and in the
noise.  So the joint distribution of a diagnosis's test statistics is known.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from cell.cable.arrays import FloatArray
from cell.identify.gauss_newton import UNSIMULATED
from cell.lab.fit.fitting import fit_trials
from cell.lab.fit.sensitivity import changes, is_shape
from cell.lab.next.asked import AskedEffect
from cell.lab.next.decisions import Chances, Circumstances, Tests
from cell.lab.next.hidden import left_of
from cell.lab.next.linear_study import LinearStudy, Sensitivities, own_sensitivities, rivals_of
from cell.lab.search.fit_cache import FitCache
from cell.lab.verdict.smooth_part import smooth_part

#: Power that the smallest size has.
POWER = 0.95
#: Rounds in which the size is simulated anew, by how many times it may change in one, and when it
#: is settled: it changes by less than this share.
ROUNDS, MOST_AT_ONCE, NEARLY = 8, 10.0, 0.02
#: Steps of the search for a size, and how far it goes from where it begins.
_HALVINGS, _FARTHEST = 30, 1e4
#: Share by which a shape parameter is changed for its slope, of its range where it is 0.
_BENT = 0.02
#: Other effects that are told apart by draws: of the most collinear.
_RIVALS = 8


@dataclass(frozen=True)
class Alternative:
    """A rival of the hidden effect: an effect with a collinear signature.

    correlation  of what both do to all trials, without what the parameters imitate
    """

    effect: str
    correlation: float


Said = Literal["found", "confused", "missed", "undecided", "unexplained", "failed"]


@dataclass(frozen=True)
class CopyOutcome:
    """Result of the diagnosis of one copy of a study.

    said   found: the effect is claimed, alone or in a tie, and nothing else; confused: another is
           claimed; missed: the model is called complete; undecided: nothing is claimed;
           unexplained: none explains it; failed: it could not be diagnosed
    named  effects that are named, ties by ` or `; with `undecided` they are not claimed
    """

    said: Said
    named: tuple[str, ...] = ()


@dataclass(frozen=True)
class Recovery:
    """Results of the diagnoses of all copies.

    asked  copies that were to be diagnosed
    """

    asked: int
    outcomes: tuple[CopyOutcome, ...]

    def count(self, *said: Said) -> int:
        """Copies of which any of these is said."""
        return sum(o.said in said for o in self.outcomes)

    @property
    def share(self) -> tuple[float, float, float]:
        """Share of copies in which the effect is found, and its 95 % interval (Wilson)."""
        hits, count = self.count("found"), len(self.outcomes)
        if not count:
            return float("nan"), 0.0, 1.0
        from scipy.stats import binomtest  # takes half a second, which only `--verify` pays

        sure = binomtest(hits, count).proportion_ci(method="wilson")
        return hits / count, float(sure.low), float(sure.high)

    @property
    def confused_with(self) -> tuple[tuple[str, int], ...]:
        """What is claimed in its place, the most frequent first."""
        names = (" + ".join(o.named) for o in self.outcomes if o.said == "confused")
        return tuple(Counter(names).most_common())

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        share, low, high = self.share
        said: tuple[Said, ...] = ("found", "undecided", "missed", "unexplained", "failed")
        return {
            "copies": len(self.outcomes),
            "asked": self.asked,
            "share": share,
            "low": low,
            "high": high,
            "confused": dict(self.confused_with),
            **{one: self.count(one) for one in said},
        }


@dataclass(frozen=True)
class EffectPower:
    """Power of a study's diagnosis for one hidden effect: its forecast.

    size      of the amplitude asked; None = none within its bounds has the power
    chances   with an effect of this size
    smallest  that is found with `POWER`; None = none within its bounds
    rivals    the most collinear effects, the nearest first
    noncentrality   χ² that the effect adds to what the fitted model leaves of all trials
    recovery  results of copies with the effect hidden; None = there are none
    """

    asked: AskedEffect
    size: float | None
    chances: Chances | None
    smallest: float | None
    rivals: tuple[Alternative, ...]
    noncentrality: float | None
    recovery: Recovery | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "effect": self.asked.effect.name,
            "parameter": self.asked.parameter.name,
            "unit": self.asked.parameter.unit,
            "size": self.size,
            "forecast": None if self.chances is None else self.chances.to_json(),
            "noncentrality": self.noncentrality,
            "smallest": self.smallest,
            "rivals": [vars(r) for r in self.rivals],
            "recovery": None if self.recovery is None else self.recovery.to_json(),
        }


def forecast(fits: FitCache, asked: AskedEffect, linear: LinearStudy) -> EffectPower:
    """Forecast of the diagnosis with this effect hidden, and the smallest size that it names.

    linear  the study near the baseline of `fits`
    """
    at = SizeSearch(fits, asked, linear)
    begin = asked.typical if asked.size is None else asked.size
    smallest = at.smallest(begin)
    size = smallest if asked.size is None else asked.size
    found = at.tests(begin if size is None else size)
    if found is None:
        return EffectPower(asked, size, None, smallest, (), None)
    tests, hidden, rivals = found
    unlike = linear.project_out_all(hidden[None])[0]
    return EffectPower(
        asked,
        size,
        None if size is None else tests.chances(1.0),
        smallest,
        tuple(Alternative(s.effect.name, s.collinear) for s in rivals),
        None if size is None else float(unlike @ unlike),
    )


@dataclass(frozen=True, eq=False)
class SizeSearch:
    """Search for the smallest size of an effect that a diagnosis finds."""

    fits: FitCache
    asked: AskedEffect
    linear: LinearStudy

    def tests(
        self, size: float, *, refitted: bool = True
    ) -> tuple[Tests, FloatArray, list[Sensitivities]] | None:
        """With the change (rows,) that the effect makes, and its rivals; None if it shows nothing.

        So too where it cannot be simulated so strong.
        refitted  by what a fit leaves of the effect, and not by what slopes say that it leaves
        """
        linear, effect = self.linear, self.asked.effect
        moved = self._changes(size)
        if moved is None:
            return None
        alone, shapes = moved
        hidden = self._left(size) if refitted else alone
        if hidden is None:
            return None
        amplitudes = [p for p in effect.parameters if p.amplitude]
        which = amplitudes.index(self.asked.parameter)
        own = own_sensitivities(linear, effect, which, hidden, alone, shapes)
        if own is None:
            return None
        known = {effect.name, *(e.name for e in self.fits.space.effects)}
        others = [e for name, e in self.fits.library.items() if name not in known]
        rivals = rivals_of(linear, hidden, others)[:_RIVALS]
        given = self._circumstances(hidden)
        return Tests.of(linear, hidden, own, rivals, given), hidden, rivals

    def _changes(self, size: float) -> tuple[FloatArray, FloatArray] | None:
        """(rows,) by the effect, and (shape parameters, rows) by a little of each of its shapes."""
        linear, effect = self.linear, self.asked.at(size)
        values, shaped = effect.values, []
        for i, p in enumerate(self.asked.effect.parameters):
            if is_shape(p):
                step = _BENT * (abs(values[i]) or p.high - p.low)
                bent = values[i] + (step if values[i] + step <= p.high else -step)
                shaped.append(replace(effect, values=(*values[:i], bent, *values[i + 1 :])))
        found = changes(linear.all_trials.prepared, linear.all_trials.fit, [effect, *shaped])
        if not np.all(np.isfinite(found)):
            return None
        return found[0], found[1:] - found[0]

    def _left(self, size: float) -> FloatArray | None:
        try:
            return left_of(self.fits.prepared, self.fits.base.fit, self.asked.at(size))
        except UNSIMULATED:
            return None

    def _circumstances(self, hidden: FloatArray) -> Circumstances:
        prepared, linear = self.fits.prepared, self.linear
        hand, names = self.fits.gripper_log_error(), [t.name for t in prepared.study.trials]
        errs = linear.all_trials.systematic_error
        slow = smooth_part(prepared, self.fits.base.fit)

        def inflated(change: FloatArray) -> float:
            by_trial = errs.by_trial(change)
            return hand.inflation(dict(zip(names, by_trial, strict=True)))

        return Circumstances(
            library=len(self.fits.screened(self.fits.base)),
            fitted=prepared.count(fit_trials(prepared)),
            heldout=prepared.count(prepared.study.role("validate")),
            independent=prepared.noise_model.noise.effective_fraction,
            noise_m=prepared.expected.std_m,
            slow=0.0 if slow is None else slow.count,
            by_gripper_log=inflated(linear.project_out_fitted(hidden[None])[0]),
            by_gripper_log_heldout=inflated(linear.heldout(hidden[None])[0]),
        )

    def smallest(self, begin: float) -> float | None:
        """The size from which the effect is found with `POWER`, searched from another size.

        By slopes first, which is quick, and then by fits.
        """
        size = self._searched(begin, refitted=False)
        return self._searched(begin if size is None else size, refitted=True)

    def _searched(self, begin: float, *, refitted: bool) -> float | None:
        parameter = self.asked.parameter
        from_off = begin - parameter.default
        limit = (parameter.high if from_off > 0.0 else parameter.low) - parameter.default
        at_limit = False
        for _ in range(ROUNDS):
            found = self.tests(parameter.default + from_off, refitted=refitted)
            times = None if found is None else _least_times(found[0])
            if times is None or (at_limit and times > 1.0):
                return None
            from_off *= float(np.clip(times, 1.0 / MOST_AT_ONCE, MOST_AT_ONCE))
            at_limit = abs(from_off) > abs(limit)
            from_off = limit if at_limit else from_off
            if abs(np.log(times)) < NEARLY:
                break
        return float(parameter.default + from_off)


def _least_times(tests: Tests) -> float | None:
    """By how much the hidden change is to be larger, or smaller, to be found with `POWER`."""

    def enough(times: float) -> bool:
        return tests.chances(times).found >= POWER

    low, high = 1.0, 1.0
    while not enough(high):
        low, high = high, 2.0 * high
        if high > _FARTHEST:
            return None
    while enough(low) and low > 1.0 / _FARTHEST:
        low, high = 0.5 * low, low
    for _ in range(_HALVINGS):
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if enough(middle) else (middle, high)
        if high / low < 1.0 + 0.1 * NEARLY:
            break
    return high
