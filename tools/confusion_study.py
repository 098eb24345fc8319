"""Which effect the lab names for which hidden one: all effects, sizes 0.5 … 2, noise 0.05 … 0.3 mm.

    python tools/confusion_study.py [--studies 100] [--first 0]

The power of a study is that of a test which knows the truth: the χ² that the hidden effect leaves
on all trials after the baseline has been fitted without noise, against the χ² that a test over the
whole library at 1 % asks for.  Only studies with power ≥ 0.8 count as detectable.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace

import numpy as np
from made_studies import hidden, make_study
from scipy import stats

from cell.cable.effects import library
from cell.identify.parameters import ParameterSpace
from cell.lab.bench import Bench
from cell.lab.diagnose import diagnose
from cell.lab.explore import Explorer
from cell.lab.fitting import fit_trials

SIGNIFICANCE = 0.01


@dataclass(frozen=True)
class Outcome:
    effect: str
    power: float
    verdict: str
    named: tuple[frozenset[str], ...]

    @property
    def right(self) -> bool:
        return len(self.named) == 1 and self.effect in self.named[0]

    @property
    def wrong(self) -> bool:
        return any(self.effect not in names for names in self.named)


def one(seed: int) -> Outcome:
    known = library()
    names = sorted(known)
    rng = np.random.default_rng(10_000 + seed)
    effect = known[names[seed % len(names)]]
    active = hidden(effect, float(rng.uniform(0.5, 2.0)))
    study = make_study(seed, [active])
    space = ParameterSpace.of(study.cable)
    bench = Bench.of(study)
    found = diagnose(Explorer(bench, space, known)).diagnosis
    clean = make_study(seed, [active], noise_m=1e-9, colour=0.0)
    quiet = replace(clean, noise_std_m=bench.noise.std_m)
    left = Explorer(Bench.of(quiet), space, {}).baseline().fit
    count = bench.count(fit_trials(bench))
    limit = stats.chi2.isf(SIGNIFICANCE / len(known), 1) + np.log(count)
    power = float(stats.ncx2.sf(limit, 1, left.chi2 * bench.floor.effective_fraction))
    named = tuple(frozenset({f.effect, *f.tied_with}) for f in found.missing)
    return Outcome(effect.name, power, found.verdict, named)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    outcomes = []
    for seed in range(given.first, given.first + given.studies):
        outcome = one(seed)
        outcomes.append(outcome)
        shown = ", ".join(" or ".join(sorted(n)) for n in outcome.named)
        print(f"{seed:4d}  {outcome.effect:20s} power {outcome.power:.2f}  {outcome.verdict:12s} "
              f"{shown}", flush=True)  # fmt: skip
    detectable = [o for o in outcomes if o.power >= 0.8]
    right = sum(o.right for o in detectable)
    wrong = sum(o.wrong for o in outcomes)
    print("\n| hidden | studies | detectable | right | named |\n|---|---|---|---|---|")
    for effect in sorted({o.effect for o in outcomes}):
        mine = [o for o in outcomes if o.effect == effect]
        able = [o for o in mine if o.power >= 0.8]
        names = sorted({" or ".join(sorted(n)) for o in mine for n in o.named})
        print(f"| {effect} | {len(mine)} | {len(able)} | {sum(o.right for o in able)} | "
              f"{'; '.join(names)} |")  # fmt: skip
    share = right / max(1, len(detectable))
    print(f"\nright class: {right} of {len(detectable)} detectable = {share:.1%}; "
          f"wrong claims: {wrong} of {len(outcomes)}")  # fmt: skip
    return 0 if share >= 0.95 else 1


if __name__ == "__main__":
    sys.exit(main())
