"""Checks detection limits on made studies: how often the true size is inside them.

    python tools/limit_study.py [--studies N] [--first SEED] [--effect NAME]

Of each study, made without an effect, the limits of every effect of both signs should contain none
of it; those of one sign do anyway.  Then one effect, another in each study or the one named, is
hidden at 0.5, 1 and 2 times its limit, the same cable and other noise for each: the limits found
must contain it.  The diagnosis has no part in it: whatever is there, the limits must hold.
"""

from __future__ import annotations

import argparse
import time

from made_studies import make_study
from scipy.stats import binomtest

from cell.cable.effects import library
from cell.identify.parameters import ParameterSpace
from cell.lab.explore import Explorer
from cell.lab.fitting import Fit
from cell.lab.limits import limits
from cell.lab.prepared import PreparedStudy, all_fitted
from cell.lab.results import Limit
from cell.lab.whole import Whole
from cell.study.data import Study

SIZES = (0.5, 1.0, 2.0)
#: Seeds of the noise of studies with an effect are so far apart: each size has noise of its own.
OTHER_NOISE = 100_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=10)
    parser.add_argument("--first", type=int, default=700)
    parser.add_argument("--effect", choices=list(library()))
    given = parser.parse_args()
    known = library()
    inside = {0.0: [0, 0], **{size: [0, 0] for size in SIZES}}
    for seed in range(given.first, given.first + given.studies):
        began = time.process_time()
        name = given.effect or list(known)[seed % len(known)]
        tried = [known[name]] if given.effect else list(known.values())
        found = limits(Whole(*_fitted(make_study(seed))), tried)
        none = {e: {p.name: p.default for p in known[e].parameters} for e in known}
        missed = [x for x in found if x.high is not None and not _holds(x, none[x.effect])]
        shown = [x for x in found if x.high is not None]
        of_both_signs = [x for x in shown if x.low != none[x.effect][x.parameter]]
        inside[0.0][0] += len(of_both_signs) - len(missed)
        inside[0.0][1] += len(of_both_signs)
        print(f"{seed} none: {len(shown)} limits, not inside: "
              f"{', '.join(_words(x) for x in missed) or 'none'}")  # fmt: skip
        limit = next((x for x in shown if x.effect == name), None)
        for number, size in enumerate(SIZES if limit is not None else (), 1):
            assert limit is not None and limit.high is not None
            effect = known[name]
            off = next(p.default for p in effect.parameters if p.name == limit.parameter)
            values = {p.name: p.default if p.amplitude else p.starts[0] for p in effect.parameters}
            values[limit.parameter] = off + size * (limit.high - off)
            other = number * OTHER_NOISE + seed
            study = make_study(seed, [effect.active(**values)], noise_seed=other)
            again = next(
                x
                for x in limits(Whole(*_fitted(study)), [effect])
                if x.parameter == limit.parameter
            )
            held = again.high is None or _holds(again, values)
            inside[size][0] += held
            inside[size][1] += 1
            print(f"{seed} {name} at {size:g} × its limit, {values[limit.parameter]:.3g}: "
                  f"{_words(again)}{'' if held else ' NOT INSIDE'}")  # fmt: skip
        print(f"{seed}: {time.process_time() - began:.0f} s of CPU", flush=True)
    for size, (good, count) in inside.items():
        print(f"true size {size:g} × the limit: {_share(good, count)}")
    hidden = [inside[size] for size in SIZES]
    print(f"at 0.5, 1 and 2 together: {_share(*map(sum, zip(*hidden, strict=True)))}")


def _share(good: int, count: int) -> str:
    if count == 0:
        return "none tried"
    sure = binomtest(good, count).proportion_ci()
    return f"inside in {good} of {count} = {good / count:.1%} ({sure.low:.1%} … {sure.high:.1%})"


def _fitted(study: Study) -> tuple[PreparedStudy, Fit]:
    prepared = PreparedStudy.of(all_fitted(study))
    space = ParameterSpace.of(study.cable)
    return prepared, Explorer(prepared, space, {}).baseline().fit


def _holds(limit: Limit, values: dict[str, float]) -> bool:
    assert limit.low is not None and limit.high is not None
    return limit.low <= values[limit.parameter] <= limit.high


def _words(limit: Limit) -> str:
    if limit.low is None or limit.high is None:
        return f"{limit.effect} could not be shown"
    return f"{limit.effect}.{limit.parameter} {limit.low:.3g} … {limit.high:.3g}"


if __name__ == "__main__":
    main()
