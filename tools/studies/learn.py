"""From a line that rejects good cables to one that inserts them: the complete loop in one command.

A simulated cell has physics in its world that its model lacks.  Its opening is narrow, so that
cables are rejected or missed for it; `cell learn` names the effect from the recorded cycles,
`cell promote` adds it to the model, and the same cables are inserted again.
`python -m tools.studies.learn [--effect air_drag] [--size 2] [--cables 4] [--out FOLDER]
[--picture F.png]`
"""

from __future__ import annotations

import argparse
import json
import secrets
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import matplotlib.pyplot as plt
import numpy as np

from cell.cable.dynamics import simulate
from cell.cable.effects import library
from cell.identify.individual import identify
from cell.records.folder import read_record
from cell.settings import load_settings
from cell.wiring.build import cell_task
from tools.shipped_settings import FAKE, with_entries
from tools.worlds.fast_cell import typical

#: An opening whose height requires good forecasts.
NARROW = {"destination.y_m": [-0.1085, -0.1035], "motion.offsets.step_m": 0.001}
#: Initial estimates of the times of a cable's cycle, its part in learning, and promoting, s;
#: measured times correct them.
CYCLE_S, LEARNING_S, PROMOTING_S = 6.0, 15.0, 2.0
#: Candidates for the hidden effect: those that are detectable with a cable of this size.
DRAWN_FROM = ("air_drag", "linear_air_drag", "stress_relaxation", "bending_hysteresis", "tip_mass")


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 60.0 else f"{seconds / 60.0:.1f} min"


@dataclass(frozen=True)
class CyclesOfModel:
    """Cycles of the same cables with one model: outcomes, and errors of forecast and fit, mm."""

    title: str
    config: Path
    runs: Path

    @property
    def results(self) -> list[dict[str, object]]:
        files = sorted(self.runs.glob("*/result.json"), key=lambda p: p.parent.name)
        return [json.loads(f.read_text(encoding="utf-8")) for f in files]

    def mean_mm(self, key: str) -> float:
        known = [float(str(r[key])) for r in self.results if r[key] is not None]
        return 1e3 * float(np.sqrt(np.mean(np.square(known)))) if known else float("nan")

    def summary(self) -> str:
        inserted = sum(r["outcome"] == "inserted" for r in self.results)
        return (
            f"{self.title}: {inserted} of {len(self.results)} inserted; the model misses the swing "
            f"by {self.mean_mm('residual_rms_m'):.3f} mm rms"
        )


@dataclass
class Commands:
    """Runs the loop's commands; prints before each its purpose and expected time.

    usual_s  initial estimate of the time of each; measured times correct the remaining ones
    log      file for their output; None = the terminal
    """

    usual_s: tuple[float, ...]
    clock: Callable[[], float] = time.monotonic
    taken_s: list[float] = field(default_factory=list)
    log: IO[str] | None = None

    def left_s(self) -> float:
        """Estimated time of the remaining commands, s."""
        done = len(self.taken_s)
        slower = sum(self.taken_s) / sum(self.usual_s[:done]) if done else 1.0
        return slower * sum(self.usual_s[done:])

    def line(self) -> str:
        """Text of the current step, elapsed and remaining time."""
        step = f"step {len(self.taken_s) + 1} of {len(self.usual_s)}"
        so_far, remaining = _minutes(sum(self.taken_s)), _minutes(self.left_s())
        return f"{step}, {so_far} so far, about {remaining} left"

    def also_run(self, usual_s: float, *arguments: object) -> int:
        """Like `run`, for a command that was not planned."""
        done = len(self.taken_s)
        self.usual_s = (*self.usual_s[:done], usual_s, *self.usual_s[done:])
        return self.run(*arguments)

    def run(self, *arguments: object) -> int:
        """Exit code of `cell` with these words."""
        words = [str(a) for a in arguments]
        print(f"\n{self.line()}\n$ cell {' '.join(words)}", file=self.log, flush=True)
        begun_s = self.clock()
        command = [sys.executable, "-m", "cell", *words]
        code = subprocess.run(command, check=False, stdout=self.log, stderr=self.log).returncode
        self.taken_s.append(self.clock() - begun_s)
        return code


def draw(before: CyclesOfModel, after: CyclesOfModel, effect: str, path: Path) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.5, 4.2), constrained_layout=True)
    noise = after.mean_mm("noise_m")
    bars = [before.mean_mm("residual_rms_m"), after.mean_mm("residual_rms_m"), noise]
    names = ["baseline", f"+ {effect}", "camera noise"]
    drawn = left.bar(names, bars, color=["#c0392b", "#2e7d32", "#9e9e9e"], width=0.6)
    left.bar_label(drawn, labels=[f"{b:.3f}" for b in bars], padding=2)
    left.set(ylabel="the model misses the swing by, mm rms", title="The error falls")
    left.spines[["top", "right"]].set_visible(False)
    _draw_tip(right, before, after)
    figure.savefig(path, dpi=110)
    print(f"picture: {path}")


def _draw_tip(axes: plt.Axes, before: CyclesOfModel, after: CyclesOfModel) -> None:
    """Path of the first inserted cable's tip, and its forecasts by both models."""
    record = next(
        r
        for f in sorted(after.runs.iterdir())
        if (r := read_record(f)).study is not None and r.study.role("validate")
    )
    study = record.study
    assert study is not None
    held, executed = study.role("fit")[0], study.role("validate")[0]
    tip = executed.markers.xy_m[:, 0] * 1e3
    for step, config, colour in (
        (before, before.config, "#c0392b"),
        (after, after.config, "#2e7d32"),
    ):
        task = cell_task(load_settings(config))
        estimate = identify(held, study.arc_length_m, study.cable, options=task.identification)
        times = executed.markers.t_s
        at = np.array([study.cable.free_length_m])
        path = simulate(estimate.model, executed.grip, times, at)[0, :, 0] * 1e3
        axes.plot(*path.T, color=colour, label=f"forecast {step.title}")
    axes.plot(*tip.T, ".", color="black", markersize=3, label="seen")
    opening = task.destination
    x, y = opening.x_min_m * 1e3, opening.y_min_m * 1e3
    size = (opening.x_max_m * 1e3 - x, opening.y_max_m * 1e3 - y)
    axes.add_patch(plt.Rectangle((x, y), *size, fill=False, edgecolor="#1565c0", linewidth=2))
    axes.set(xlim=(x - 8, x + 14), ylim=(y - 5, y + size[1] + 5), xlabel="x, mm", ylabel="y, mm")
    axes.xaxis.set_major_locator(plt.MultipleLocator(5))
    axes.set(title="The tip in the opening (blue)")
    axes.legend(frameon=False, fontsize=8)


def learned_from(commands: Commands, folder: Path, config: Path) -> int:
    """Exit code of `cell learn`, including the motions that it requests."""
    out = folder / "candidate.yaml"
    motion, measured = folder / "candidate_motion.yaml", out.with_suffix(".measured")
    runs = [folder / "before"]
    learned = commands.run("learn", *runs, "--config", config, "-o", out)
    for seed in (101, 102):  # other cables than those of the later comparison
        if not motion.exists():
            break
        of_it = ("--config", config, "--motion", motion, "--runs", measured, "--seed", seed)
        commands.also_run(CYCLE_S, "run", *of_it)
        motion.unlink()
        again = ("learn", *runs, measured, "--config", config, "-o", out)
        learned = commands.also_run(commands.usual_s[1], *again)
    return learned


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--effect", choices=sorted(library()), help="default: drawn, told at the end"
    )
    parser.add_argument("--size", type=float, default=2.0, help="times its typical strength")
    parser.add_argument("--cables", type=int, default=4)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    folder = options.out or Path(tempfile.mkdtemp(prefix="cell-learn-"))
    folder.mkdir(parents=True, exist_ok=True)
    effect = options.effect or secrets.choice(DRAWN_FROM)
    config, old = folder / "cell.yaml", folder / "before.yaml"
    hidden = {effect: typical(library()[effect], options.size)}
    for path in (config, old):
        path.write_text(with_entries(FAKE, {**NARROW, "world.effects": hidden}), encoding="utf-8")
    again = ("--cycles", options.cables, "--seed", options.seed)
    cycles_s = options.cables * CYCLE_S
    commands = Commands((cycles_s, options.cables * LEARNING_S, PROMOTING_S, cycles_s))
    commands.run("run", "--config", config, *again, "--runs", folder / "before")
    learned = learned_from(commands, folder, config)
    if learned == 0 and (folder / "candidate.yaml").exists():
        learned = commands.run("promote", folder / "candidate.yaml", "--config", config)
    else:
        commands.taken_s.append(0.0)  # there is nothing to promote
    commands.run("run", "--config", config, *again, "--runs", folder / "after")
    print(f"\nall of it took {_minutes(sum(commands.taken_s))}")
    before = CyclesOfModel("before", old, folder / "before")
    after = CyclesOfModel("after", config, folder / "after")
    print(f"\n{before.summary()}\n{after.summary()}")
    model = load_settings(config).model.effects
    promoted = ", ".join(e.effect for e in model) or "nothing"
    print(f"hidden in the world: {effect}; learned and promoted: {promoted}")
    if model:
        draw(before, after, promoted, options.picture or folder / "learned.png")
    return learned


if __name__ == "__main__":
    raise SystemExit(main())
