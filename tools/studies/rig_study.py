"""What the lab says of made studies that imitate real rigs, each with one effect hidden.

    python -m tools.studies.rig_study [--studies 60] [--first 0] [--rig KIND] [--complete]

`--rig` takes rigs of one kind (`tools/worlds/rig_kinds.py`); with `--complete` nothing is hidden.
Else a rig draws its cable (a strip of 0.1 m, or a round cord of up to 1 m) and its features:

    slow            30 frames/s
    shapes          markers from fitted shapes: 2 … 7 mm of error, smooth along the cable, the
                    same for 2 … 4 frames; the study states it
    connector       a mass at the end; `curved`: a natural curvature.  Either is told to the lab
                    in half of the studies that have it (`--known`); named in the others it is right
    glitches        the hand's log has 30 µm of noise and single samples wrong by 60 … 200 µm, the
                    first among them
    one coordinate  of one marker, as a laser sees it; the study states the noise
    held, moving    every other trial begins bent by fingers, or after its record should have begun

The mesh is finer than the model's.  The hidden effect is as strong as is typical, or so strong that
a test which knows the truth shows it (power 0.95), as in `confusion_study.py`.  Studies are written
and read as anybody's.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy import stats

from cell.cable.effects import ActiveEffect, Effect, library
from cell.files.input_error import InputError
from cell.identify.parameters import ParameterSpace
from cell.lab.data.named_effects import EffectSelection
from cell.lab.data.noise_model import NoiseUnknownError
from cell.lab.data.opened_study import open_study
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.results import Diagnosis, Errors
from cell.lab.search.setup import fit_cache_of
from cell.lab.verdict.diagnose import diagnose
from cell.study.folder import write_study
from tools.studies.confusion_study import (
    Outcome,
    classes,
    evidence,
    least_evidence,
    power_of,
    without_noise,
)
from tools.worlds.made_studies import hidden
from tools.worlds.rig_kinds import KINDS
from tools.worlds.rigs import Rig, rig_study

#: Wanted of the test that knows the truth; for it an effect is made stronger so often, by so much
#: at once, and until it is so many times as strong as is typical.
POWER, MOST_TRIED, MOST_AT_ONCE, STRONGEST = 0.95, 3, 5.0, 20.0


@dataclass(frozen=True)
class RigOutcome(Outcome):
    """refused: why the study was not taken."""

    refused: str = ""

    @property
    def judged(self) -> str:
        """In a word or two."""
        if self.verdict == "complete":
            return "FALSE COMPLETE" if self.hidden else "right"
        if self.wrong:
            return "WRONG"
        if self.partly_wrong:
            return "partial, wrong name"
        if not self.hidden:
            return "not called complete"
        if self.right:
            return "right"
        if self.partly_right:
            return "partial, right name"
        return "refused" if self.refused else "not named"


def one(
    seed: int, kind: str | None = None, *, complete: bool = False
) -> tuple[Rig, ActiveEffect | None, RigOutcome, float]:
    """A study's rig, what was hidden, what the lab said of it, and its seconds of CPU.

    kind  of rig; None = of all features.  With `complete` nothing is hidden
    """
    known = library()
    name = sorted(known)[seed % len(known)]
    rig = Rig.drawn(seed, name) if kind is None else KINDS[kind](seed)
    effect, power = (None, 0.0) if complete else that_shows(rig, known[name], len(known))
    return rig, effect, *examined(rig, effect, power)


def examined(rig: Rig, effect: ActiveEffect | None, power: float) -> tuple[RigOutcome, float]:
    """What the lab says of a rig's study, and its seconds of CPU; power of a test that knows."""
    selection = EffectSelection(tuple(a.effect for a in rig.known), library())
    beside = tuple(a.effect.name for a in rig.unsaid)
    began = time.process_time()
    found, refused = Diagnosis(np.nan, Errors(np.nan, np.nan), "cannot_tell"), ""
    with TemporaryDirectory() as folder:
        write_study(rig_study(rig, effect), Path(folder))
        try:
            found = diagnose(fit_cache_of(open_study(Path(folder)), selection)).diagnosis
        except (InputError, NoiseUnknownError) as error:
            refused = str(error).replace(folder, "")
    outcome = RigOutcome("one", (effect.effect.name,) if effect else (), power, found.verdict,
                         classes(found.missing), beside, classes(found.partial),
                         refused)  # fmt: skip
    return outcome, time.process_time() - began


def that_shows(rig: Rig, effect: type[Effect], tests: int) -> tuple[ActiveEffect, float]:
    """The effect so strong that it shows, and the power of the test that knows the truth."""
    rng = np.random.default_rng([rig.seed, 3])
    size = rng.uniform(0.7, 1.5)
    if all(p.low < p.default for p in effect.parameters if p.amplitude):
        size *= rng.choice([-1.0, 1.0])
    there = tuple(a.effect for a in (*rig.known, *rig.unsaid))
    space = ParameterSpace.of(rig.cable, effects=there)

    def shown(size: float) -> tuple[ActiveEffect, PreparedStudy, float]:
        active = hidden(effect, size, rig.cable)
        quiet = without_noise(rig_study(rig, active, quiet=True), rig.noise)
        return active, quiet, rig.independent * evidence(quiet, space)

    active, quiet, chi2 = shown(size)
    wanted = (np.sqrt(least_evidence(quiet, tests)) + stats.norm.ppf(POWER)) ** 2
    for _ in range(MOST_TRIED):
        if chi2 > wanted or abs(size) > STRONGEST:
            break
        size *= min(1.1 * np.sqrt(wanted / chi2), MOST_AT_ONCE)
        active, quiet, chi2 = shown(size)
    return active, power_of(chi2, quiet, tests)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--rig", choices=tuple(KINDS))
    parser.add_argument("--complete", action="store_true")
    given = parser.parse_args()
    seeds = range(given.first, given.first + given.studies)
    return told(one(seed, given.rig, complete=given.complete) for seed in seeds)


def told(rigs: Iterable[tuple[Rig, ActiveEffect | None, RigOutcome, float]]) -> int:
    """Print a line for each rig, as soon as it is known, and the totals; 1 if a claim is wrong."""
    outcomes, times_s = [], []
    for rig, effect, outcome, cpu_s in rigs:
        outcomes.append(outcome)
        times_s.append(cpu_s)
        named = [" or ".join(sorted(n)) for n in outcome.named]
        named += [f"mostly {' or '.join(sorted(n))}" for n in outcome.partial]
        there = "nothing hidden"
        if effect is not None:
            values = ", ".join(f"{v:.3g}" for v in effect.values)
            there = f"{effect.effect.name} {values}, power {outcome.power:.2f}"
        said = f"{outcome.verdict} {' + '.join(named)}{outcome.refused}; {outcome.judged}"
        print(f"{rig.seed:4d}  {rig.words}; {there}: {said}; {cpu_s:.0f} s", flush=True)
    _totals(outcomes, times_s)
    return 0 if not any(o.judged == "FALSE COMPLETE" or o.wrong for o in outcomes) else 1


def _totals(outcomes: Sequence[RigOutcome], times_s: Sequence[float]) -> None:
    able = [o for o in outcomes if o.power >= 0.8 or not o.hidden]
    counts = {
        "false complete": [o.judged == "FALSE COMPLETE" for o in outcomes],
        "wrong claim": [o.wrong for o in outcomes],
        "partial with a wrong name": [o.partly_wrong for o in outcomes],
        "right, of those that show": [o.judged == "right" for o in able],
        "right or partial with the right name, of those that show": [
            o.judged in ("right", "partial, right name") for o in able
        ],
    }
    print()
    for what, hits in counts.items():
        if hits:
            sure = stats.binomtest(sum(hits), len(hits)).proportion_ci()
            print(f"{what}: {sum(hits)} of {len(hits)} (95 %: {sure.low:.1%} … {sure.high:.1%})")
    print(f"CPU time: median {np.median(times_s):.0f} s, longest {max(times_s):.0f} s")


if __name__ == "__main__":
    sys.exit(main())
