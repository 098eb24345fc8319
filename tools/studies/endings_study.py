"""How cables end where the model is badly wrong: no cycle may fail, a missed cable is put aside.

In a simulated world for each effect of the library, at `--size` times its usual strength, the
whole cell runs, pictures and all, in simulated time; a cable is tried even where the model hardly
believes in it.  Then `learn` works on the cycles of some of these worlds, missed ones too.
Pictures are smaller and fewer than shipped, with the same field of view.  Two effects in one world
are joined by `+`, and `all` is a world with every one of them.
`python -m tools.studies.endings_study [--effects draught all …] [--size 2] [--cables 12]
[--seed 500] [--learn draught …] [--out DIRECTORY] [--json F]`
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from cell.cable.effects import library
from cell.lab.data.cycles import read_cycles
from cell.lab.line.learn import learn
from cell.records.result import Outcome, Result
from cell.settings import Settings, load_settings
from cell.settings.translate import cable_of, identification_of
from cell.simulated.twins import build_twins
from cell.wiring.build import cell_with, twin_devices
from tools.studies.line_study import CONFIG
from tools.worlds.fast_cell import typical, with_world

#: Nearer than this to where cables are put aside, the hand let go of a cable there, m.
AT_M = 1e-3
#: Pictures of the same field of view, with fewer pixels.
SMALLER, FRAME_RATE_HZ = 0.625, 100.0


@dataclass(frozen=True)
class World:
    """What became of the cables of one world.

    ended     how many ended how, by outcome
    missed_aside  of those missed: the hand let go of them where rejected cables go
    failures  what the failed ones say
    learned   effect that `learn` found from these cycles; None = it was not asked
    used, used_missed  cycles that it used, and those of them that missed
    """

    effect: str
    ended: dict[str, int]
    missed_aside: int
    failures: tuple[str, ...]
    learned: str | None = None
    used: int = 0
    used_missed: int = 0

    def row(self) -> str:
        """One row of the table, Markdown."""
        counts = " | ".join(str(self.ended.get(o.value, 0)) for o in _OUTCOMES)
        result = (
            "" if self.learned is None else f"{self.learned}, {self.used_missed} of {self.used}"
        )
        return f"| {self.effect} | {counts} | {self.missed_aside} | {result} |"


_OUTCOMES = (Outcome.INSERTED, Outcome.MISSED, Outcome.REJECTED, Outcome.FAILED)
HEADER = (
    "| effect | inserted | missed | rejected | failed | missed, put aside "
    "| `learn` found; missed of those used |\n|---|---|---|---|---|---|---|"
)


def small_pictures(settings: Settings) -> Settings:
    """The settings with a camera of fewer pixels and frames that sees the same."""
    camera = settings.camera
    view = camera.view
    seen = {
        "metres_per_pixel": view.metres_per_pixel / SMALLER,
        "origin_column_px": view.origin_column_px * SMALLER,
        "origin_row_px": view.origin_row_px * SMALLER,
    }
    update = {
        "width_px": round(camera.width_px * SMALLER),
        "height_px": round(camera.height_px * SMALLER),
        "frame_rate_hz": FRAME_RATE_HZ,
        "view": view.model_copy(update=seen),
    }
    return settings.model_copy(update={"camera": camera.model_copy(update=update)})


def world(
    settings: Settings, effect: str, size: float, cables: int, seed: int, runs: Path
) -> World:
    """One world from the first cable to the last; after a failure a person goes on."""
    known = library()
    names = {"none": (), "all": tuple(known)}.get(effect, tuple(effect.split("+")))
    settings = with_world(settings, {name: typical(known[name], size) for name in names})
    twins = build_twins(settings, seed, cables)
    let_go_m: dict[int, tuple[float, float]] = {}

    def on_step(number: int, step: str) -> None:
        if step == "go_home":
            pose = twins.world.hand_pose()
            let_go_m[number] = (pose.x_m, pose.y_m)

    cell = cell_with(settings, twin_devices(twins), runs, on_step)
    results: list[Result] = []
    for number in range(1, cables + 1):
        results.append(cell.run_cycle(number))
        if results[-1].outcome is Outcome.FAILED:
            cell.acknowledge()
    cell.close()
    missed = [r.cycle for r in results if r.outcome is Outcome.MISSED]
    aside = settings.motion.aside
    return World(
        effect,
        dict(Counter(r.outcome.value for r in results)),
        sum(_near(let_go_m[number], (aside.x_m, aside.y_m)) for number in missed),
        tuple(f"{r.fault.step}: {r.fault.cause}" for r in results if r.fault is not None),
    )


def _near(a_m: tuple[float, float], b_m: tuple[float, float]) -> bool:
    return all(abs(a - b) < AT_M for a, b in zip(a_m, b_m, strict=True))


def with_learned(found: World, settings: Settings, runs: Path) -> World:
    """The world with what `learn` makes of its cycles."""
    cable = cable_of(settings)
    cycles, _ = read_cycles([runs], cable)
    result = learn(cycles, cable, identification_of(settings), library(), lambda text: None)
    learned = "nothing" if result.best is None else result.best.name
    missed = sum(c.outcome is Outcome.MISSED for c in result.cycles)
    values = asdict(found) | {
        "learned": learned,
        "used": len(result.cycles),
        "used_missed": missed,
    }
    return World(**values)


def summary(worlds: Sequence[World]) -> list[str]:
    """The bars: nothing failed, what missed was put aside, and was learned from."""
    total = Counter[str]()
    for w in worlds:
        total.update(w.ended)
    failures = [f"{w.effect}: {f}" for w in worlds for f in w.failures]
    asked = [w for w in worlds if w.learned is not None]
    return [
        f"{total.total()} cables: " + ", ".join(f"{total[o.value]} {o.value}" for o in _OUTCOMES),
        f"of the missed put aside: {sum(w.missed_aside for w in worlds)}",
        *failures,
        *(
            f"learn in {w.effect}: {w.learned}; {w.used_missed} missed of {w.used} cycles used"
            for w in asked
        ),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--effects", nargs="*", default=list(library()))
    parser.add_argument("--size", type=float, default=2.0)
    parser.add_argument("--cables", type=int, default=12)
    parser.add_argument("--seed", type=int, default=500)
    parser.add_argument("--probability", type=float, default=0.1, help="least that is tried")
    parser.add_argument("--learn", nargs="*", default=[], help="worlds whose cycles it works on")
    parser.add_argument("--out", type=Path, help="keep the records here")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    settings = small_pictures(load_settings(CONFIG))
    choice = settings.choice.model_copy(update={"min_probability": options.probability})
    settings = settings.model_copy(update={"choice": choice})
    worlds: list[World] = []
    with tempfile.TemporaryDirectory(prefix="endings-") as folder:
        print(HEADER, flush=True)
        for effect in options.effects:
            runs = (options.out or Path(folder)) / effect
            found = world(settings, effect, options.size, options.cables, options.seed, runs)
            if effect in options.learn:
                found = with_learned(found, settings, runs)
            worlds.append(found)
            print(found.row(), flush=True)
            if options.json:
                options.json.write_text(json.dumps([asdict(w) for w in worlds], indent=1))
    print("\n".join(summary(worlds)))


if __name__ == "__main__":
    main()
