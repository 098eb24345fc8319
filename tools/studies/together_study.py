"""Batches of six cables diagnosed together: is the answer right, and does the interval hold it?

In a batch all cables have an effect of one size, or two of the six, or none.  Each study has three
motions, two of them to be fitted to.

    python -m tools.studies.together_study together.csv --cables 20
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from cell.api.several import TogetherResult, diagnose_together
from cell.cable.effects import ActiveEffect, library
from cell.study.data import Study
from tools.studies.cable_rows import options, written
from tools.worlds.made_studies import hidden, make_study

#: Motions of each study, cables of a batch, and cables of a mixed batch that have the effect.
MOTIONS, CABLES, FEW = ("identify", "probe_up", "deep"), 6, 2
#: Sizes, over that typical of a cable.
SIZES = (0.3, 2.0)
KINDS = ("alike", "alike", "alike", "two of six", "none")


@dataclass(frozen=True)
class Batch:
    """One batch.

    right     the effect is named or tied, `complete` without one; if mixed, the cables too
    covered   the first amplitude is inside its interval
    spread    p-value of differences between the cables
    """

    batch: int
    kind: str
    effect: str
    size: float
    verdict: str
    found: str
    tied: str
    shows: int
    excludes: int
    right: bool
    covered: bool
    spread: float
    alone_right: int
    cpu_s: float


def made(batch: int, kind: str, effect: ActiveEffect) -> list[Study]:
    """The six studies."""
    several = {"alike": CABLES, "two of six": FEW, "none": 0}[kind]
    studies = []
    for cable in range(CABLES):
        effects = [effect] if cable < several else []
        study = make_study(100 * batch + cable, effects, colour=0.3)
        trials = tuple(t for t in study.trials if t.name in MOTIONS)
        studies.append(replace(study, name=f"cable_{cable}", trials=trials))
    return studies


def judged(batch: int, kind: str, size: float, effect: ActiveEffect, cpu_s: float,
           result: TogetherResult) -> Batch:  # fmt: skip
    """Whether the answer is right."""
    found, name = result.together, effect.effect.name
    one = {name}
    named = one == set(found.effects) or any(one == set(t) for t in found.tied)
    shows = [p.study for p in found.studies if p.says == "shows"]
    excludes = [p.study for p in found.studies if p.says == "excludes"]
    right = found.verdict == "complete" if kind == "none" else named and found.verdict == "missing"
    if kind == "two of six":
        right &= set(shows) == {f"cable_{i}" for i in range(FEW)} and bool(excludes)
    amplitude = next(p.name for p in effect.effect.parameters if p.amplitude)
    value = effect.named[amplitude]
    of_it = [c for c in found.consistency if c.parameter == f"{name}.{amplitude}"]
    return Batch(
        batch,
        kind,
        name,
        size,
        found.verdict,
        " + ".join(found.effects),
        ", ".join(" + ".join(t) for t in found.tied),
        len(shows),
        len(excludes),
        right,
        any(c.low <= value <= c.high for c in of_it),
        of_it[0].q_p_value if of_it else float("nan"),
        sum(any(name in m for m in p.missing) for p in found.studies),
        cpu_s,
    )


def main() -> None:
    parser = options(__doc__, 20)
    given = parser.parse_args()
    effects = list(library().values())
    rows: list[Batch] = []
    with written(given.file, Batch) as write:
        for batch in range(given.cables):
            rng = np.random.default_rng((given.seed, batch))
            kind = KINDS[batch % len(KINDS)]
            size = float(np.exp(rng.uniform(*np.log(SIZES))))
            effect = hidden(effects[(7 * batch + given.seed) % len(effects)], size)
            began = time.process_time()
            result = diagnose_together(made(given.seed * 1000 + batch, kind, effect))
            rows.append(judged(batch, kind, size, effect, time.process_time() - began, result))
            write(rows[-1:])
            print(rows[-1], flush=True)
    for kind in dict.fromkeys(KINDS):
        those = [r for r in rows if r.kind == kind]
        print(f"{kind}: {sum(r.right for r in those)} of {len(those)} right")


if __name__ == "__main__":
    main()
