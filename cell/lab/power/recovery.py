"""An effect hidden many times in copies of a study, and what the diagnosis says of each."""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import dataclass
from typing import Literal

from cell.cable.effects.base import ActiveEffect
from cell.cable.solver import one_core
from cell.identify.gauss_newton import UNSIMULATED
from cell.lab.data.noise_model import NoiseUnknownError
from cell.lab.data.prepared import PreparedStudy, StoppedError
from cell.lab.data.progress import Progress, no_progress
from cell.lab.data.results import Diagnosis
from cell.lab.data.side_by_side import side_by_side
from cell.lab.data.thresholds import DEFAULT_RULES, Rules
from cell.lab.power.hidden import World
from cell.lab.search.fit_cache import FitCache
from cell.lab.statistics.proportion import wilson
from cell.lab.verdict.diagnose import diagnose

_LOG = logging.getLogger(__name__)

Said = Literal["found", "confused", "missed", "undecided", "unexplained", "failed"]


@dataclass(frozen=True)
class Outcome:
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
    outcomes: tuple[Outcome, ...]

    def count(self, *said: Said) -> int:
        """Copies of which any of these is said."""
        return sum(o.said in said for o in self.outcomes)

    @property
    def share(self) -> tuple[float, float, float]:
        """Share of copies in which the effect is found, and its 95 % interval (Wilson)."""
        hits, count = self.count("found"), len(self.outcomes)
        return (hits / count if count else float("nan"), *wilson(hits, count))

    @property
    def confused_with(self) -> tuple[tuple[str, int], ...]:
        """What is claimed in its place, the most frequent first."""
        names = (" + ".join(o.named) for o in self.outcomes if o.said == "confused")
        return tuple(Counter(names).most_common())


def recover(
    fits: FitCache,
    hidden: ActiveEffect,
    copies: int,
    rules: Rules = DEFAULT_RULES,
    progress: Progress = no_progress,
    first: int = 0,
) -> Recovery:
    """What diagnoses say of copies of a study with an effect hidden in them, on all cores.

    Interrupted, it has those that were diagnosed.

    fits    the study with its baseline; copies are diagnosed with the same library
    first   number of the first copy: other numbers, other noise
    raises  UnsimulatedError: the cable cannot be simulated with the effect
    """
    world = World.of(fits.prepared, fits.baseline().fit, hidden)
    known: dict[int, Outcome] = {}
    name = hidden.effect.name

    def of_copy(number: int) -> Outcome:
        with one_core():
            return _outcome(fits, world, number, name, rules)

    def was_diagnosed(number: int, outcome: Outcome) -> None:
        known[number] = outcome
        _LOG.info("copy %d: %s %s", number, outcome.said, ", ".join(outcome.named))
        progress(f"diagnosing copies with {name}", len(known), copies)

    progress(f"diagnosing copies with {name}", 0, copies)
    effects = (*fits.library.values(), *fits.space.effects)
    try:
        with side_by_side(fits.work, [of_copy], effects, copies) as beside:
            beside.map(of_copy, range(first, first + copies), was_diagnosed)
    except StoppedError:
        fits.work.stopped = False
    return Recovery(copies, tuple(known[number] for number in sorted(known)))


def _outcome(fits: FitCache, world: World, number: int, name: str, rules: Rules) -> Outcome:
    """What the diagnosis of a copy says."""
    try:
        prepared = PreparedStudy.of(world.copy(number), solver=fits.given.solver, work=fits.work)
        copy = FitCache(prepared, fits.space, fits.library, sought=fits.sought)
        return judged(diagnose(copy, rules).diagnosis, name)
    except (*UNSIMULATED, NoiseUnknownError) as error:
        _LOG.info("copy %d: %s", number, error)
        return Outcome("failed")


def judged(diagnosis: Diagnosis, name: str) -> Outcome:
    """A diagnosis beside the name of what is hidden."""
    named = [(m.effect, *m.tied_with) for m in diagnosis.missing]
    words = tuple(" or ".join(names) for names in named)
    if diagnosis.verdict == "missing":
        alone = len(named) == 1 and name in named[0]
        return Outcome("found" if alone else "confused", words)
    said: dict[str, Said] = {"complete": "missed", "cannot_tell": "undecided"}
    return Outcome(said.get(diagnosis.verdict, "unexplained"), words)
