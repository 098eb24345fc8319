"""Power: probability that a diagnosis detects a hidden effect, and the smallest detectable size.

A hidden effect changes the whitened residual by the part that the fitted parameters cannot imitate,
which one noise-free fit gives.  The scores of all effects are linear in that change and in the
noise.  So the joint distribution of a diagnosis's test statistics is known.  Diagnoses of copies of
the study verify the forecast.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import ActiveEffect, Effect
from cell.cable.solver import threads
from cell.files.plain import plain
from cell.identify.gauss_newton import UNSIMULATED
from cell.identify.parameters import ParameterSpace
from cell.lab.data.noise_model import NoiseUnknownError
from cell.lab.data.prepared import ERROR_RATIO, PreparedStudy
from cell.lab.data.results import Diagnosis, Doubt
from cell.lab.data.rules import DEFAULT_RULES
from cell.lab.data.work import DIAGNOSIS, Progress, SpentError, Work, WorkStoppedError, no_progress
from cell.lab.diagnosis import diagnose
from cell.lab.fit.fitting import fit_trials
from cell.lab.fit.sensitivity import changes, is_shape
from cell.lab.next.decisions import Chances, StudyConstants, Tests
from cell.lab.next.effect_query import EffectQuery
from cell.lab.next.linear_study import LinearStudy, Sensitivities, own_sensitivities, rivals_of
from cell.lab.next.simulated import HiddenEffectWorld, refit_residual
from cell.lab.search.baseline import SearchSetup
from cell.lab.search.fit_cache import FitCache
from cell.lab.verdict.doubts import check_model
from cell.lab.verdict.smooth_part import smooth_part
from cell.study.independence import Independence
from cell.workers.executor import Executor
from cell.workers.here import this_computer

#: Power at the smallest size.
POWER = 0.95
#: Most simulations of a size, the largest factor between two, and the relative change below which
#: the size has converged.
ROUNDS, MOST_AT_ONCE, NEARLY = 8, 10.0, 0.02
#: Bisections of the search for a size, and its largest factor from the start.
_HALVINGS, _FARTHEST = 30, 1e4
#: Relative step of a shape parameter for its derivative; of its range where it is 0.
_BENT = 0.02
#: Number of rivals in the draws, the most collinear ones.
_RIVALS = 8


@dataclass(frozen=True)
class Alternative:
    """A rival of the hidden effect: an effect with a collinear signature.

    correlation  of both signatures in all trials, projected off the parameters
    """

    effect: str
    correlation: float


Said = Literal["found", "confused", "missed", "undecided", "unexplained", "failed"]


@dataclass(frozen=True)
class CopyOutcome:
    """Result of the diagnosis of one copy of a study.

    said   result: found = the effect is claimed, alone or in a tie, and nothing else; confused =
           another effect is claimed; missed = verdict complete; undecided = nothing is claimed;
           unexplained = no effect explains the copy; failed = it could not be diagnosed
    named  effects in the result, ties joined by ` or `; with `undecided` they are not claimed
    """

    said: Said
    named: tuple[str, ...] = ()


@dataclass(frozen=True)
class Recovery:
    """Results of the diagnoses of all copies.

    asked  number of requested copies
    """

    asked: int
    outcomes: tuple[CopyOutcome, ...]

    def count(self, *said: Said) -> int:
        """Number of copies with any of these results."""
        return sum(o.said in said for o in self.outcomes)

    @property
    def share(self) -> tuple[float, float, float]:
        """Share of copies in which the effect is found, and its 95 % interval (Wilson)."""
        hits, count = self.count("found"), len(self.outcomes)
        if not count:
            return float("nan"), 0.0, 1.0
        from scipy.stats import binomtest  # import takes 0.5 s, for `--verify` only

        bounds = binomtest(hits, count).proportion_ci(method="wilson")
        return hits / count, float(bounds.low), float(bounds.high)

    @property
    def confused_with(self) -> tuple[tuple[str, int], ...]:
        """Effects claimed in its place with their counts, the most frequent first."""
        names = (" + ".join(o.named) for o in self.outcomes if o.said == "confused")
        return tuple(Counter(names).most_common())

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        share, low, high = self.share
        results: tuple[Said, ...] = ("found", "undecided", "missed", "unexplained", "failed")
        return {
            "copies": len(self.outcomes),
            "asked": self.asked,
            "share": share,
            "low": low,
            "high": high,
            "confused": dict(self.confused_with),
            **{result: self.count(result) for result in results},
        }


@dataclass(frozen=True)
class EffectPower:
    """Power of a study's diagnosis for one hidden effect: its forecast.

    size      of the amplitude; None = no size within its bounds has the power
    chances   for an effect of this size
    smallest  size detected with `POWER`; None = none within its bounds
    rivals    the most collinear effects, the nearest first
    noncentrality   χ² that the effect adds to the residual of all trials
    recovery  results of copies with the effect hidden; None = there are none
    """

    query: EffectQuery
    size: float | None
    chances: Chances | None
    smallest: float | None
    rivals: tuple[Alternative, ...]
    noncentrality: float | None
    recovery: Recovery | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "effect": self.query.effect.name,
            "parameter": self.query.parameter.name,
            "unit": self.query.parameter.unit,
            "size": self.size,
            "forecast": None if self.chances is None else self.chances.to_json(),
            "noncentrality": self.noncentrality,
            "smallest": self.smallest,
            "rivals": [vars(r) for r in self.rivals],
            "recovery": None if self.recovery is None else self.recovery.to_json(),
        }


def forecast(fits: FitCache, query: EffectQuery, linear: LinearStudy) -> EffectPower:
    """Forecast of the diagnosis with this effect hidden, and the smallest detectable size.

    linear  the study near the baseline of `fits`
    """
    search = SizeSearch(fits, query, linear)
    begin = query.typical if query.size is None else query.size
    smallest = search.smallest(begin)
    size = smallest if query.size is None else query.size
    tests_of = search.tests(begin if size is None else size)
    if tests_of is None:
        return EffectPower(query, size, None, smallest, (), None)
    tests, hidden, rivals = tests_of
    orthogonal = linear.project_out_all(hidden[None])[0]
    return EffectPower(
        query,
        size,
        None if size is None else tests.chances(1.0),
        smallest,
        tuple(Alternative(s.effect.name, s.collinear) for s in rivals),
        None if size is None else float(orthogonal @ orthogonal),
    )


@dataclass(frozen=True, eq=False)
class SizeSearch:
    """Search for the smallest size of an effect that a diagnosis finds."""

    fits: FitCache
    query: EffectQuery
    linear: LinearStudy

    def tests(
        self, size: float, *, refitted: bool = True
    ) -> tuple[Tests, FloatArray, list[Sensitivities]] | None:
        """Tests, change (rows,) by the effect, and rivals; None if it changes nothing measurable.

        None also where the cable cannot be simulated with this size.
        refitted  change from a refit; False = by projection with the slopes
        """
        linear, effect = self.linear, self.query.effect
        changed = self._changes(size)
        if changed is None:
            return None
        alone, shapes = changed
        prepared, fit, hidden = self.fits.prepared, self.fits.base.fit, alone
        if refitted:
            try:
                hidden = refit_residual(prepared, fit, self.query.at(size))
            except UNSIMULATED:
                return None
        amplitudes = [p for p in effect.parameters if p.amplitude]
        which = amplitudes.index(self.query.parameter)
        own = own_sensitivities(linear, effect, which, hidden, alone, shapes)
        if own is None:
            return None
        in_model = {effect.name, *(e.name for e in self.fits.space.effects)}
        library = [e for name, e in self.fits.library.items() if name not in in_model]
        rivals = rivals_of(linear, hidden, library)[:_RIVALS]
        constants = self._constants(hidden)
        return Tests.of(linear, hidden, own, rivals, constants), hidden, rivals

    def _changes(self, size: float) -> tuple[FloatArray, FloatArray] | None:
        """(rows,) change by the effect, and (shape parameters, rows) by a step of each shape."""
        linear, effect = self.linear, self.query.at(size)
        values, shaped = effect.values, []
        for i, p in enumerate(self.query.effect.parameters):
            if is_shape(p):
                step = _BENT * (abs(values[i]) or p.high - p.low)
                perturbed = values[i] + (step if values[i] + step <= p.high else -step)
                shaped.append(replace(effect, values=(*values[:i], perturbed, *values[i + 1 :])))
        rows = changes(linear.all_trials.prepared, linear.all_trials.fit, [effect, *shaped])
        if not np.all(np.isfinite(rows)):
            return None
        return rows[0], rows[1:] - rows[0]

    def _constants(self, hidden: FloatArray) -> StudyConstants:
        prepared, linear = self.fits.prepared, self.linear
        log_error, names = self.fits.gripper_log_error(), [t.name for t in prepared.study.trials]
        systematic = linear.all_trials.systematic_error
        smooth = smooth_part(prepared, self.fits.base.fit)

        def inflated(change: FloatArray) -> float:
            by_trial = systematic.by_trial(change)
            return log_error.inflation(dict(zip(names, by_trial, strict=True)))

        return StudyConstants(
            library=len(self.fits.screened(self.fits.base)),
            fitted=prepared.count(fit_trials(prepared)),
            heldout=prepared.count(prepared.study.role("validate")),
            independent=prepared.noise_model.noise.effective_fraction,
            noise_m=prepared.expected.std_m,
            slow=0.0 if smooth is None else smooth.count,
            by_gripper_log=inflated(linear.project_out_fitted(hidden[None])[0]),
            by_gripper_log_heldout=inflated(linear.heldout(hidden[None])[0]),
        )

    def smallest(self, begin: float) -> float | None:
        """The smallest size that is detected with `POWER`, searched from another size.

        First by slopes, which is fast, then by fits.
        """
        size = self._search(begin, refitted=False)
        return self._search(begin if size is None else size, refitted=True)

    def _search(self, begin: float, *, refitted: bool) -> float | None:
        parameter = self.query.parameter
        from_off = begin - parameter.default
        limit = (parameter.high if from_off > 0.0 else parameter.low) - parameter.default
        at_limit = False
        for _ in range(ROUNDS):
            tests = self.tests(parameter.default + from_off, refitted=refitted)
            factor = None if tests is None else _least_factor(tests[0])
            if factor is None or (at_limit and factor > 1.0):
                return None
            from_off *= float(np.clip(factor, 1.0 / MOST_AT_ONCE, MOST_AT_ONCE))
            at_limit = abs(from_off) > abs(limit)
            from_off = limit if at_limit else from_off
            if abs(np.log(factor)) < NEARLY:
                break
        return float(parameter.default + from_off)


def _least_factor(tests: Tests) -> float | None:
    """Factor on the hidden change with which it is detected with `POWER`; None if too large."""

    def enough(factor: float) -> bool:
        return tests.chances(factor).found >= POWER

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


_LOG = logging.getLogger(__name__)


def _copy_diagnosed(
    world: HiddenEffectWorld,
    space: ParameterSpace,
    library: Mapping[str, type[Effect]],
    unknown_effects: tuple[type[Effect], ...],
    name: str,
    number: int,
) -> CopyOutcome:
    """Result of the diagnosis of a copy by its number, with the budget of a diagnosis."""
    work = Work(DIAGNOSIS)
    try:
        prepared = PreparedStudy.of(world.copy(number), solver=world.prepared.solver, work=work)
        setup = SearchSetup(prepared, space, library, unknown_effects=unknown_effects)
        with work.stage("prepare"):
            copy = FitCache.of(setup)
        return copy_outcome(diagnose(copy).diagnosis, name)
    except (*UNSIMULATED, SpentError, NoiseUnknownError) as error:
        _LOG.info("copy %d: %s", number, error)
        return CopyOutcome("failed")


def recover(
    fits: FitCache,
    hidden: ActiveEffect,
    copies: int,
    progress: Progress = no_progress,
    first: int = 0,
    executor: Executor | None = None,
) -> Recovery:
    """Diagnose copies of a study with a hidden effect; returns their results.

    If interrupted, the results so far.

    fits      the study with its baseline; copies are diagnosed with the same library
    first     number of the first copy, the seed of its noise
    executor  of the diagnoses; None = all cores of this computer
    raises    UnsimulatedError: the cable cannot be simulated with the effect
    """
    name, world = hidden.effect.name, HiddenEffectWorld.of(fits.prepared, fits.base.fit, hidden)
    unknown = fits.setup.unknown_effects
    of_copy = partial(_copy_diagnosed, world, fits.space, fits.library, unknown, name)
    outcomes: list[CopyOutcome] = []
    progress(f"diagnosing copies with {name}", 0, copies)
    executor = this_computer(min(threads(), copies)) if executor is None else executor
    numbers = range(first, first + copies)
    try:
        with closing(executor.map(of_copy, numbers, fits.work.check)) as results:
            for number, result in zip(numbers, results, strict=True):
                outcome = result.value
                outcomes.append(outcome)
                _LOG.info("copy %d: %s %s", number, outcome.said, ", ".join(outcome.named))
                progress(f"diagnosing copies with {name}", len(outcomes), copies)
    except WorkStoppedError:
        fits.work.stopped = False
    return Recovery(copies, tuple(outcomes))


def copy_outcome(diagnosis: Diagnosis, name: str) -> CopyOutcome:
    """Result of a copy: whether its diagnosis claims the hidden effect `name`."""
    named = [(m.effect, *m.tied_with) for m in diagnosis.missing]
    texts = tuple(" or ".join(names) for names in named)
    if diagnosis.verdict == "missing":
        alone = len(named) == 1 and name in named[0]
        return CopyOutcome("found" if alone else "confused", texts)
    results: dict[str, Said] = {"complete": "missed", "cannot_tell": "undecided"}
    return CopyOutcome(results.get(diagnosis.verdict, "unexplained"), texts)


FORMAT = "cable-power/1"


@dataclass(frozen=True)
class StudyPower:
    """The power of a study: forecasts of its diagnosis for hidden effects.

    noise_m   of the measurement
    """

    study: str
    noise_m: float
    effects: tuple[EffectPower, ...]
    warnings: tuple[Doubt, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain data, format cable-power/1."""
        return {
            "format": FORMAT,
            "study": self.study,
            "noise_m": self.noise_m,
            "power": POWER,
            "rules": plain(vars(DEFAULT_RULES)),
            "effects": [plain(e.to_json()) for e in self.effects],
            "warnings": [vars(w) for w in self.warnings],
        }


def power_of(
    fits: FitCache,
    queries: Sequence[EffectQuery],
    copies: int = 0,
    progress: Progress = no_progress,
    executor: Executor | None = None,
) -> StudyPower:
    """The power of a study's diagnosis for each effect, if it were hidden in the study.

    copies    number of copies diagnosed with each, to compare with the forecast
    executor  of their diagnoses; None = all cores of this computer
    raises    ValueError: the study cannot be fitted; UnsimulatedError
    """
    base = fits.base
    check_model(fits)
    progress("what the trials show of the parameters")
    linear = LinearStudy.of(fits.prepared, base.fit)
    powers = []
    for number, effect in enumerate(queries):
        progress(f"what the trials show of {effect.effect.name}", number, len(queries))
        powers.append(forecast(fits, effect, linear))
        fits.work.renew()
    if copies:
        for i, power in enumerate(powers):
            if (size := power.size) is not None:
                hidden = power.query.at(size)
                recovery = recover(fits, hidden, copies, progress, executor=executor)
                powers[i] = replace(power, recovery=recovery)
    noise_m = fits.prepared.noise_model.noise.std_m
    return StudyPower(fits.prepared.study.name, noise_m, tuple(powers), _doubts(fits))


def _doubts(fits: FitCache) -> tuple[Doubt, ...]:
    """Warnings of a power that may differ from the forecast."""
    prepared, warnings = fits.prepared, []
    if not Independence.of(prepared.study).held_out:
        warnings.append(
            Doubt(
                "confirmation",
                "no trial of another motion is held out, and a diagnosis claims only what such a "
                "trial confirms; mark one with another motion `role: validate`",
            )
        )
    ratio = fits.base.fit.rms_m / prepared.expected_m("fit")
    if ratio > ERROR_RATIO:
        warnings.append(
            Doubt(
                "misfit",
                f"the fitted model leaves {ratio:.2g} times the noise, and power is forecast with "
                "the noise alone; add what the study lacks with --with",
            )
        )
    return tuple(warnings)
