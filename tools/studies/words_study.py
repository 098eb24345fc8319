"""Does any diagnosis contradict its own numbers?  Over practice, measured and made studies.

    python -m tools.studies.words_study [STUDY …] [--made 4] [--first 0] [--only NAME …]
                                        [--keep FOLDER]

`cell diagnose` is run on each as a user does, and what it prints is checked against its JSON by
`tools/studies/contradictions.py`.  Without studies: those beside the project, a magnet known in one
of them, a cable held at both ends, and so many made ones of each kind (complete, one effect hidden,
a pair, a law of no library, few markers, a stated error).  Ends with 1 if there is a contradiction.
"""

# mypy: ignore-errors

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize
from typer.testing import CliRunner

from cell.cable.effects import library
from cell.cli import app
from cell.study.data import Markers, Study, Trial
from cell.study.folder import write_study
from tools.studies.contradictions import contradictions
from tools.worlds import made_studies, outside_laws

ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared" / "data"
GRAVITY_M_PER_S2, NOISE_M = 9.81, 1e-4
LAWS = (outside_laws.Magnet, outside_laws.CubicDrag, outside_laws.DragAlong)


def held_at_both_ends(folder: Path, vice_m=(-0.05, -0.03), links: int = 40) -> Path:
    """A cable between the hand and a vice that does not move: a chain in equilibrium, each frame.

    The hand is slow beside the cable's own swing between two clamps.
    """
    cable, rigidity = made_studies.CABLE, 2.5e-5
    size = cable.free_length_m / links
    weight = cable.line_density_kg_per_m * size * GRAVITY_M_PER_S2
    pull = 1e3 * rigidity / size**3  # of the vice, per metre

    def shape(hand: np.ndarray, start: np.ndarray) -> np.ndarray:
        def energy(angle: np.ndarray) -> tuple[float, np.ndarray]:
            along = -size * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            points = hand + np.cumsum(along, axis=0)
            bent = np.diff(angle, prepend=0.0, append=0.0)
            away = points[-1] - vice_m
            total = 0.5 * rigidity / size * bent @ bent + weight * points[:, 1].sum()
            force = np.tile([0.0, weight], (links, 1))
            force[-1] += pull * away
            beyond = np.cumsum(force[::-1], axis=0)[::-1]
            turn = size * np.stack([np.sin(angle), -np.cos(angle)], axis=1)
            slope = rigidity / size * (bent[:-1] - bent[1:]) + np.sum(beyond * turn, axis=1)
            return 1e6 * (total + 0.5 * pull * away @ away), 1e6 * slope

        return minimize(energy, start, jac=True, method="BFGS", options={"maxiter": 3000}).x

    rng, trials = np.random.default_rng(3), []
    ways = (("one", "fit", (0.02, -0.06)), ("two", "validate", (0.0, 0.05)),
            ("three", "validate", (-0.04, -0.02)))  # fmt: skip
    sag = 0.8 * np.sin(2.0 * np.pi * np.linspace(0.0, 1.0, links))
    for name, role, way in ways:
        hand = made_studies.stroke(0.0, way, 0.3)
        shares, angle, found = np.linspace(0.0, 1.0, 25), sag, []
        for share in shares:
            angle = shape(share * np.array(way), angle)
            along = -size * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            points = np.vstack([np.zeros(2), np.cumsum(along, axis=0)]) + share * np.array(way)
            found.append(points[:: links // 10][::-1])
        t_s = np.arange(0.003, hand.t_s[-1], made_studies.FRAME_S)
        done = np.interp(t_s, hand.t_s, np.hypot(hand.x_m, hand.y_m) / np.hypot(*way))
        seen = CubicSpline(shares, np.array(found))(done)
        seen = seen + NOISE_M * rng.normal(size=seen.shape)
        trials.append(Trial(name, role, "equilibrium", hand, Markers(t_s, seen)))
    arcs = np.linspace(cable.free_length_m, 0.0, 11)
    write_study(Study(folder.name, cable, arcs, tuple(trials)), folder)
    return folder


def few_markers(study: Study, kept: tuple[int, ...]) -> Study:
    """The study with these markers only."""
    trials = [
        replace(t, markers=Markers(t.markers.t_s, t.markers.xy_m[:, list(kept)]))
        for t in study.trials
    ]
    return replace(study, arc_length_m=study.arc_length_m[list(kept)], trials=tuple(trials))


def made(kind: str, seed: int) -> Study:
    """A made study; the seed chooses what is hidden, too."""
    effects = list(library().values())
    rng = np.random.default_rng([seed, 7])
    first, second = (effects[i] for i in rng.choice(len(effects), 2, replace=False))
    size = float(np.exp(rng.uniform(np.log(0.5), np.log(3.0))))
    one = made_studies.hidden(first, size)
    match kind:
        case "complete":
            return made_studies.make_study(seed)
        case "one":
            return made_studies.make_study(seed, [one])
        case "pair":
            return made_studies.make_study(seed, [one, made_studies.hidden(second, size)])
        case "outside":
            law = made_studies.hidden(LAWS[seed % len(LAWS)], 2.0 * size)
            return made_studies.make_study(seed, [law])
        case "few":
            kept = ((0,), (0, 5), (2, 5, 8))[seed % 3]
            return few_markers(made_studies.make_study(seed, [one]), kept)
        case _:
            return replace(made_studies.make_study(seed, [one]), noise_std_m=2e-4)


def magnet(folder: Path) -> Path:
    """The example of the docs, as a file."""
    page = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")
    text = re.search(r"<!-- file: magnet.py -->\s*```python\n(.*?)```", page, re.DOTALL)
    path = folder / "magnet.py"
    path.write_text(text[1], encoding="utf-8")
    return path


def asked(given: argparse.Namespace, folder: Path) -> list[tuple[str, list[str]]]:
    """Name and arguments of every diagnosis."""
    if given.studies:
        return [(Path(s).name, [s]) for s in given.studies]
    there = sorted(p.parent for p in SHARED.glob("*/*/study.yaml"))
    found = [(f"{p.parent.name}/{p.name}", [str(p)]) for p in there]
    if (known := SHARED / "practice" / "unknown_a").is_dir():
        found.append(("unknown_a, magnet known", [str(known), "--known", str(magnet(folder))]))
    both = folder / "both_ends"
    found.append(("both ends held", [str(both)]))
    for kind in ("complete", "one", "pair", "outside", "few", "stated"):
        for seed in range(given.first, given.first + given.made):
            found.append((f"{kind} {seed}", [str(folder / f"{kind}_{seed}")]))
    return [f for f in found if not given.only or any(o in f[0] for o in given.only)]


def write_made(folder: Path) -> None:
    """The study of a folder, if it is one to be made."""
    if folder.name == "both_ends":
        held_at_both_ends(folder)
    elif (name := re.fullmatch(r"([a-z]+)_(\d+)", folder.name)) and not folder.exists():
        write_study(made(name[1], int(name[2])), folder)


def main() -> int:
    """A line for each study, and below it what it contradicts itself in."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("studies", nargs="*")
    parser.add_argument("--made", type=int, default=4)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--keep", type=Path)
    given = parser.parse_args()
    wrong = 0
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        todo = asked(given, folder)
        for name, arguments in todo:
            if folder in Path(arguments[0]).parents:
                write_made(Path(arguments[0]))
            out, began = folder / "diagnosis.json", time.monotonic()
            done = CliRunner().invoke(app, ["diagnose", *arguments, "-o", str(out), "--force"])
            if done.exit_code != 0:
                wrong += 1
                print(f"FAILED {name}: {done.output.strip().splitlines()[-1]}", flush=True)
                continue
            found = json.loads(out.read_text(encoding="utf-8"))
            said = contradictions(found, done.stdout)
            wrong += bool(said)
            seconds = time.monotonic() - began
            print(f"{'WRONG' if said else 'ok   '} {name}: {found['verdict']}, {seconds:.0f} s")
            print("".join(f"      {s}\n" for s in said), end="", flush=True)
    print(f"{wrong} of {len(todo)} contradict themselves")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
