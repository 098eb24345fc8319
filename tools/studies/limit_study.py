"""Checks detection limits on made studies: how often the true size is inside them.

    python -m tools.studies.limit_study [--studies N] [--first SEED] [--effect NAME]

Of each study, made without an effect, the limits of every effect of both signs should contain none
of it; those of one sign do anyway.  Then one effect, another in each study or the one named, is
hidden at 0.5, 1 and 2 times its limit, the same cable and other noise for each: the limits found
must contain it.  A limit of one sign is never below what the study can show, so that it holds up to
about that size whatever the noise; it is asked only at twice its size, one of both signs at every
size.  The mesh's error is subtracted as in a diagnosis; that has no other part in it: whatever is
there, the limits must hold.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

from scipy.stats import binomtest

from cell.cable.effects import library
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy, all_fitted
from cell.lab.data.results import Limit
from cell.lab.fit.all_trials_fit import AllTrialsFit
from cell.lab.fit.fitting import Fit
from cell.lab.search.fit_cache import FitCache, settled_beside
from cell.lab.strength.limits import limits
from cell.study.data import Study
from tools.worlds.made_studies import make_study

SIZES = (0.5, 1.0, 2.0)
#: Of an amplitude's range.
SIGNS = ("both", "one")
#: Seeds of the noise of studies with an effect are so far apart: each size has noise of its own.
OTHER_NOISE = 100_000


@dataclass
class Tally:
    """How many limits were asked, and in how many the true size was inside."""

    good: int = 0
    asked: int = 0

    def add(self, good: int, asked: int = 1) -> None:
        """Count limits of one study."""
        self.good += good
        self.asked += asked

    def __add__(self, other: Tally) -> Tally:
        return Tally(self.good + other.good, self.asked + other.asked)

    @property
    def words(self) -> str:
        """The share inside with its 95 % interval."""
        if self.asked == 0:
            return "none tried"
        sure = binomtest(self.good, self.asked).proportion_ci()
        share = f"{self.good} of {self.asked} = {self.good / self.asked:.1%}"
        return f"inside in {share} ({sure.low:.1%} … {sure.high:.1%})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=10)
    parser.add_argument("--first", type=int, default=700)
    parser.add_argument("--effect", choices=list(library()))
    given = parser.parse_args()
    absent = Tally()
    hidden = {(size, signs): Tally() for size in SIZES for signs in SIGNS}
    for seed in range(given.first, given.first + given.studies):
        began = time.process_time()
        _one(seed, given.effect, absent, hidden)
        print(f"{seed}: {time.process_time() - began:.0f} s of CPU", flush=True)
    print(f"none of an effect of both signs: {absent.words}")
    for size in SIZES:
        of_both, of_one = (hidden[size, signs] for signs in SIGNS)
        print(f"true size {size:g} × the limit: {(of_both + of_one).words}; "
              f"of both signs {of_both.words}; of one sign {of_one.words}")  # fmt: skip
    print(f"all sizes together: {sum(hidden.values(), Tally()).words}")
    asked = [t for (size, signs), t in hidden.items() if signs == "both" or size > 1.0]
    print(f"where noise alone decides: {sum(asked, Tally()).words}")


def _one(
    seed: int, chosen: str | None, absent: Tally, hidden: dict[tuple[float, str], Tally]
) -> None:
    """Ask the limits of one cable, without an effect and with one, and count what they hold."""
    known = library()
    name = chosen or list(known)[seed % len(known)]
    tried = [known[name]] if chosen else list(known.values())
    none = {e: {p.name: p.default for p in known[e].parameters} for e in known}
    found = limits(AllTrialsFit(*_fitted(make_study(seed))), tried)
    shown = [x for x in found if x.high is not None]
    missed = [x for x in shown if not _holds(x, none[x.effect])]
    of_both = [x for x in shown if x.low != none[x.effect][x.parameter]]
    absent.add(len(of_both) - len(missed), len(of_both))
    print(f"{seed} none: {len(shown)} limits, not inside: "
          f"{', '.join(_words(x) for x in missed) or 'none'}")  # fmt: skip
    limit = next((x for x in shown if x.effect == name), None)
    if limit is None:
        return
    signs = SIGNS[0] if limit in of_both else SIGNS[1]
    effect = known[name]
    for number, size in enumerate(SIZES, 1):
        assert limit.high is not None
        off = none[name][limit.parameter]
        values = {p.name: p.default if p.amplitude else p.starts[0] for p in effect.parameters}
        values[limit.parameter] = off + size * (limit.high - off)
        study = make_study(seed, [effect.active(**values)], noise_seed=number * OTHER_NOISE + seed)
        again = next(
            x
            for x in limits(AllTrialsFit(*_fitted(study)), [effect])
            if x.parameter == limit.parameter
        )
        held = again.high is None or _holds(again, values)
        hidden[size, signs].add(held)
        print(f"{seed} {name} at {size:g} × its limit, {values[limit.parameter]:.3g}: "
              f"{_words(again)}{'' if held else ' NOT INSIDE'}")  # fmt: skip


def _fitted(study: Study) -> tuple[PreparedStudy, Fit]:
    prepared = PreparedStudy.of(all_fitted(study))
    fits = FitCache(prepared, ParameterSpace.of(study.cable), library())
    fits = settled_beside(fits, fits.baseline()) or fits
    return fits.prepared, fits.baseline().fit


def _holds(limit: Limit, values: dict[str, float]) -> bool:
    assert limit.low is not None and limit.high is not None
    return limit.low <= values[limit.parameter] <= limit.high


def _words(limit: Limit) -> str:
    if limit.low is None or limit.high is None:
        return f"{limit.effect} could not be shown"
    return f"{limit.effect}.{limit.parameter} {limit.low:.3g} … {limit.high:.3g}"


if __name__ == "__main__":
    main()
