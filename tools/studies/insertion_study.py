"""Rate of insertions by opening, by options of the decision, and by disturbances in flight.

    python -m tools.studies.insertion_study FILE.csv [--cables 20] [--half-mm 5 2 1 …]
                                            [--worlds complete soft "air_drag x2" …]
                                            [--ways offsets moment pace feedback short_hold]

Cells without pictures; each way has the same cables with the same noise:

    offsets     21 offsets, executed at once
    moment      any offset and moment within 0.25 s
    pace        and slower motions
    feedback    and the path corrected in flight
    short_hold  21 offsets; the hold ends when more frames do not change the decision

A world is an effect that the model lacks, with a multiple of its typical size, or one of `complete`
(none), `soft` cables, and disturbances in flight: `knock_up`, `knock_back`, `late_knock`,
`late_frames`, `lost_frames`, `puff` (a gust).
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from cell.cable.effects.library import library
from cell.cable.model import CableModel
from cell.plan.choose import Freedom
from cell.settings import Settings, load_settings
from cell.wiring.build import cell_task
from cell.wiring.twins import hidden_cable
from tools.shipped_settings import FAKE
from tools.studies.rows import added_rows
from tools.worlds.fast_cell import fast_cycle, typical, with_opening, with_world
from tools.worlds.fast_flight import Flown
from tools.worlds.fast_truth import true_hold
from tools.worlds.outside_laws import Puff

PACES = (1.15, 1.3, 1.5, 1.8)
WAYS = {
    "offsets": Freedom(),
    "moment": Freedom(0.25),
    "pace": Freedom(0.25, PACES),
    "feedback": Freedom(0.25, PACES),
    "short_hold": Freedom(),
}
#: Least duration of a hold with an early end, s.
LEAST_HOLD_S = 0.4
NOTHING = Flown()
EVENTS = {
    "complete": NOTHING,
    "soft": NOTHING,
    "knock_up": Flown(knock=(0.5, 0.0, 0.002)),
    "knock_back": Flown(knock=(0.5, 0.002, 0.0)),
    "late_knock": Flown(knock=(0.7, 0.0, -0.002)),
    "late_frames": Flown(latency_s=0.01),
    "lost_frames": Flown(lost=0.03),
    "puff": NOTHING,
}
EFFECTS = tuple(f"{name} x{size}" for name in library() for size in (1, 2))
#: A gust of 0.7 m/s, and its beginning after the path was commanded, s.
PUFF_S, PUFF = 0.4, {"wind_x_m_per_s": 0.5, "wind_y_m_per_s": 0.5}


@dataclass(frozen=True)
class InsertedCable:
    """Result of one simulated insertion.

    error_mm  true error of the forecast in the opening; `miss_mm` of the tip from its middle
    saved_s   by an early end of the hold
    """

    world: str
    half_mm: float
    way: str
    cable: int
    outcome: str
    probability: float
    true_margin_mm: float
    miss_mm: float
    error_mm: float
    corrections: int
    saved_s: float


def settings_of(settings: Settings, world: str) -> Settings:
    """The settings with the physics of a world."""
    if world == "soft":
        low, high = settings.world.rigidity_n_m2
        soft = settings.world.model_copy(update={"rigidity_n_m2": (0.5 * low, 0.5 * high)})
        return settings.model_copy(update={"world": soft})
    if world in EVENTS:
        return settings
    name, size = world.split(" x")
    return with_world(settings, {name: typical(library()[name], float(size))})


def hidden_in(settings: Settings, world: str, seed: int, cable: int) -> CableModel:
    """The `cable`-th hidden cable of a world."""
    hidden = hidden_cable(settings, seed, cable)
    if world != "puff":
        return hidden
    task = cell_task(settings)
    hold_ends_s = float(true_hold(task, settings.arm.lag_s).t_s[-1])
    puff = Puff.active(**PUFF, begin_s=hold_ends_s + task.decide_s + PUFF_S)
    return replace(hidden, effects=(*hidden.effects, puff))


def tried(
    settings: Settings, world: str, half_mm: float, way: str, seed: int, cable: int
) -> InsertedCable:
    """Simulate the cycle of one cable, and return its outcome."""
    there = settings_of(with_opening(settings, half_mm), world)
    task = cell_task(there)
    least_s = LEAST_HOLD_S if way == "short_hold" else None
    choice = replace(task.choice, freely=WAYS[way])
    cycle = fast_cycle(
        there,
        seed,
        cable,
        task=replace(task, choice=choice, least_hold_s=least_s),
        hidden=hidden_in(there, world, seed, cable),
        only_chosen=True,
        flown=replace(EVENTS.get(world, NOTHING), feedback=way == "feedback"),
    )
    return InsertedCable(
        world,
        half_mm,
        way,
        cable,
        cycle.outcome,
        0.0 if cycle.choice is None else cycle.choice.best.probability,
        1e3 * cycle.true_margin_m,
        1e3 * cycle.true_miss_m,
        1e3 * cycle.true_tip_error_m,
        len(cycle.tails),
        cycle.hold_saved_s,
    )


def table(rows: list[InsertedCable]) -> str:
    """Table of outcomes, of stated and true share of insertions, and of the tip's miss."""
    lines = [
        f"{'world':22}{'± mm':>6} {'way':11}{'inserted':>14}{'95 %':>12}{'missed':>7}"
        f"{'stated':>8}{'passed':>8}{'miss rms':>9}{'error rms':>10}{'saved s':>8}"
    ]
    by_way = pd.DataFrame(rows).groupby(["world", "half_mm", "way"], sort=False)
    for (world, half_mm, way), those in by_way:
        count = Counter(those["outcome"])
        sure = stats.binomtest(count["inserted"], len(those)).proportion_ci()
        done = those[those["outcome"] != "rejected"]
        passed = done["true_margin_mm"] > 0.0
        miss, error = np.sqrt((done[["miss_mm", "error_mm"]] ** 2).mean())
        lines.append(
            f"{world:22}{half_mm:>6g} {way:11}{count['inserted']:>5} of {len(those):<5}"
            f"{sure.low:>6.0%}–{sure.high:<5.0%}{count['missed'] + count['stopped']:>7}"
            f"{100.0 * done['probability'].mean():>7.1f}%{100.0 * passed.mean():>7.1f}%"
            f"{miss:>9.2f}{error:>10.3f}{those['saved_s'].mean():>8.2f}"
        )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("file", type=Path, help="CSV file to write")
    parser.add_argument("--cables", type=int, default=20)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--config", type=Path, default=FAKE)
    parser.add_argument("--half-mm", type=float, nargs="+", default=[5.0, 2.0, 1.0])
    worlds = (*EVENTS, *EFFECTS)
    parser.add_argument("--worlds", nargs="+", choices=worlds, default=["complete"])
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    options = parser.parse_args()
    settings = load_settings(options.config)
    options.file.unlink(missing_ok=True)
    for world in options.worlds:
        each = product(options.half_mm, range(1, options.cables + 1), options.ways)
        made = (tried(settings, world, h, way, options.seed, cable) for h, cable, way in each)
        print(table(list(added_rows(options.file, InsertedCable, made))), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
