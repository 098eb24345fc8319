"""From the lab to the line through rendered pictures: what `loop_study` does in nodes, by `cell`.

For each effect and size `cell run` inserts cables of a world with that effect, `cell learn` and
`cell promote` work on what it recorded, and other cables of the same world come.  The same cables
in a world without the effect show how well a complete model forecasts.  Forecast errors are as the
cell itself measures them, vision's included.
`python -m tools.studies.picture_loop [--effects air_drag … none] [--sizes 1] [--cables 6]
[--seed 2200] [--json F]`
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cell.cable.effects import library
from cell.settings import load_settings
from tools.studies.learn import CYCLE_S, LEARNING_S, PROMOTING_S, Commands, learned_from
from tools.studies.loop_study import Cables, World, summary
from tools.worlds.fast_cell import CONFIG, INSERTABLE_M, best_margin_m, typical


def world(folder: Path, effect: str, size: float, cables: int, seed: int) -> World:
    """One world from the first cable to the last; its commands' output goes to a log."""
    parts = [] if effect == "none" else effect.split("+")
    hidden = {name: typical(library()[name], size) for name in parts}
    config = _config(folder, "cell", hidden)
    with (folder / "log.txt").open("w") as log:
        usual_s = (cables * CYCLE_S, cables * LEARNING_S, PROMOTING_S, cables * CYCLE_S)
        commands = Commands(usual_s, log=log)
        before = _run(commands, config, folder / "before", seed, cables)
        begun_s = _children_s()
        code = learned_from(commands, folder, config)
        spent_s = _children_s() - begun_s
        candidate = _read(folder / "candidate.yaml")
        promoted = code == 0 and bool(candidate)
        if promoted:
            commands.run("promote", folder / "candidate.yaml", "--config", config)
        complete = _complete(commands, folder.parent, seed, cables)
        after = _run(commands, config, folder / "after", seed + 1, cables) if promoted else None
    return World(
        effect,
        size,
        seed,
        tuple(e["effect"] for e in candidate.get("model", {}).get("effects", ())),
        tuple(candidate.get("tied", ())),
        len(list((folder / "candidate.measured").glob("*/state.json"))),
        promoted,
        tuple(f"{g['gate']} ({g['found']})" for g in candidate.get("gates", ()) if not g["passed"]),
        before,
        after,
        complete,
        spent_s,
    )


def _config(folder: Path, name: str, hidden: Mapping[str, Mapping[str, float]]) -> Path:
    text, empty = CONFIG.read_text("utf-8"), "effects: {}  "
    assert empty in text
    text = f"recording: null  # films of all worlds are 40 GB, and nothing here needs them\n{text}"
    path = folder / f"{name}.yaml"
    path.write_text(text.replace(empty, f"effects: {json.dumps(hidden)}  "), "utf-8")
    return path


_COMPLETE: dict[tuple[int, int], Cables] = {}


def _complete(commands: Commands, folder: Path, seed: int, cables: int) -> Cables:
    """The cables that come later, in a world without an effect: the same for every effect."""
    if (seed, cables) not in _COMPLETE:
        config = _config(folder, "complete", {})
        out = folder / f"complete-{seed}"
        _COMPLETE[seed, cables] = _run(commands, config, out, seed + 1, cables)
    return _COMPLETE[seed, cables]


def _run(commands: Commands, config: Path, out: Path, seed: int, cables: int) -> Cables:
    """What became of the cables of a seed."""
    begun_s = _children_s()
    commands.also_run(
        cables * CYCLE_S,
        "run",
        "--config",
        config,
        "--cycles",
        cables,
        "--seed",
        seed,
        "--out",
        out,
    )
    spent_s = _children_s() - begun_s
    results = [json.loads(f.read_text("utf-8")) for f in sorted(out.glob("*/result.json"))]
    settings = load_settings(config)
    could = [r for r in results if best_margin_m(settings, seed, r["cycle"]) > INSERTABLE_M]
    errors = [r["prediction_error_m"] for r in results if r["prediction_error_m"] is not None]
    return Cables(
        len(could),
        sum(r["outcome"] == "inserted" for r in could),
        sum(r["outcome"] == "missed" for r in results),
        float(np.sqrt(np.mean(np.square(errors)))) if errors else float("inf"),
        spent_s / cables,
    )


def _children_s() -> float:
    """CPU time of the commands run so far, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _read(path: Path) -> dict[str, Any]:
    return yaml.safe_load(path.read_text("utf-8")) if path.exists() else {}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--effects", nargs="*", default=[*library(), "none"])
    parser.add_argument("--sizes", nargs="*", type=float, default=[1.0])
    parser.add_argument("--cables", type=int, default=6)
    parser.add_argument("--seed", type=int, default=2200)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    folder, worlds = Path(tempfile.mkdtemp(prefix="picture-loop-")), []
    print(f"records: {folder}")
    for effect in options.effects:
        for size in options.sizes if effect != "none" else [0.0]:
            place = folder / f"{effect}-{size:g}"
            place.mkdir()
            begun_s = _children_s()
            worlds.append(world(place, effect, size, options.cables, options.seed))
            print(f"{worlds[-1].line()}, all {_children_s() - begun_s:.0f} s", flush=True)
            if options.json:
                options.json.write_text(json.dumps([asdict(w) for w in worlds], indent=1))
    print("\n".join(summary(worlds)))


if __name__ == "__main__":
    main()
