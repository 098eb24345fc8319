"""Which effect the lab names for which hidden one: all effects, sizes 0.5 … 2, noise 0.05 … 0.3 mm.

    python tools/confusion_study.py [--studies 100] [--first 0] [--hide one|unknown|pair]

`unknown` takes the hidden effect out of the library: right is then `unexplained`.  `pair` hides
two: right is to name both and nothing else.

The power of a study is that of a test which knows the truth: the χ² that the hidden effect leaves
on all trials after the baseline has been fitted without noise, against the χ² that a test over the
whole library at 1 % asks for; of a pair, that for the one harder to see beside the other.  Only
studies with power ≥ 0.8 count as detectable.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from made_studies import hidden, make_study
from scipy import stats
from scipy.optimize import linear_sum_assignment

from cell.cable.effects import Effect, library
from cell.identify.parameters import ParameterSpace
from cell.lab.diagnose import diagnose
from cell.lab.explore import Explorer
from cell.lab.fitting import fit_trials
from cell.lab.prepared import PreparedStudy
from cell.lab.results import MissingEffect

SIGNIFICANCE = 0.01
#: No motion from rest tells these apart: with one out of the library the other is right.
ONE_CLASS = {"camera_latency", "robot_lag"}
#: Of the detectable.
LEAST_RIGHT = {"one": 0.95, "unknown": 0.95, "pair": 0.8}


@dataclass(frozen=True)
class Outcome:
    """What a diagnosis said beside the truth.

    hide    what was asked
    hidden  the effects behind the data; `beside`: such that are there too and need not be named
    named   classes of tied effects
    """

    hide: str
    hidden: tuple[str, ...]
    power: float
    verdict: str
    named: tuple[frozenset[str], ...]
    beside: tuple[str, ...] = ()

    @property
    def right(self) -> bool:
        if self.hide == "unknown":
            return self.verdict == "unexplained"
        return self.has_named_all(self.named)

    def has_named_all(self, named: Sequence[frozenset[str]]) -> bool:
        """Whether these classes name all that is hidden, and nothing that is not there."""
        there = [*self.hidden, *self.beside]
        worth = [1.0 + (h in self.hidden) for h in there]
        gain = [[w * (h in n) for n in named] for h, w in zip(there, worth, strict=True)]
        pairs = zip(*linear_sum_assignment(gain, maximize=True), strict=True)
        found = [there[i] for i, j in pairs if gain[i][j]]
        return set(self.hidden) <= set(found) and len(found) == len(named)

    @property
    def wrong(self) -> bool:
        return self.has_named_other(self.named)

    def has_named_other(self, named: Sequence[frozenset[str]]) -> bool:
        """Whether one of these classes holds nothing that is there."""
        return any(not names & {*self.hidden, *self.beside} for names in named)


def one(seed: int, hide: str) -> Outcome:
    known = library()
    names = sorted(known)
    rng = np.random.default_rng(10_000 + seed)
    effects = [known[names[seed % len(names)]]]
    if hide == "pair":
        effects.append(known[rng.choice([n for n in names if n != effects[0].name])])
    active = [hidden(e, float(rng.uniform(0.5, 2.0))) for e in effects]
    study = make_study(seed, active)
    space = ParameterSpace.of(study.cable)
    prepared = PreparedStudy.of(study)
    taken = {e.name for e in effects}
    if taken & ONE_CLASS:
        taken |= ONE_CLASS
    offered = {n: e for n, e in known.items() if hide != "unknown" or n not in taken}
    found = diagnose(Explorer(prepared, space, offered)).diagnosis
    lacking: list[list[type[Effect]]] = [[e] for e in effects] if hide == "pair" else [[]]
    spaces = [ParameterSpace.of(study.cable, effects=rest) for rest in lacking]
    clean = make_study(seed, active, noise_m=1e-9, colour=0.0)
    quiet = PreparedStudy.of(replace(clean, noise_std_m=prepared.noise.std_m))
    independent = prepared.floor.effective_fraction
    power = min(power_of(independent * evidence(quiet, s), quiet, len(known)) for s in spaces)
    return Outcome(
        hide, tuple(e.name for e in effects), power, found.verdict, classes(found.missing)
    )


def classes(found: Sequence[MissingEffect]) -> tuple[frozenset[str], ...]:
    """Each effect named with those that it is tied with."""
    return tuple(frozenset({f.effect, *f.tied_with}) for f in found)


def evidence(quiet: PreparedStudy, space: ParameterSpace) -> float:
    """χ² that a study without noise, told its level, leaves when `space` is fitted to it."""
    return Explorer(quiet, space, {}).baseline().fit.chi2


def least_evidence(quiet: PreparedStudy, tests: int) -> float:
    """χ² that a test over so many effects asks for."""
    count = quiet.count(fit_trials(quiet))
    return float(stats.chi2.isf(SIGNIFICANCE / tests, 1) + np.log(count))


def power_of(independent: float, quiet: PreparedStudy, tests: int) -> float:
    """Of a test that knows the truth, by the χ² of independent values that the effect leaves."""
    return float(stats.ncx2.sf(least_evidence(quiet, tests), 1, independent))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--hide", choices=("one", "unknown", "pair"), default="one")
    given = parser.parse_args()
    outcomes = []
    for seed in range(given.first, given.first + given.studies):
        outcome = one(seed, given.hide)
        outcomes.append(outcome)
        shown = ", ".join(" or ".join(sorted(n)) for n in outcome.named)
        print(f"{seed:4d}  {' + '.join(outcome.hidden):20s} power {outcome.power:.2f}  "
              f"{outcome.verdict:12s} {shown}", flush=True)  # fmt: skip
    detectable = [o for o in outcomes if o.power >= 0.8]
    right = sum(o.right for o in detectable)
    wrong = sum(o.wrong for o in outcomes)
    if given.hide != "pair":
        _table(outcomes)
    share = right / max(1, len(detectable))
    print(f"\nright class: {right} of {len(detectable)} detectable = {share:.1%}; "
          f"wrong claims: {wrong} of {len(outcomes)}")  # fmt: skip
    return 0 if share >= LEAST_RIGHT[given.hide] else 1


def _table(outcomes: Sequence[Outcome]) -> None:
    print("\n| hidden | studies | detectable | right | named |\n|---|---|---|---|---|")
    for effect in sorted({o.hidden[0] for o in outcomes}):
        mine = [o for o in outcomes if o.hidden[0] == effect]
        able = [o for o in mine if o.power >= 0.8]
        names = sorted({" or ".join(sorted(n)) for o in mine for n in o.named})
        print(f"| {effect} | {len(mine)} | {len(able)} | {sum(o.right for o in able)} | "
              f"{'; '.join(names)} |")  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
