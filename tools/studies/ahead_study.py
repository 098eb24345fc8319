"""How well the tip is known 60 ms ahead in flight, by two estimators.

Cells without pictures.  At every decision the tip is predicted from the frames so far: by all of
them, which is the answer of a Kalman filter on the same linear model; by those of the last moments
alone (moving horizon); and as planned.  The truth is simulated by the finer world.

    python -m tools.studies.ahead_study ahead.csv --cables 100 [--worlds complete …]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from cell.cable.dynamics import simulate
from cell.flight.estimate import Deviation, deviation
from cell.settings import Settings, load_settings
from cell.wiring.build import cell_task
from tools.studies.cable_rows import options, written
from tools.studies.flight_study import EVENTS, NOTHING, hidden_in, settings_of, worlds
from tools.studies.mouth_study import with_mouth
from tools.worlds.fast_cell import fast_cycle
from tools.worlds.fast_flight import Look
from tools.worlds.fast_truth import WORLD

FloatArray = NDArray[np.float64]

#: So far after the last frame, s.
AHEAD_S = 0.06
#: Frames that the moving horizon uses, s.
HORIZONS_S = (0.1, 0.2)


@dataclass(frozen=True)
class Ahead:
    """One prediction: error in mm, and whether the truth is within the 95 % ellipse."""

    world: str
    cable: int
    decision: int
    estimator: str
    error_mm: float
    covered: bool


def predictions(look: Look) -> dict[str, Deviation | None]:
    """By the estimator's name; None = as planned."""
    seen = np.isfinite(look.nodes_m[:, 0, 0])
    t_s, nodes_m = look.t_s[seen], look.nodes_m[seen]
    flight = look.flight
    found: dict[str, Deviation | None] = {
        "planned": None,
        "all frames": deviation(flight.answers, t_s, nodes_m, flight.noise_m),
    }
    for horizon_s in HORIZONS_S:
        new = t_s > t_s[-1] - horizon_s
        near = deviation(flight.answers, t_s[new], nodes_m[new], flight.noise_m)
        found[f"last {horizon_s:g} s"] = near
    return found


def covered(tips_m: FloatArray, truth_m: FloatArray) -> bool:
    """Whether a point is within the 95 % ellipse of (samples, 2) draws of a normal law."""
    n = len(tips_m)
    away = truth_m - tips_m.mean(axis=0)
    square = float(away @ np.linalg.solve(np.cov(tips_m.T), away))
    return square <= 2.0 * (n - 1) / (n - 2) * (1.0 + 1.0 / n) * stats.f.ppf(0.95, 2, n - 2)


def tried(settings: Settings, world: str, seed: int, cable: int) -> list[Ahead]:
    """All predictions for one cable; none if it is not executed."""
    there = settings_of(settings, world)
    task, hidden = cell_task(there), hidden_in(there, world, seed, cable)
    flown = EVENTS.get(world, NOTHING).seeing
    cycle = fast_cycle(there, seed, cable, task=task, hidden=hidden, only_chosen=True, flown=flown)
    found = []
    for number, look in enumerate(cycle.looks):
        assert cycle.candidates is not None
        at_s = look.t_s[-1] + AHEAD_S
        tip = np.array([task.cable.free_length_m])
        when = np.array([cycle.candidates.start_s + at_s])
        truth_m = simulate(hidden, look.motion, when, tip, solver=WORLD)[0, 0, 0]
        answers = look.flight.answers
        planned_m = _at(answers.t_s, answers.nodes_m[:, 0], at_s)
        for name, beside in predictions(look).items():
            tip_m, within = planned_m, False
            if beside is not None:
                tip_m = planned_m + _at(answers.t_s, beside.tip_m, at_s)
                drawn = [planned_m + _at(answers.t_s, tips, at_s) for tips in beside.tips_m]
                within = covered(np.array(drawn), truth_m)
            error_mm = 1e3 * float(np.linalg.norm(tip_m - truth_m))
            found.append(Ahead(world, cable, number, name, error_mm, within))
    return found


def _at(t_s: FloatArray, values: FloatArray, when_s: float) -> FloatArray:
    return np.array([np.interp(when_s, t_s, values[:, axis]) for axis in (0, 1)])


def table(rows: list[Ahead]) -> str:
    """Per world and estimator: rms error and coverage."""
    lines = [f"{'world':22}{'estimator':14}{'predictions':>12}{'rms mm':>9}{'95 % ellipse':>14}"]
    for world in dict.fromkeys(r.world for r in rows):
        for name in dict.fromkeys(r.estimator for r in rows):
            those = [r for r in rows if r.world == world and r.estimator == name]
            rms = np.sqrt(np.mean([r.error_mm**2 for r in those]))
            share = "" if name == "planned" else f"{np.mean([r.covered for r in those]):.1%}"
            lines.append(f"{world:22}{name:14}{len(those):>12}{rms:>9.3f}{share:>14}")
    return "\n".join(lines)


def main() -> None:
    parser = options(__doc__, 100)
    parser.add_argument("--half-mm", type=float, default=5.0)
    parser.add_argument("--worlds", nargs="+", choices=worlds(), default=["complete"])
    given = parser.parse_args()
    settings = with_mouth(load_settings(given.config), given.half_mm)
    rows: list[Ahead] = []
    with written(given.file, Ahead) as write:
        for world in given.worlds:
            for cable in range(1, given.cables + 1):
                new = tried(settings, world, given.seed, cable)
                write(new)
                rows += new
            print(table([r for r in rows if r.world == world]), flush=True)


if __name__ == "__main__":
    main()
