"""What the lab says of made studies whose hand moves in a level plane, with a load at the tip.

    python -m tools.studies.level_study [--studies 6] [--first 0] [--folder FOLDER]

Gravity in the plane is 0 in every other study, and 0.05 m/s² in the others, as of a table that is
a little off level.  The load has known grams.  A study is right if the lab names a load, and its
95 % interval contains these grams.  The mesh is finer than the model's, EI(s) of another family.
`--folder` keeps the studies.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from cell.cable.dynamics import simulate
from cell.cable.effects import library
from cell.cable.geometry import node_arc_lengths
from cell.lab.data.named_effects import select_for_diagnosis
from cell.lab.data.opened_study import open_study
from cell.lab.search.setup import fit_cache_of
from cell.lab.verdict.diagnose import diagnose
from cell.study.data import Markers, Study, Trial
from cell.study.folder import write_study
from tools.worlds.made_studies import CABLE, FRAME_S, WORLD, coloured, logged, random_model, stroke

NAME, PARAMETER = "tip_mass", "mass_kg"
GRAVITIES = ((0.0, 0.0), (0.0, -0.05))
#: name, role, clamp angle, way (x, y), seconds: across the cable, for along it nothing bends
STROKES = (
    ("out", "fit", 0.0, (0.0, -0.05), 0.25),
    ("back", "fit", 0.0, (0.0, 0.04), 0.30),
    ("aslant", "fit", 0.4, (-0.04, -0.04), 0.30),
    ("far", "validate", 0.0, (0.0, -0.07), 0.35),
    ("turned", "validate", -0.5, (-0.03, 0.05), 0.28),
)


@dataclass(frozen=True)
class Row:
    """A study and what was said of it; masses in g."""

    number: int
    gravity_m_per_s2: float
    mass_g: float
    verdict: str
    named: str
    low_g: float
    high_g: float
    seconds: float

    @property
    def right(self) -> bool:
        """Whether a load is named, with an interval that contains its mass."""
        return NAME in self.named and self.low_g <= self.mass_g <= self.high_g


def level_study(seed: int) -> tuple[Study, float]:
    """A study in a level plane, and the load's mass, kg."""
    rng = np.random.default_rng([seed, 31])
    mass_kg = float(rng.uniform(0.3, 2.0)) * CABLE.line_density_kg_per_m * CABLE.free_length_m
    gravity = GRAVITIES[seed % len(GRAVITIES)]
    load = library()[NAME].active(**{PARAMETER: mass_kg})
    model = replace(random_model(rng, CABLE, [load]), gravity_m_per_s2=gravity)
    noise_m, colour = float(np.exp(rng.uniform(np.log(5e-5), np.log(3e-4)))), rng.uniform(0.0, 0.6)
    arcs, trials = node_arc_lengths(CABLE.free_length_m), []
    for name, role, angle, way, seconds in STROKES:
        hand = stroke(angle, way, seconds, after_s=1.5)
        t_s = np.arange(rng.uniform(0.0, FRAME_S), hand.t_s[-1], FRAME_S)
        clean = simulate(model, hand, t_s, arcs, solver=WORLD)[0]
        seen = clean + noise_m * coloured(rng, clean.shape, colour)
        trials.append(Trial(name, "fit" if role == "fit" else "validate", "equilibrium",
                            logged(rng, hand, 1e-5), Markers(t_s, seen)))  # fmt: skip
    return Study(f"level_{seed}", CABLE, arcs, tuple(trials), gravity), mass_kg


def one(number: int, folder: Path) -> Row:
    """A study, written and read as anybody's, and what the lab says of it."""
    study, mass_kg = level_study(number)
    write_study(study, folder)
    began = time.process_time()
    found = diagnose(fit_cache_of(open_study(folder), select_for_diagnosis([], []))).diagnosis
    named = [" or ".join((m.effect, *m.tied_with)) for m in found.missing]
    intervals = [m.parameters[PARAMETER] for m in found.missing if m.effect == NAME]
    low, high = (intervals[0].low, intervals[0].high) if intervals else (np.nan, np.nan)
    return Row(
        number,
        study.gravity_m_per_s2[1],
        1e3 * mass_kg,
        found.verdict,
        " + ".join(named),
        1e3 * low,
        1e3 * high,
        time.process_time() - began,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=6)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args(arguments)
    rows = []
    for number in range(given.first, given.first + given.studies):
        with TemporaryDirectory() as folder:
            rows.append(one(number, Path(folder) if given.folder is None
                            else given.folder / str(number)))  # fmt: skip
        r = rows[-1]
        print(
            f"{r.number:3d}  g {r.gravity_m_per_s2:5.2f}  {r.mass_g:.3f} g: {r.verdict} "
            f"{r.named} {r.low_g:.3f} … {r.high_g:.3f} g  {r.seconds:.0f} s",
            flush=True,
        )
    right = sum(r.right for r in rows)
    print(f"right: {right} of {len(rows)}")
    return 0 if right == len(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
