"""An effect hidden many times in copies of a study, and what the diagnosis says of each."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Literal

from cell.cable.effects.base import ActiveEffect, Effect
from cell.cable.solver import Solver, threads
from cell.identify.gauss_newton import UNSIMULATED
from cell.identify.parameters import ParameterSpace
from cell.lab.data.noise_model import NoiseUnknownError
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.progress import Progress, no_progress
from cell.lab.data.results import Diagnosis
from cell.lab.data.thresholds import DEFAULT_RULES, Rules
from cell.lab.data.work import DIAGNOSIS, SpentError, Work, WorkStoppedError
from cell.lab.next.hidden import HiddenEffectWorld
from cell.lab.search.fit_cache import FitCache
from cell.lab.verdict.diagnose import diagnose
from cell.workers.executor import Executor
from cell.workers.here import this_computer

_LOG = logging.getLogger(__name__)

Said = Literal["found", "confused", "missed", "undecided", "unexplained", "failed"]


@dataclass(frozen=True)
class CopyOutcome:
    """What a diagnosis says of a copy of a study.

    said   found: the effect is claimed, alone or in a tie, and nothing else; confused: another is
           claimed; missed: the model is called complete; undecided: nothing is claimed;
           unexplained: none explains it; failed: it could not be diagnosed
    named  effects that are named, ties by ` or `; with `undecided` they are not claimed
    """

    said: Said
    named: tuple[str, ...] = ()


@dataclass(frozen=True)
class Recovery:
    """Of all copies that were diagnosed.

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


@dataclass(frozen=True, eq=False)
class _CopyDiagnosed:
    """What the diagnosis of a copy of a study says, by the copy's number."""

    world: HiddenEffectWorld
    space: ParameterSpace
    library: Mapping[str, type[Effect]]
    sought: tuple[type[Effect], ...]
    solver: Solver
    name: str
    rules: Rules

    def __call__(self, number: int) -> CopyOutcome:
        """Each copy has the budget of a diagnosis."""
        work = Work(DIAGNOSIS)
        try:
            prepared = PreparedStudy.of(self.world.copy(number), solver=self.solver, work=work)
            copy = FitCache(prepared, self.space, self.library, sought=self.sought)
            said = judged(diagnose(copy, self.rules).diagnosis, self.name)
        except (*UNSIMULATED, SpentError, NoiseUnknownError) as error:
            _LOG.info("copy %d: %s", number, error)
            said = CopyOutcome("failed")
        return said


def recover(
    fits: FitCache,
    hidden: ActiveEffect,
    copies: int,
    rules: Rules = DEFAULT_RULES,
    progress: Progress = no_progress,
    first: int = 0,
    executor: Executor | None = None,
) -> Recovery:
    """What diagnoses say of copies of a study with an effect hidden in them.

    Interrupted, it has those that were diagnosed.

    fits      the study with its baseline; copies are diagnosed with the same library
    first     number of the first copy: other numbers, other noise
    executor  who diagnoses; None = all cores of this computer
    raises    UnsimulatedError: the cable cannot be simulated with the effect
    """
    name = hidden.effect.name
    of_copy = _CopyDiagnosed(
        HiddenEffectWorld.of(fits.prepared, fits.baseline().fit, hidden),
        fits.space,
        fits.library,
        fits.sought,
        fits.given.solver,
        name,
        rules,
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


def judged(diagnosis: Diagnosis, name: str) -> CopyOutcome:
    """A diagnosis beside the name of what is hidden."""
    named = [(m.effect, *m.tied_with) for m in diagnosis.missing]
    words = tuple(" or ".join(names) for names in named)
    if diagnosis.verdict == "missing":
        alone = len(named) == 1 and name in named[0]
        return CopyOutcome("found" if alone else "confused", words)
    said: dict[str, Said] = {"complete": "missed", "cannot_tell": "undecided"}
    return CopyOutcome(said.get(diagnosis.verdict, "unexplained"), words)
