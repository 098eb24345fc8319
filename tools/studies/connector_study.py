"""What the lab says of made studies of cables with a connector, each with one effect hidden.

    python -m tools.studies.connector_study [--studies 20] [--first 0]

A connector has 0.2 to 3 times the mass of its cable, 5 to 30 % of its length, and up to 1.5 times
the inertia of a rod.  The study states it, and markers are on it too.  The hidden effect is as
strong as is typical, or so strong that a test which knows the truth shows it, as in `rig_study.py`.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace

import numpy as np

from cell.cable.effects import ActiveEffect, library
from cell.cable.geometry import Connector, node_arc_lengths
from tools.studies.rig_study import Rig, RigOutcome, examined, that_shows, told
from tools.worlds.made_studies import CABLE, FRAME_S


def drawn(seed: int) -> Rig:
    """A rig without other features whose cable has a connector."""
    rng = np.random.default_rng([seed, 41])
    mass_kg = CABLE.line_density_kg_per_m * CABLE.free_length_m * rng.uniform(0.2, 3.0)
    rod = Connector.rod(float(mass_kg), float(CABLE.free_length_m * rng.uniform(0.05, 0.3)))
    connector = replace(rod, inertia_kg_m2=rod.inertia_kg_m2 * float(rng.uniform(1.0, 1.5)))
    cable = replace(CABLE, connector=connector)
    noise_m = float(np.exp(rng.uniform(np.log(5e-5), np.log(3e-4))))
    return Rig(seed, ("connector",), cable, node_arc_lengths(cable.length_m), FRAME_S, 0.0, noise_m,
               float(rng.uniform(0.0, 0.6)), 1, None, "at rest", (), ())  # fmt: skip


def one(seed: int) -> tuple[Rig, ActiveEffect, RigOutcome, float]:
    """A study's rig, what was hidden, what the lab said of it, and its seconds of CPU."""
    known = library()
    rig = drawn(seed)
    effect, power = that_shows(rig, known[sorted(known)[seed % len(known)]], len(known))
    return rig, effect, *examined(rig, effect, power)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    return told(one(seed) for seed in range(given.first, given.first + given.studies))


if __name__ == "__main__":
    sys.exit(main())
