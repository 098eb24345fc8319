"""Which effect the lab names for which hidden one: all effects, sizes 0.5 … 2, noise 0.05 … 0.3 mm.

    python -m tools.studies.confusion_study [--studies 100] [--first 0]
                                            [--hide one|unknown|pair|mixed]

`unknown` takes the hidden effect out of the library: right is then `unexplained`.  `pair` hides
two: right is to name both and nothing else.  `mixed` hides two, the second of them taken out of the
library, at sizes 2 … 5 and 1 … 3: right is `unexplained`, or to name the first and nothing else; in
part it may be named with nothing else, too.

The power of a study is that of a test which knows the truth: the χ² that the hidden effect leaves
on all trials after the baseline has been fitted without noise, against the χ² that a test over the
whole library at 1 % asks for; of a pair, that for the one harder to see beside the other; of a
mixed pair, that for the one which no library has.  Only
studies with power ≥ 0.8 count as detectable.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats
from scipy.optimize import linear_sum_assignment

from cell.cable.effects import Effect, library
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.renoised import with_noise_model
from cell.lab.data.results import MissingEffect
from cell.lab.fit.fitting import fit_trials
from cell.lab.search.fit_cache import FitCache
from cell.lab.verdict.diagnose import diagnose
from cell.study.data import Study
from tools.worlds.made_studies import hidden, make_study

SIGNIFICANCE = 0.01
#: No motion from rest tells these apart: with one out of the library the other is right.
ONE_CLASS = {"camera_latency", "robot_lag"}
#: Of the detectable.
LEAST_RIGHT = {"one": 0.95, "unknown": 0.95, "pair": 0.8, "mixed": 0.8}


@dataclass(frozen=True)
class Outcome:
    """What a diagnosis said beside the truth.

    hide     what was asked
    hidden   the effects behind the data; `beside`: such that are there too and need not be named
    named    classes of tied effects
    partial  the same of what explains most, where nothing explains all
    """

    hide: str
    hidden: tuple[str, ...]
    power: float
    verdict: str
    named: tuple[frozenset[str], ...]
    beside: tuple[str, ...] = ()
    partial: tuple[frozenset[str], ...] = ()

    @property
    def claims(self) -> bool:
        """Whether anything is claimed: what is named with `cannot_tell` is not."""
        return self.verdict == "missing"

    @property
    def right(self) -> bool:
        if self.hide in ("unknown", "mixed") and self.verdict == "unexplained":
            return True
        return self.hide != "unknown" and self.claims and self.has_named_all(self.named)

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
        return self.claims and self.has_named_other(self.named)

    @property
    def partly_right(self) -> bool:
        """Whether what explains most is there, the hidden effects among it."""
        named = {name for names in self.partial for name in names}
        return set(self.hidden) <= named and not self.partly_wrong

    @property
    def partly_wrong(self) -> bool:
        """Whether one that explains most is not there."""
        return self.has_named_other(self.partial)

    def has_named_other(self, named: Sequence[frozenset[str]]) -> bool:
        """Whether one of these classes holds nothing that is there."""
        return any(not names & {*self.hidden, *self.beside} for names in named)


def one(seed: int, hide: str) -> Outcome:
    known = library()
    effects, sizes = _drawn(seed, hide, known)
    active = [hidden(e, size) for e, size in zip(effects, sizes, strict=True)]
    study = make_study(seed, active)
    space = ParameterSpace.of(study.cable)
    prepared = PreparedStudy.of(study)
    told = effects[: {"unknown": 0, "mixed": 1}.get(hide, len(effects))]
    taken = _class_of(e.name for e in effects if e not in told)
    offered = {n: e for n, e in known.items() if n not in taken}
    found = diagnose(FitCache(prepared, space, offered)).diagnosis
    lacking = {"pair": [[e] for e in effects], "mixed": [effects[:1]]}.get(hide, [[]])
    spaces = [ParameterSpace.of(study.cable, effects=rest) for rest in lacking]
    clean = make_study(seed, active, noise_m=1e-9, colour=0.0)
    quiet = without_noise(clean, prepared.noise)
    power = min(power_of(evidence(quiet, s), quiet, len(known)) for s in spaces)
    names = tuple(e.name for e in effects)
    count = 1 if hide == "mixed" else len(names)
    return Outcome(hide, names[:count], power, found.verdict, classes(found.missing),
                   names[count:], classes(found.partial))  # fmt: skip


def _drawn(
    seed: int, hide: str, known: Mapping[str, type[Effect]]
) -> tuple[list[type[Effect]], list[float]]:
    """What is hidden in a study, and how many times as strong as is typical."""
    names = sorted(known)
    rng = np.random.default_rng(10_000 + seed)
    first = names[seed % len(names)]
    effects, ranges = [known[first]], [(0.5, 2.0)]
    if hide == "pair":
        effects.append(known[rng.choice([n for n in names if n != first])])
        ranges *= 2
    elif hide == "mixed":
        effects.append(known[rng.choice([n for n in names if n not in _class_of([first])])])
        ranges = [(2.0, 5.0), (1.0, 3.0)]
    return effects, [float(rng.uniform(low, high)) for low, high in ranges]


def _class_of(names: Iterable[str]) -> set[str]:
    """These effects and what no motion tells from them."""
    found = set(names)
    return found | ONE_CLASS if found & ONE_CLASS else found


def classes(found: Sequence[MissingEffect]) -> tuple[frozenset[str], ...]:
    """Each effect named with those that it is tied with."""
    return tuple(frozenset({f.effect, *f.tied_with}) for f in found)


def without_noise(quiet: Study, noise: Noise) -> PreparedStudy:
    """A study whose measurements have no noise, told what noise they have otherwise.

    Its level is taken for seen, and its colour is not looked for in what is not there.
    """
    prepared = PreparedStudy.of(replace(quiet, noise_std_m=noise.std_m))
    return with_noise_model(prepared, replace(prepared.noise_model, noise=noise, dof=1e9))


def evidence(quiet: PreparedStudy, space: ParameterSpace) -> float:
    """χ² of independent values that a study without noise leaves when `space` is fitted to it."""
    return FitCache(quiet, space, {}).baseline().fit.chi2


def least_evidence(quiet: PreparedStudy, tests: int) -> float:
    """χ² that a test over so many effects asks for."""
    count = quiet.count(fit_trials(quiet))
    return float(stats.chi2.isf(SIGNIFICANCE / tests, 1) + np.log(count))


def power_of(chi2: float, quiet: PreparedStudy, tests: int) -> float:
    """Of a test that knows the truth, by the χ² of independent values that the effect leaves."""
    return float(stats.ncx2.sf(least_evidence(quiet, tests), 1, chi2))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--hide", choices=tuple(LEAST_RIGHT), default="one")
    given = parser.parse_args()
    outcomes = []
    for seed in range(given.first, given.first + given.studies):
        outcome = one(seed, given.hide)
        outcomes.append(outcome)
        said = [" or ".join(sorted(n)) for n in outcome.named]
        said += [f"mostly {' or '.join(sorted(n))}" for n in outcome.partial]
        print(f"{seed:4d}  {' + '.join((*outcome.hidden, *outcome.beside)):20s} "
              f"power {outcome.power:.2f}  {outcome.verdict:12s} {', '.join(said)}",
              flush=True)  # fmt: skip
    detectable = [o for o in outcomes if o.power >= 0.8]
    right = sum(o.right for o in detectable)
    wrong = sum(o.wrong for o in outcomes)
    if given.hide in ("one", "unknown"):
        _table(outcomes)
    share = right / max(1, len(detectable))
    print(f"\nright class: {right} of {len(detectable)} detectable = {share:.1%}; "
          f"wrong claims: {wrong} of {len(outcomes)}; cannot tell "
          f"{sum(o.verdict == 'cannot_tell' for o in outcomes)}; in part: right "
          f"{sum(o.partly_right for o in outcomes)}, "
          f"wrong {sum(o.partly_wrong for o in outcomes)}")  # fmt: skip
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
