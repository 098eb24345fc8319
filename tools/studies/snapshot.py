"""What commands of the lab say of many studies, kept as files: did a change of the code change it?

    python -m tools.studies.snapshot make STUDIES
    python -m tools.studies.snapshot take FOLDER STUDIES [more studies' folders] [--tree CHECKOUT]
    python -m tools.studies.snapshot compare BEFORE AFTER

`make` writes 60 studies: complete ones, with one effect, outside the library, and imitated rigs.
`take` runs `cell diagnose` and, of every fourth, `cell fit` with a checkout's code and keeps JSON
and text; cycles of many cables (a folder whose name begins with `runs`) go to `cell learn`.
`compare` names every file that differs; numbers must agree to the last digit.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from cell.cable.effects import library
from cell.study.folder import write_study
from tools.worlds.breadth_world import World, hypercube
from tools.worlds.cases import hidden_effect
from tools.worlds.known_truth import that_shows
from tools.worlds.rigs import Rig, rig_study

#: Studies of each kind.
COUNTS = {"complete": 15, "one": 23, "outside": 10}
RIGS = range(900, 912)
SEED = 77
FITTED_EVERY = 4


def make(folder: Path) -> None:
    """Write the studies."""
    known = library()
    for place, (kind, count) in enumerate(COUNTS.items()):
        for conditions in hypercube(count, 100 * SEED + place):
            world = World.of(conditions, SEED)
            if kind == "complete":
                clean = world.clean()
            else:
                clean = world.showing(hidden_effect(kind, conditions.number, known)[0])[1]
            study = world.study(clean, SEED)
            write_study(study, folder / f"{kind}_{conditions.number}")
            print(f"{kind} {conditions.number}", flush=True)
    for seed in RIGS:
        name = sorted(known)[seed % len(known)]
        rig = Rig.drawn(seed, name)
        write_study(rig_study(rig, that_shows(rig, known[name], len(known))[0]),
                    folder / f"rig_{seed}")  # fmt: skip
        print(f"rig {seed}", flush=True)


def commands(folders: list[Path]) -> dict[str, list[str]]:
    """Commands by the name under which what they say is kept."""
    studies = sorted(p.parent for f in folders for p in f.glob("*/study.yaml"))
    found = {f"diagnose_{s.name}": ["diagnose", str(s)] for s in studies}
    found |= {f"fit_{s.name}": ["fit", str(s)] for s in studies[::FITTED_EVERY]}
    runs = [f for f in folders if f.name.startswith("runs")]
    for folder in runs:
        cycles = sorted(p.parent for p in folder.glob("*/settings.yaml"))
        settings = str(cycles[0] / "settings.yaml")
        found[f"learn_{folder.name}"] = ["learn", *map(str, cycles), "-c", settings]
    return found


def take(out: Path, folders: list[Path], tree: Path) -> None:
    """Keep what a checkout's code says."""
    out.mkdir(parents=True)
    environment = os.environ | {"PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"}

    def run(item: tuple[str, list[str]]) -> None:
        name, command = item
        result = out / f"{name}.{'yaml' if command[0] == 'learn' else 'json'}"
        done = subprocess.run(
            [sys.executable, "-m", "cell", *command, "-o", result],
            cwd=tree, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        said = f"{done.returncode}\n{done.stdout}".replace(str(out), "OUT")  # not how long it took
        (out / f"{name}.txt").write_text(said, encoding="utf-8")
        print(name, done.returncode, flush=True)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(run, commands(folders).items()))


def compare(before: Path, after: Path) -> int:
    """Print what differs; its number."""
    names = sorted({p.name for f in (before, after) for p in f.iterdir()})
    contents = [[f / n for f in (before, after)] for n in names]
    differ = [
        n
        for n, (a, b) in zip(names, contents, strict=True)
        if not (a.exists() and b.exists() and a.read_bytes() == b.read_bytes())
    ]
    print("\n".join([*differ, f"{len(differ)} of {len(names)} files differ"]))
    return len(differ)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("make", "take", "compare"))
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--tree", type=Path, default=Path(__file__).parents[2])
    given = parser.parse_args()
    first, *others = [f.resolve() for f in given.folders]
    if given.what == "make":
        make(first)
    elif given.what == "take":
        take(first, others, given.tree.resolve())
    else:
        return int(compare(first, others[0]) > 0)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
