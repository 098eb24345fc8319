"""The power of a study: would its diagnosis detect effects that are hidden in it?"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

from cell.cable.effects.base import ActiveEffect, Effect
from cell.cable.solver import Solver, threads
from cell.files.plain import plain
from cell.identify.gauss_newton import UNSIMULATED
from cell.identify.parameters import ParameterSpace
from cell.lab.data.noise_model import NoiseUnknownError
from cell.lab.data.prepared import ERROR_RATIO, PreparedStudy
from cell.lab.data.results import Diagnosis, Doubt
from cell.lab.data.thresholds import DEFAULT_RULES
from cell.lab.data.work import DIAGNOSIS, Progress, SpentError, Work, WorkStoppedError, no_progress
from cell.lab.diagnosis import diagnose
from cell.lab.next.effect_query import EffectQuery
from cell.lab.next.forecast import POWER, CopyOutcome, EffectPower, Recovery, Said, forecast
from cell.lab.next.hidden import HiddenEffectWorld
from cell.lab.next.linear_study import LinearStudy
from cell.lab.search.baseline import SearchSetup
from cell.lab.search.fit_cache import FitCache
from cell.lab.verdict.doubts import check_model
from cell.study.independence import Independence
from cell.workers.executor import Executor
from cell.workers.here import this_computer

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class _CopyDiagnosed:
    """Callable: result of the diagnosis of a copy of a study, by the copy's number."""

    world: HiddenEffectWorld
    space: ParameterSpace
    library: Mapping[str, type[Effect]]
    unknown_effects: tuple[type[Effect], ...]
    solver: Solver
    name: str

    def __call__(self, number: int) -> CopyOutcome:
        """Diagnose one copy, with the budget of a diagnosis."""
        work = Work(DIAGNOSIS)
        try:
            prepared = PreparedStudy.of(self.world.copy(number), solver=self.solver, work=work)
            setup = SearchSetup(
                prepared, self.space, self.library, unknown_effects=self.unknown_effects
            )
            with work.stage("prepare"):
                copy = FitCache.of(setup)
            outcome = copy_outcome(diagnose(copy).diagnosis, self.name)
        except (*UNSIMULATED, SpentError, NoiseUnknownError) as error:
            _LOG.info("copy %d: %s", number, error)
            outcome = CopyOutcome("failed")
        return outcome


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
    name = hidden.effect.name
    of_copy = _CopyDiagnosed(
        HiddenEffectWorld.of(fits.prepared, fits.base.fit, hidden),
        fits.space,
        fits.library,
        fits.setup.unknown_effects,
        fits.prepared.solver,
        name,
    )
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
