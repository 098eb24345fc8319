"""How often the lab claims an effect where none is: complete studies, AR(1) noise of 0 … 0.9.

python tools/false_alarm_study.py [--studies 200] [--first 0]
"""

from __future__ import annotations

import argparse
import sys

from made_studies import make_study
from scipy import stats

from cell.cable.effects import library
from cell.identify.parameters import ParameterSpace
from cell.lab.diagnose import diagnose
from cell.lab.explore import Explorer
from cell.lab.prepared import PreparedStudy


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    verdicts: dict[str, int] = {}
    for seed in range(given.first, given.first + given.studies):
        study = make_study(seed)
        prepared = PreparedStudy.of(study)
        found = diagnose(Explorer(prepared, ParameterSpace.of(study.cable), library())).diagnosis
        verdicts[found.verdict] = verdicts.get(found.verdict, 0) + 1
        named = ", ".join(f.effect for f in found.missing)
        noise = prepared.floor.noise
        print(f"{seed:4d}  noise {noise.std_m * 1e3:.3f} mm, AR {noise.colour:.2f}  "
              f"{found.verdict} {named}", flush=True)  # fmt: skip
    false = given.studies - verdicts.get("complete", 0)
    high = stats.beta.ppf(0.975, false + 1, given.studies - false)
    print(f"\n{verdicts}\nfalse claims: {false} of {given.studies} = {false / given.studies:.1%} "
          f"(95 %: up to {high:.1%})")  # fmt: skip
    return 0 if false <= 0.05 * given.studies else 1


if __name__ == "__main__":
    sys.exit(main())
