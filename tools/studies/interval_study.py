"""Coverage of the 95 % intervals of `cell fit` where the model lacks an effect.

    python -m tools.studies.interval_study [--studies 40] [--first 0] [--size 0.5] [--unknown]
                                           [--all-trials]

Each study has two effects: one is in the model, the other, with `--size` times its typical size
(0 = none), is omitted.  `--unknown` removes it from the library too, with effects that no motion
can distinguish from it.  EI(s) is evaluated at the model's knots.  `--all-trials`: the intervals of
effects as in a diagnosis, from all trials, instead of those of `cell fit`.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator

import numpy as np
from scipy.stats import binomtest

from cell.api.lab import fit_study
from cell.cable.effects import ActiveEffect, Effect, library
from cell.cable.model import CableModel
from cell.identify.identified import Identified
from cell.lab.data.named_effects import EffectSelection
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.setup import fit_cache_of
from cell.lab.strength.estimate import estimate
from tools.worlds.known_truth import class_of
from tools.worlds.made_studies import CABLE, hidden, make_study, random_model

#: Parameters of effects other than amplitudes are counted separately.
GROUPS = ("EI", "exponent", "viscosity", "amplitude", "shape")


def drawn(seed: int, size: float, unknown: bool) -> tuple[str, FitCache, CableModel]:
    """Random study of two effects: their names, its fits with one in the model, the truth."""
    known = library()
    names = sorted(known)
    rng = np.random.default_rng([seed, 7])
    present = known[names[seed % len(names)]]
    others = [n for n in names if n not in class_of([present.name])]
    lacking = known[rng.choice(others)]
    there = [hidden(present, float(rng.uniform(0.5, 1.5)))]
    if size > 0.0:
        there.append(hidden(lacking, size))
    study = make_study(seed, there)
    again = np.random.default_rng(seed)
    again.uniform(size=2)  # `make_study` has drawn the noise's level and colour from it
    truth = random_model(again, CABLE, there)
    out = class_of([lacking.name] if unknown else [])
    offered: dict[str, type[Effect]] = {n: e for n, e in known.items() if n not in out}
    fits = fit_cache_of(study, EffectSelection((present,), offered))
    return " without ".join(a.effect.name for a in there), fits, truth


def held(model: Identified, truth: CableModel) -> Iterator[tuple[str, str, bool]]:
    """Name and kind of each parameter, and whether its interval covers the truth."""
    low, high = model.interval()
    space = model.space
    arcs = np.linspace(0.0, truth.cable.free_length_m, space.knots)
    true = [*truth.rigidity_at(arcs), truth.exponent, truth.viscosity_n_m2_s]
    kinds = ["EI"] * space.knots + ["exponent", "viscosity"]
    present: ActiveEffect = truth.effects[0]
    for p, value in zip(present.effect.parameters, present.values, strict=True):
        true.append(value)
        kinds.append("amplitude" if p.amplitude else "shape")
    for i, (name, kind) in enumerate(zip(space.names, kinds, strict=True)):
        if space.low[i] < space.high[i]:
            yield name, kind, bool(low[i] <= true[i] <= high[i])


def held_by_all(fits: FitCache, truth: CableModel) -> Iterator[tuple[str, str, bool]]:
    """As `held`, for the effect's parameters estimated from all trials, as in a diagnosis."""
    present: ActiveEffect = truth.effects[0]
    estimates = estimate(fits.prepared, fits.base.fit, fits.library.values())
    true = dict(zip((p.name for p in present.effect.parameters), present.values, strict=True))
    amplitudes = {p.name for p in present.effect.parameters if p.amplitude}
    for name, interval in estimates.intervals(present.effect).items():
        kind = "amplitude" if name in amplitudes else "shape"
        yield name, kind, interval.low <= true[name] <= interval.high


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--size", type=float, default=0.5)
    parser.add_argument("--unknown", action="store_true")
    parser.add_argument("--all-trials", action="store_true")
    options = parser.parse_args()
    good: Counter[str] = Counter()
    count: Counter[str] = Counter()
    for seed in range(options.first, options.first + options.studies):
        words, fits, truth = drawn(seed, options.size, options.unknown)
        if options.all_trials:
            covered = held_by_all(fits, truth)
        else:
            model, *_ = fit_study(fits)
            words += f", seen beside it: {', '.join(model.lacks) or 'nothing'}"
            covered = held(model, truth)
        missed = []
        for name, kind, inside in covered:
            good[kind] += inside
            count[kind] += 1
            missed += [] if inside else [name]
        print(f"{seed} {words}; missed: {', '.join(missed) or 'none'}", flush=True)
    for kind in (k for k in GROUPS if count[k]):
        sure = binomtest(good[kind], count[kind]).proportion_ci()
        print(f"{kind}: {good[kind]} of {count[kind]} = {good[kind] / count[kind]:.1%} "
              f"({sure.low:.0%} … {sure.high:.0%})")  # fmt: skip


if __name__ == "__main__":
    main()
