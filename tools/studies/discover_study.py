"""Does `cell discover` find the law of a study, where the library has no such effect?

    python -m tools.studies.discover_study [LAW …] [--seed 1] [--size 1.5]

For each of the ten laws of `tools/worlds/outside_laws.py` a study is made and its law inferred.  A
row lists the detected terms, and the error before and after, over the noise.  Ends with 1 if fewer
than eight have the right family, or one of their errors stays above 1.3 times the noise.
`unknown_a` of the practice studies is a magnet in another simulator.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from cell.cable.effects import library
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy
from cell.lab.next.discover import NothingFoundError, discover
from cell.lab.search.baseline import SearchSetup
from cell.lab.search.fit_cache import FitCache
from cell.study.data import Study
from tools.worlds.made_studies import hidden, make_study
from tools.worlds.outside_laws import LATER, LAWS

#: The first parameter of the term of which a law is a special case; a shaking table has none.
FAMILY = {
    "magnet": "pull",
    "cubic_drag": "power_drag",
    "drag_along_the_cable": "drag_along",
    "stiffening": "stiffer",
    "thick_viscosity": "power_viscosity",
    "tether": "spring_x",
    "lift": "path_lift",
    "wind_with_height": "wind_drag",
    "sudden_stiffness": "power_viscosity",
}
LEAST_RIGHT, MOST_OVER_NOISE = 8, 1.3
NOISE_M = 1e-4


def fits_of(study: Study) -> FitCache:
    """The fits of a study."""
    return FitCache.of(
        SearchSetup(PreparedStudy.of(study), ParameterSpace.of(study.cable), library())
    )


def is_right(name: str, seed: int, size: float) -> bool:
    """Whether `discover` finds the law hidden in a study; prints its row."""
    fits = fits_of(make_study(seed, [hidden(LAWS[name], size)], noise_m=NOISE_M))
    began_s = time.process_time()
    try:
        law = discover(fits, Path("discovered.py"))
    except NothingFoundError as error:
        print(f"{name:22s} nothing: {error}", flush=True)
        return False
    over = law.after_m / law.noise_m
    of_family = FAMILY.get(name) in law.parameters
    print(
        f"{name:22s} {'right' if of_family else 'WRONG'} {law.before_m / law.noise_m:7.2f} → "
        f"{over:5.3f} × noise  {'; '.join(law.laws)}  {time.process_time() - began_s:.0f} s",
        flush=True,
    )
    return of_family and over <= MOST_OVER_NOISE


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("laws", nargs="*", choices=[[], *LAWS], help="default: the ten")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--size", type=float, default=1.5, help="of the usual strength")
    options = parser.parse_args()
    laws = options.laws or [name for name in LAWS if name not in LATER]
    right = sum(is_right(name, options.seed, options.size) for name in laws)
    print(f"right: {right} of {len(laws)}")
    return 0 if right >= min(LEAST_RIGHT, len(laws)) else 1


if __name__ == "__main__":
    sys.exit(main())
