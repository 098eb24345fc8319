"""Whether a hold that ends early costs insertions, or makes the stated probabilities wrong.

Cells without pictures; the same cables held for the longest time, and as long as needed.

    python -m tools.studies.hold_study holds.csv --cables 200 [--config config/fake.yaml]
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.effects.library import library
from cell.plan.choose import Freedom
from cell.run.station import Task
from cell.settings import Settings, load_settings
from cell.wiring.build import cell_task
from tools.studies.cable_rows import options, written
from tools.studies.mouth_study import with_mouth
from tools.worlds.fast_cell import fast_cycle, typical, with_world

#: Half the mouth's height, mm, what may be chosen freely, and the effect that the model lacks.
WORLDS: dict[str, tuple[float, Freedom, str | None]] = {
    "as it is": (5.0, Freedom(), None),
    "narrow mouth": (2.0, Freedom(), None),
    "freely": (1.0, Freedom(0.25, (1.15, 1.3, 1.5, 1.8)), None),
    "unknown drag": (5.0, Freedom(), "air_drag"),
    "unknown drag, narrow": (2.0, Freedom(), "air_drag"),
}
LEAST_S = {"fixed": None, "as needed": 0.4}


@dataclass(frozen=True)
class Tried:
    """One cable.

    true_error_mm   of the forecast in the mouth
    """

    world: str
    hold: str
    cable: int
    outcome: str
    probability: float
    saved_s: float
    true_margin_mm: float
    true_error_mm: float


def tried(settings: Settings, task: Task, world: str, hold: str, seed: int, cable: int) -> Tried:
    """What becomes of one cable."""
    task = replace(task, least_hold_s=LEAST_S[hold])
    cycle = fast_cycle(settings, seed, cable, task=task, only_chosen=True)
    return Tried(
        world,
        hold,
        cable,
        cycle.outcome,
        0.0 if cycle.choice is None else cycle.choice.best.probability,
        cycle.hold_saved_s,
        1e3 * cycle.true_margin_m,
        1e3 * cycle.true_tip_error_m,
    )


def table(rows: list[Tried]) -> str:
    """What became of the cables, what was stated of those executed, and the time saved."""
    lines = [
        f"{'world':22}{'hold':11}{'inserted':>9}{'missed':>8}{'rejected':>9}"
        f"{'stated':>8}{'passed':>8}{'error mm':>10}{'saved s':>9}"
    ]
    for world, hold in dict.fromkeys((r.world, r.hold) for r in rows):
        those = [r for r in rows if (r.world, r.hold) == (world, hold)]
        counts = Counter(r.outcome for r in those)
        done = [r for r in those if r.outcome != "rejected"]
        stated = 100.0 * float(np.mean([r.probability for r in done] or [np.nan]))
        passed = 100.0 * float(np.mean([r.true_margin_mm > 0.0 for r in done] or [np.nan]))
        error = float(np.median([r.true_error_mm for r in done] or [np.nan]))
        lines.append(
            f"{world:22}{hold:11}{counts['inserted']:>9}{counts['missed']:>8}"
            f"{counts['rejected']:>9}{stated:>7.1f}%{passed:>7.1f}%{error:>10.3f}"
            f"{np.mean([r.saved_s for r in those]):>9.2f}"
        )
    return "\n".join(lines)


def main() -> None:
    parser = options(__doc__, 200)
    parser.add_argument("--worlds", nargs="+", choices=WORLDS, default=list(WORLDS))
    given = parser.parse_args()
    settings, rows = load_settings(given.config), []
    with written(given.file, Tried) as write:
        for world in given.worlds:
            half_mm, freely, effect = WORLDS[world]
            there = with_mouth(settings, half_mm)
            if effect is not None:
                there = with_world(there, {effect: typical(library()[effect], 1.0)})
            task = cell_task(there)
            task = replace(task, choice=replace(task.choice, freely=freely))
            for cable in range(1, given.cables + 1):
                for hold in LEAST_S:
                    rows.append(tried(there, task, world, hold, given.seed, cable))
                    write(rows[-1:])
            print(table([r for r in rows if r.world == world]), flush=True)


if __name__ == "__main__":
    main()
