"""What the lab says of made studies that imitate real rigs, each with one effect hidden.

    python -m tools.studies.rig_study [--studies 60] [--first 0]

A rig draws its cable (a strip of 0.1 m, or a round cord of up to 1 m) and its features:

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
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy import stats

from cell.cable.dynamics import simulate
from cell.cable.effects import ActiveEffect, Effect, library
from cell.cable.geometry import Cable, Motion, node_arc_lengths
from cell.cable.model import CableModel
from cell.cable.modes import mode_curvature
from cell.files.input_error import InputError
from cell.identify.parameters import ParameterSpace
from cell.lab.data.noise_model import NoiseUnknownError
from cell.lab.data.opened_study import open_study
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.results import Diagnosis, Errors
from cell.lab.data.selection import EffectSelection
from cell.lab.search.setup import fit_cache_of
from cell.lab.verdict.diagnose import diagnose
from cell.study.data import Markers, Study, Trial
from cell.study.folder import write_study
from tools.studies.confusion_study import Outcome, classes, evidence, least_evidence, power_of
from tools.worlds.made_studies import (
    STROKES,
    WORLD,
    coloured,
    hidden,
    like,
    logged,
    random_model,
    stroke,
)

#: How many rigs have a feature.
SHARES = {"slow": 0.4, "shapes": 0.4, "connector": 0.3, "curved": 0.3, "glitches": 0.4,
          "one coordinate": 0.2}  # fmt: skip
STARTS = ("at rest", "at rest", "held", "moving")
#: Features that are effects: sizes of their typical strength.
AS_EFFECTS = {"connector": ("tip_mass", 1.0, 3.0), "curved": ("natural_curvature", 0.5, 2.0)}
SLOW_FRAME_S = 1.0 / 30.0
#: Shapes along the cable of what a fitted shape errs by.
ERRING_SHAPES = 3
#: Wanted of the test that knows the truth; for it an effect is made stronger so often, by so much
#: at once, and until it is so many times as strong as is typical.
POWER, MOST_TRIED, MOST_AT_ONCE, STRONGEST = 0.95, 3, 5.0, 20.0


@dataclass(frozen=True, eq=False)
class Rig:
    """A rig, its cable and what is wrong with its measurements.

    features  besides those that are effects
    updates   frames for which an erring shape stays the same
    seen      axis of the one coordinate, or None: both
    known     effects that the lab is told of; unsaid: those that are there as well
    """

    seed: int
    features: tuple[str, ...]
    cable: Cable
    arc_length_m: np.ndarray
    frame_s: float
    tilt_rad: float
    noise_m: float
    colour: float
    updates: int
    seen: int | None
    start: str
    known: tuple[ActiveEffect, ...]
    unsaid: tuple[ActiveEffect, ...]

    @staticmethod
    def drawn(seed: int, effect: str) -> Rig:
        """A rig in which `effect` can be hidden."""
        rng = np.random.default_rng([seed, 1])
        has = [f for f, share in SHARES.items() if rng.uniform() < share]
        if "one coordinate" in has and "shapes" in has:
            has.remove("shapes")
        has = has or ["slow"]
        length, across = rng.uniform(0.5, 1.0), rng.uniform(0.005, 0.009)
        cable = Cable(length, 1200.0 * np.pi / 4.0 * across**2, across, across)
        if "shapes" not in has and rng.uniform() < 0.5:
            cable = Cable(rng.uniform(0.08, 0.15), 0.0074, 0.016, 0.0001)
        length, arcs = cable.free_length_m, node_arc_lengths(cable.free_length_m, 11)
        noise_m, updates = length * float(np.exp(rng.uniform(np.log(5e-4), np.log(3e-3)))), 1
        if "shapes" in has:
            noise_m, updates = rng.uniform(2e-3, 7e-3), int(rng.integers(2, 5))
            arcs = node_arc_lengths(length, int(rng.integers(3, 7)))[:-1]
        tilt_rad = float(rng.choice([0.0, 0.6, 1.2]))
        seen = None
        if "one coordinate" in has:
            arcs, seen = np.array([0.85 * length]), 0 if tilt_rad > 0.6 else 1
        known, unsaid = [], []
        for feature, (name, low, high) in AS_EFFECTS.items():
            if feature in has and name != effect:
                size = rng.uniform(low, high)
                there = hidden(library()[name], size, cable)
                (known if rng.uniform() < 0.5 else unsaid).append(there)
        frame_s = SLOW_FRAME_S if "slow" in has else 0.005 * like(cable, "s")
        kept = tuple(f for f in has if f not in AS_EFFECTS)
        return Rig(seed, kept, cable, arcs, frame_s, tilt_rad, noise_m, rng.uniform(0.0, 0.6),
                   updates, seen, str(rng.choice(STARTS)), tuple(known), tuple(unsaid))  # fmt: skip

    @property
    def independent(self) -> float:
        """Independent values per value of its noise."""
        in_time = (1.0 - self.colour) / (1.0 + self.colour) / self.updates
        if self.updates == 1:
            return in_time
        return in_time * min(1.0, ERRING_SHAPES / len(self.arc_length_m))

    @property
    def words(self) -> str:
        """Its cable, features and how trials begin."""
        said = [f"{a.effect.name} known" for a in self.known]
        said += [f"{a.effect.name} unsaid" for a in self.unsaid]
        start = [] if self.start == "at rest" else [self.start]
        return ", ".join([f"{self.cable.free_length_m:.2f} m", *self.features, *said, *start])


def rig_study(rig: Rig, effect: ActiveEffect, *, quiet: bool = False) -> Study:
    """The study of a rig with an effect hidden; `quiet`: nothing is wrong with its measurements."""
    rng, errors = (np.random.default_rng([rig.seed, i]) for i in (2, 4))
    model = random_model(rng, rig.cable, (*rig.known, *rig.unsaid, effect))
    trials = []
    for number, (name, role, angle, way, seconds) in enumerate(STROKES[:5]):
        slower, longer = like(rig.cable, "s"), like(rig.cable, "m")
        still_s = max(0.2 * slower, 10.0 * rig.frame_s)
        hand = stroke(angle + rig.tilt_rad, (longer * way[0], longer * way[1]), seconds * slower,
                      still_s, 0.9 * slower)  # fmt: skip
        bent = number % 2 == 0 and rig.start != "at rest"
        start = rig.start if bent else "equilibrium"
        if start == "held":
            hand = replace(hand, x_m=0.0 * hand.x_m, y_m=0.0 * hand.y_m)
        begin_s = rng.uniform(0.0, rig.frame_s)
        if start == "moving":
            begin_s += still_s + rng.uniform(0.7, 1.2) * seconds * slower
        t_s = np.arange(begin_s, hand.t_s[-1], rig.frame_s)
        seen = _simulated(rng, model, hand, t_s, rig, start, still_s)
        if not quiet:
            seen = seen + rig.noise_m * _erring(errors, rig, seen.shape)
            hand = _logged(errors, rig, hand)
        if rig.seen is not None:
            seen[..., 1 - rig.seen] = np.nan
        trials.append(Trial(name, "fit" if role == "fit" else "validate", start, hand,
                            Markers(t_s, seen), still_s if start == "held" else None))  # fmt: skip
    stated = quiet or {"shapes", "one coordinate"} & set(rig.features)
    return Study(f"rig_{rig.seed}", rig.cable, rig.arc_length_m, tuple(trials),
                 noise_std_m=rig.noise_m if stated else None)  # fmt: skip


def _simulated(
    rng: np.random.Generator,
    model: CableModel,
    hand: Motion,
    t_s: np.ndarray,
    rig: Rig,
    start: str,
    release_s: float,
) -> np.ndarray:
    """(times, markers, 2) of the world; fingers at the tip and inside the cable bend what is held.

    The curvature that they add has a kink, and they let go some milliseconds beside the time noted.
    """
    if start != "held":
        return simulate(model, hand, t_s, rig.arc_length_m, solver=WORLD)[0]
    x = np.linspace(0.0, 1.0, 2001)[:-1]
    at_tip, inside = rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 0.7), rng.uniform(-0.3, 0.3)
    added = at_tip * (1.0 - x) + inside * np.clip(0.6 - x, 0.0, None)
    places = np.linalg.lstsq(mode_curvature(x, 6), added, rcond=None)[0]
    late_s = 0.004 * rng.normal()
    bent = [np.stack([places, 0.0 * places])]
    return simulate(model, hand, t_s, rig.arc_length_m, solver=WORLD, start="held",
                    release_s=release_s + late_s, bent=bent)[0]  # fmt: skip


def _erring(rng: np.random.Generator, rig: Rig, shape: tuple[int, ...]) -> np.ndarray:
    """(times, markers, 2) what the camera errs by, of rms 1."""
    if rig.updates == 1:
        return coloured(rng, shape, rig.colour)
    times = shape[0]
    updates = -(-times // rig.updates)
    sizes = coloured(rng, (updates, ERRING_SHAPES, 2), rig.colour)
    along = (rig.arc_length_m / rig.cable.free_length_m)[:, None] ** np.arange(1, ERRING_SHAPES + 1)
    along /= np.sqrt(np.mean(np.sum(along**2, axis=1)))
    smooth = np.einsum("tkc,mk->tmc", sizes, along)
    return np.repeat(smooth, rig.updates, axis=0)[:times] + 0.02 * rng.normal(size=shape)


def _logged(rng: np.random.Generator, rig: Rig, hand: Motion) -> Motion:
    if "glitches" not in rig.features:
        return logged(rng, hand, 1e-5)
    noisy = logged(rng, hand, 3e-5)
    wrong = [0, *rng.integers(1, len(hand.t_s), 4)]
    noisy.x_m[wrong] += rng.choice([-1.0, 1.0], 5) * rng.uniform(6e-5, 2e-4, 5)
    noisy.y_m[wrong] += rng.choice([-1.0, 1.0], 5) * rng.uniform(6e-5, 2e-4, 5)
    return noisy


@dataclass(frozen=True)
class RigOutcome(Outcome):
    """refused: why the study was not taken."""

    refused: str = ""

    @property
    def judged(self) -> str:
        """In a word or two."""
        if self.verdict == "complete":
            return "FALSE COMPLETE"
        if self.wrong:
            return "WRONG"
        if self.partly_wrong:
            return "partial, wrong name"
        if self.right:
            return "right"
        if self.partly_right:
            return "partial, right name"
        return "refused" if self.refused else "not named"


def one(seed: int) -> tuple[Rig, ActiveEffect, RigOutcome, float]:
    """A study's rig, what was hidden, what the lab said of it, and its seconds of CPU."""
    known = library()
    name = sorted(known)[seed % len(known)]
    rig = Rig.drawn(seed, name)
    effect, power = that_shows(rig, known[name], len(known))
    outcome, cpu_s = examined(rig, effect, power)
    return rig, effect, outcome, cpu_s


def examined(rig: Rig, effect: ActiveEffect, power: float) -> tuple[RigOutcome, float]:
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
    outcome = RigOutcome("one", (effect.effect.name,), power, found.verdict,
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
        quiet = PreparedStudy.of(rig_study(rig, active, quiet=True))
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
    given = parser.parse_args()
    return told(one(seed) for seed in range(given.first, given.first + given.studies))


def told(rigs: Iterable[tuple[Rig, ActiveEffect, RigOutcome, float]]) -> int:
    """Print a line for each rig, as soon as it is known, and the totals; 1 if a claim is wrong."""
    outcomes, times_s = [], []
    for rig, effect, outcome, cpu_s in rigs:
        outcomes.append(outcome)
        times_s.append(cpu_s)
        named = [" or ".join(sorted(n)) for n in outcome.named]
        named += [f"mostly {' or '.join(sorted(n))}" for n in outcome.partial]
        values = ", ".join(f"{v:.3g}" for v in effect.values)
        there = f"{effect.effect.name} {values}, power {outcome.power:.2f}"
        said = f"{outcome.verdict} {' + '.join(named)}{outcome.refused}; {outcome.judged}"
        print(f"{rig.seed:4d}  {rig.words}; {there}: {said}; {cpu_s:.0f} s", flush=True)
    _totals(outcomes, times_s)
    return 0 if not any(o.verdict == "complete" or o.wrong for o in outcomes) else 1


def _totals(outcomes: Sequence[RigOutcome], times_s: Sequence[float]) -> None:
    able = [o for o in outcomes if o.power >= 0.8]
    counts = {
        "false complete": [o.verdict == "complete" for o in outcomes],
        "wrong claim": [o.wrong for o in outcomes],
        "partial with a wrong name": [o.partly_wrong for o in outcomes],
        "right, of those that show": [o.right for o in able],
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
