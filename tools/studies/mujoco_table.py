"""Which effect the lab finds in studies that MuJoCo made, one line each.

python -m tools.studies.mujoco_table [CASE …] [--seeds 3] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import sys
import time
from itertools import permutations
from pathlib import Path

import numpy as np

from cell.lab.data.named_effects import select_effects
from cell.lab.data.opened_study import open_study
from cell.lab.search.setup import fit_cache_of
from cell.lab.verdict.diagnose import diagnose
from tools.worlds.mujoco_studies import CASES, specimen, write_study

#: What should be named, and how the verdict may read, where the case is not one effect's name.
OUTSIDE: dict[str, tuple[str, ...]] = {
    "none": (),
    "draught": ("air_drag", "draught"),
    "dry_friction": ("bending_hysteresis",),
    "mid_mass": (),
}
EXPECTED: dict[str, tuple[str, ...]] = {"none": ("complete",), "mid_mass": ("unexplained",)}


def matches(truth: tuple[str, ...], named: list[set[str]]) -> bool:
    """Whether each true effect is in a class of its own and nothing else is named."""
    return len(truth) == len(named) and any(
        all(t in n for t, n in zip(order, named, strict=True)) for order in permutations(truth)
    )


def main() -> int:
    """Print what the lab finds in each case; the exit code tells whether all were right."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", help=f"of {', '.join(CASES)}; all if none")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("mujoco_studies"))
    given = parser.parse_args()
    wrong = 0
    for case in given.cases or CASES:
        for seed in range(given.first, given.first + given.seeds):
            folder = given.out / f"{case}_{seed}"
            rng = np.random.default_rng([seed, 5])
            noise_m, colour = float(rng.uniform(5e-5, 2e-4)), float(rng.uniform(0.0, 0.6))
            cable = specimen(seed, CASES[case])
            write_study(folder, cable, seed=seed, noise_m=noise_m, colour=colour)
            begin_s = time.perf_counter()
            found = diagnose(fit_cache_of(open_study(folder), select_effects([]))).diagnosis
            took_s = time.perf_counter() - begin_s
            last = found.missing[-1].errors if found.missing else found.baseline
            named = " + ".join("|".join((f.effect, *f.tied_with)) for f in found.missing)
            right = found.verdict in EXPECTED.get(case, ("missing",)) and matches(
                OUTSIDE.get(case, (case,)), [{f.effect, *f.tied_with} for f in found.missing]
            )
            wrong += not right
            values = ", ".join(
                f"{n} {p.value:.4g} ({p.low:.4g} … {p.high:.4g})"
                for f in found.missing
                for n, p in f.parameters.items()
            )
            print(
                f"{'ok   ' if right else 'WRONG'} {case:18s} {seed:2d}  {found.verdict:11s} "
                f"{named or '–':45s} held out/noise {found.baseline.heldout_rms_m / noise_m:.3f} → "
                f"{last.heldout_rms_m / noise_m:.3f}  noise {noise_m * 1e3:.3f} mm AR {colour:.2f}"
                f"  {took_s:.0f} s  {values}",
                flush=True,
            )
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
