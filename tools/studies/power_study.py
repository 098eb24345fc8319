"""Forecast and observed detection of effects hidden in copies of made studies.

    python -m tools.studies.power_study power.csv [--rounds 4] [--copies 10] [--case 6]

A case is an effect, its size and a set of motions.  Its study is made with a finer mesh, a random
cable and noise, without the effect.  `cell power` forecasts the probability that a diagnosis of a
study with the effect detects it.  Then copies with the effect are diagnosed.  Every round adds
copies to every case, and continues an existing file.  The size is a share of the smallest that is
detected with 95 % probability, so that the forecasts vary.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

from scipy.stats import binomtest

from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy
from cell.lab.next.effect_query import effect_queries
from cell.lab.next.linear_study import LinearStudy
from cell.lab.next.study_power import forecast, recover
from cell.lab.search.fit_cache import FitCache, SearchSetup
from cell.study.data import Study
from tools.studies.rows import added_rows, read_rows
from tools.worlds.made_studies import make_study

#: Trials of `made_studies.STROKES` by their numbers.
MOTIONS = {"down": (0, 1, 3), "left": (0, 2, 4), "raised": (1, 2, 5)}
#: Effect, share of the smallest size, motions.
CASES = (
    ("air_drag", 0.9, "down"),
    ("tip_mass", 0.85, "left"),
    ("natural_curvature", 0.8, "raised"),
    ("bending_hysteresis", 0.9, "left"),
    ("stress_relaxation", 0.8, "raised"),
    ("grip_compliance", 0.9, "down"),
    ("camera_latency", 0.75, "left"),
    ("robot_ringing", 1.0, "down"),
    ("draught", 0.7, "raised"),
    ("grip_slip", 1.1, "left"),
)


@dataclass(frozen=True)
class PowerCase:
    """A case of the power study and its result; noise in m."""

    case: int
    effect: str
    parameter: str
    size: float
    motions: str
    noise_m: float
    colour: float
    forecast: float
    copies: int = 0
    found: int = 0
    confused: int = 0
    undecided: int = 0
    missed: int = 0
    unexplained: int = 0
    seconds: float = 0.0

    @property
    def words(self) -> str:
        """Text of forecast and observation."""
        low, high = binomtest(self.found, self.copies).proportion_ci(method="wilson")
        share = self.found / max(self.copies, 1)
        return (
            f"{self.effect:20s} {self.size:10.3g}  {self.motions:7s} forecast {self.forecast:.2f}, "
            f"found {self.found} of {self.copies} = {share:.2f} ({low:.2f} … {high:.2f}); confused "
            f"{self.confused}, undecided {self.undecided}, missed {self.missed}, unexplained "
            f"{self.unexplained}"
        )


def study_of(case: int) -> Study:
    """The study of a case, without a hidden effect."""
    study = make_study(3100 + case)
    selected = tuple(study.trials[i] for i in MOTIONS[CASES[case][2]])
    return replace(study, trials=selected)


def updated_case(case: int, before: PowerCase | None, copies: int) -> PowerCase:
    """Results of a case with `copies` more copies of its study."""
    began = time.process_time()
    name, share, motions = CASES[case]
    (question,), selection = effect_queries([name], [])
    study = study_of(case)
    fits = FitCache.of(
        SearchSetup(PreparedStudy.of(study), ParameterSpace.of(study.cable), selection.candidates)
    )
    linear = LinearStudy.of(fits.prepared, fits.base.fit)
    if before is None:
        smallest = forecast(fits, question, linear).smallest
        if smallest is None:
            raise ValueError(f"{name}: no size is found; choose another study")
        size = question.parameter.default + share * (smallest - question.parameter.default)
    else:
        size = before.size
    chances = forecast(fits, replace(question, size=size), linear).chances
    assert chances is not None
    noise = fits.prepared.noise_model.noise
    row = before or PowerCase(
        case, name, question.parameter.name, size, motions, noise.std_m, noise.ar1, 0.0
    )
    recovered = recover(fits, question.at(size), copies, first=row.copies)
    return replace(
        row,
        forecast=chances.found,
        copies=row.copies + len(recovered.outcomes),
        found=row.found + recovered.count("found"),
        confused=row.confused + recovered.count("confused"),
        undecided=row.undecided + recovered.count("undecided", "failed"),
        missed=row.missed + recovered.count("missed"),
        unexplained=row.unexplained + recovered.count("unexplained"),
        seconds=row.seconds + time.process_time() - began,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--copies", type=int, default=10)
    parser.add_argument("--case", type=int, nargs="*", default=range(len(CASES)))
    options = parser.parse_args()
    rows = {row.case: row for row in read_rows(options.file, PowerCase)}
    for case in [*options.case] * options.rounds:
        rows[case] = updated_case(case, rows.get(case), options.copies)
        options.file.unlink(missing_ok=True)
        list(added_rows(options.file, PowerCase, (rows[k] for k in sorted(rows))))
        print(rows[case].words, flush=True)
    count = sum(r.copies for r in rows.values())
    expected = sum(r.forecast * r.copies for r in rows.values()) / max(count, 1)
    detections = sum(r.found for r in rows.values()) / max(count, 1)
    print(f"\nall {count}: forecast {expected:.3f}, found {detections:.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
