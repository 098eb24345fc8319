"""How often cables are inserted when a path is corrected in flight, and when it is not.

Cells without pictures, each cable twice with the same noise: its path as chosen, and corrected.

    python -m tools.studies.flight_study flights.csv --cables 20 [--half-mm 5] [--worlds NAME …]
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.effects.library import library
from cell.cable.model import CableModel
from cell.plan.choose import Freedom
from cell.settings import Settings, load_settings
from cell.simulated.hidden import hidden_cable
from cell.wiring.build import cell_task
from tools.studies.cable_rows import options, written
from tools.studies.mouth_study import with_mouth
from tools.worlds.fast_cell import fast_cycle, typical, with_world
from tools.worlds.fast_flight import Flown
from tools.worlds.fast_truth import true_hold
from tools.worlds.puff import Puff

NOTHING = Flown()
#: What happens in flight.
EVENTS = {
    "complete": NOTHING,
    "soft": NOTHING,
    "knock up": Flown(knock=(0.5, 0.0, 0.002)),
    "knock back": Flown(knock=(0.5, 0.002, 0.0)),
    "late knock": Flown(knock=(0.7, 0.0, -0.002)),
    "late frames": Flown(latency_s=0.01),
    "lost frames": Flown(lost=0.03),
    "puff": NOTHING,
}
#: A draught of 0.7 m/s that begins so long after the hand was told to move, s.
PUFF_S, PUFF = 0.4, {"wind_x_m_per_s": 0.5, "wind_y_m_per_s": 0.5}


@dataclass(frozen=True)
class Tried:
    """One cable, once."""

    world: str
    feedback: bool
    cable: int
    outcome: str
    true_margin_mm: float
    miss_mm: float
    error_mm: float
    corrections: int


def worlds() -> list[str]:
    """Names of what may happen, and of effects that the model does not know, once and twice."""
    effects = [f"{name} x{size}" for name in library() for size in (1, 2)]
    return [*EVENTS, *effects]


def settings_of(settings: Settings, world: str) -> Settings:
    """The settings of cells in a world."""
    if world == "soft":
        low, high = settings.world.rigidity_n_m2
        soft = settings.world.model_copy(update={"rigidity_n_m2": (0.5 * low, 0.5 * high)})
        return settings.model_copy(update={"world": soft})
    if world in EVENTS:
        return settings
    name, size = world.split(" x")
    return with_world(settings, {name: typical(library()[name], float(size))})


def hidden_in(settings: Settings, world: str, seed: int, cable: int) -> CableModel:
    """A cable of that world."""
    hidden = hidden_cable(settings, seed, cable)
    if world != "puff":
        return hidden
    task = cell_task(settings)
    hold_ends_s = float(true_hold(task, settings.arm.lag_s).t_s[-1])
    puff = Puff.active(**PUFF, begin_s=hold_ends_s + task.decide_s + PUFF_S)
    return replace(hidden, effects=(*hidden.effects, puff))


def tried(settings: Settings, freely: Freedom, world: str, seed: int, cable: int) -> list[Tried]:
    """What becomes of one cable: one of the offsets as planned; chosen freely and corrected."""
    there = settings_of(settings, world)
    happens, hidden = EVENTS.get(world, NOTHING), hidden_in(there, world, seed, cable)
    found = []
    for feedback in (False, True):
        flown = replace(happens, feedback=feedback)
        task = cell_task(there)
        if feedback:
            task = replace(task, choice=replace(task.choice, freely=freely))
        cycle = fast_cycle(
            there, seed, cable, task=task, hidden=hidden, only_chosen=True, flown=flown
        )
        found.append(
            Tried(
                world,
                feedback,
                cable,
                cycle.outcome,
                1e3 * cycle.true_margin_m,
                1e3 * cycle.true_miss_m,
                1e3 * cycle.true_tip_error_m,
                len(cycle.tails),
            )
        )
    return found


def table(rows: list[Tried]) -> str:
    """Per world: outcomes off and on, how many were saved and harmed, and the tip in the mouth."""
    lines = [
        f"{'world':22}{'inserted':>12}{'missed':>10}{'stopped':>8}{'saved':>8}{'harmed':>8}"
        f"{'miss rms mm':>16}{'forecast rms mm':>18}{'corrections':>13}"
    ]
    for world in dict.fromkeys(r.world for r in rows):
        off = {r.cable: r for r in rows if r.world == world and not r.feedback}
        on = {r.cable: r for r in rows if r.world == world and r.feedback}
        counts = [Counter(r.outcome for r in those.values()) for those in (off, on)]
        pairs = [(off[c].outcome, on[c].outcome) for c in off]
        both = [c for c in off if off[c].outcome != "rejected"]
        miss, error = (
            [
                np.sqrt(np.mean([getattr(those[c], name) ** 2 for c in both] or [np.nan]))
                for those in (off, on)
            ]
            for name in ("miss_mm", "error_mm")
        )
        lines.append(
            f"{world:22}{counts[0]['inserted']:>6}{counts[1]['inserted']:>6}"
            f"{counts[0]['missed']:>5}{counts[1]['missed']:>5}"
            f"{counts[1]['stopped']:>8}{pairs.count(('missed', 'inserted')):>8}"
            f"{sum(a == 'inserted' != b for a, b in pairs):>8}"
            f"{miss[0]:>8.2f}{miss[1]:>8.2f}{error[0]:>9.3f}{error[1]:>9.3f}"
            f"{np.mean([r.corrections for r in on.values()]):>13.1f}"
        )
    return "\n".join(lines)


def main() -> None:
    parser = options(__doc__, 20)
    parser.add_argument("--half-mm", type=float, default=5.0)
    parser.add_argument("--window-s", type=float, default=0.0)
    parser.add_argument("--further-m", type=float, default=0.0)
    parser.add_argument("--worlds", nargs="+", choices=worlds(), default=worlds())
    given = parser.parse_args()
    settings = with_mouth(load_settings(given.config), given.half_mm)
    freely, rows = Freedom(given.window_s, (1.15, 1.3, 1.5, 1.8), given.further_m), []
    with written(given.file, Tried) as write:
        for world in given.worlds:
            for cable in range(1, given.cables + 1):
                rows += tried(settings, freely, world, given.seed, cable)
                write(rows[-2:])
            print(table([r for r in rows if r.world == world]), flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
