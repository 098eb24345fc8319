"""How often cables are inserted through mouths of different heights: by offsets, freely, corrected.

Cells without pictures, whose model is complete: only the choice differs.

    python -m tools.studies.mouth_study mouths.csv --cables 200 [--config config/fake.yaml]
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from cell.plan.choose import Freedom
from cell.settings import Settings, load_settings
from cell.wiring.build import cell_task
from tools.studies.cable_rows import options, written
from tools.worlds.fast_cell import fast_cycle
from tools.worlds.fast_flight import Flown

HALF_MM = (5.0, 2.0, 1.0, 0.5, 0.25)
FREELY = {
    "offsets": Freedom(),
    "and moment": Freedom(0.25),
    "and pace": Freedom(0.25, (1.15, 1.3, 1.5, 1.8)),
}
#: The last of these, and corrected in flight.
FEEDBACK = "and feedback"
FREELY[FEEDBACK] = FREELY["and pace"]


@dataclass(frozen=True)
class Tried:
    """One cable.

    half_mm      of the mouth's height
    freely       what may be chosen
    extra_s      how much later than at once the hand has arrived
    error_mm     largest error of the forecast in the mouth, in truth
    """

    half_mm: float
    freely: str
    cable: int
    outcome: str
    probability: float
    margin_mm: float
    true_margin_mm: float
    error_mm: float
    extra_s: float


def with_mouth(settings: Settings, half_mm: float) -> Settings:
    """The settings with a mouth of so many mm on either side of its middle."""
    middle_m = float(np.mean(settings.destination.y_m))
    height = (middle_m - half_mm * 1e-3, middle_m + half_mm * 1e-3)
    destination = settings.destination.model_copy(update={"y_m": height})
    return settings.model_copy(update={"destination": destination})


def tried(settings: Settings, half_mm: float, freely: str, seed: int, cable: int) -> Tried:
    """What becomes of one cable."""
    narrow = with_mouth(settings, half_mm)
    task = cell_task(narrow)
    task = replace(task, choice=replace(task.choice, freely=FREELY[freely]))
    flown = Flown(feedback=freely == FEEDBACK)
    cycle = fast_cycle(narrow, seed, cable, task=task, only_chosen=True, flown=flown)
    best, coming = None if cycle.choice is None else cycle.choice.best, cycle.candidates
    if best is None or cycle.choice is None or coming is None:
        nan = float("nan")
        return Tried(half_mm, freely, cable, cycle.outcome, 0.0, nan, nan, nan, nan)
    path = coming.paths[cycle.choice.table.index(best)]
    same = int(np.argmin(np.abs(coming.forecast.offsets_m[: len(task.offsets_m)] - best.offset_m)))
    return Tried(
        half_mm,
        freely,
        cable,
        cycle.outcome,
        best.probability,
        1e3 * best.margin_m,
        1e3 * cycle.true_margin_m,
        1e3 * cycle.true_tip_error_m,
        float(path.t_s[-1] - coming.paths[same].t_s[-1]),
    )


def table(rows: list[Tried]) -> str:
    """Shares of cables inserted, in %, by the mouth's height."""
    lines = ["mouth, ± mm  " + "".join(f"{name:>14}" for name in FREELY)]
    for half_mm in sorted({r.half_mm for r in rows}, reverse=True):
        cells = []
        for name in FREELY:
            counts = Counter(r.outcome for r in rows if (r.half_mm, r.freely) == (half_mm, name))
            total = sum(counts.values())
            share = f"{100 * counts['inserted'] / total:.1f}" if total else ""
            cells.append(f"{share + ('*' if counts['missed'] else ''):>14}")
        lines.append(f"{half_mm:>11g}  " + "".join(cells))
    missed = sum(r.outcome == "missed" for r in rows)
    return "\n".join([*lines, f"{missed} of {len(rows)} missed (*); all others were put aside"])


def main() -> None:
    parser = options(__doc__, 200)
    parser.add_argument("--half-mm", type=float, nargs="+", default=HALF_MM)
    parser.add_argument("--freely", nargs="+", choices=FREELY, default=list(FREELY))
    given = parser.parse_args()
    settings, rows = load_settings(given.config), []
    with written(given.file, Tried) as write:
        for half_mm in given.half_mm:
            for cable in range(1, given.cables + 1):
                for freely in given.freely:
                    rows.append(tried(settings, half_mm, freely, given.seed, cable))
                    write(rows[-1:])
            print(table([r for r in rows if r.half_mm == half_mm]), flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
