"""How soon the line's charts notice an effect that appears, and how often they alarm falsely.

Cables without pictures (`fast_cell`), judged by the chart that `cell run` uses.  First a quiet
line; then lines of 40 of its cables, after which an effect appears in the world.
`python tools/chart_study.py [--quiet 1000] [--lines 5] [--effects tip_mass …] [--sizes 1]
[--seed 700] [--json F]`
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from coverage_study import Errors
from fast_cell import FastCycle, fast_cycle, typical, with_world
from line_study import CONFIG
from loop_study import SEEN

from cell.build import cell_task
from cell.cable.effects import library
from cell.plan.passage import height_at_mouth_m
from cell.records.chart import signals
from cell.records.result import Outcome, Result
from cell.run.station import Task
from cell.settings import Settings, load_settings

#: A line is quiet for so many cables, and must then notice within so many.
QUIET, SOON, PATIENCE = 40, 5, 40


def result(task: Task, number: int, c: FastCycle) -> Result:
    """Of a cycle without pictures, what the charts read of a result."""
    best = None if c.choice is None else c.choice.best
    return Result(
        cycle=number,
        outcome=Outcome(c.outcome),
        folder=f"{number:06d}",
        predicted_miss_m=None
        if c.choice is None
        else height_at_mouth_m(task.destination, c.choice.tip_m),
        measured_miss_m=None if c.passage is None else c.passage.miss_m,
        predicted_std_m=None if best is None else best.margin_std_m,
        residual_rms_m=None if c.identified is None else c.identified.residual_rms_m,
        noise_m=None if c.identified is None else c.identified.noise.std_m,
    )


def results(
    settings: Settings, task: Task, seed: int, numbers: Iterable[int], errors: Errors = SEEN
) -> list[Result]:
    """Of these cables of a seed, one after another."""
    return [
        result(task, k, fast_cycle(settings, seed, k, task=task, errors=errors)) for k in numbers
    ]


def alarms(line: Sequence[Result]) -> list[str]:
    """What was said at each alarm of a line; after it the charts begin anew."""
    said, begin = [], 0
    while found := signals(line[begin:]):
        first = min(found, key=lambda s: s.at)
        said.append(f"at {first.at}: {first}")
        begin = 1 + next(i for i, r in enumerate(line) if r.folder == first.at)
    return said


def noticed_after(quiet: Sequence[Result], later: Iterable[Result]) -> int | None:
    """Cables of the changed world until the charts say so; None = they never did."""
    line = list(quiet)
    for count, r in enumerate(later, start=1):
        line.append(r)
        if any(s.at >= line[len(quiet)].folder for s in signals(line)):
            return count
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quiet", type=int, default=1000, help="cables of the quiet line")
    parser.add_argument("--lines", type=int, default=5, help="of each effect and size")
    parser.add_argument("--effects", nargs="*", default=["tip_mass", "stress_relaxation"])
    parser.add_argument("--sizes", nargs="*", type=float, default=[1.0])
    parser.add_argument("--seed", type=int, default=700)
    parser.add_argument("--json", type=Path, help="the quiet line: read if there, else written")
    options = parser.parse_args()
    settings = load_settings(CONFIG)
    task = cell_task(settings)
    if options.json and options.json.exists():
        quiet = [Result.from_json(r) for r in json.loads(options.json.read_text())]
    else:
        still = with_world(settings, {})
        quiet = results(still, task, options.seed, range(1, options.quiet + 1))
        if options.json:
            options.json.write_text(json.dumps([r.to_json() for r in quiet]))
    said = alarms(quiet)
    print(f"quiet: {len(said)} false alarms in {len(quiet)} cycles", *said, sep="\n  ", flush=True)
    for name in options.effects:
        for size in options.sizes:
            there = with_world(settings, {name: typical(library()[name], size)})
            found = []
            for i in range(options.lines):
                before = quiet[QUIET * i : QUIET * (i + 1)]
                if len(before) < QUIET or signals(before):
                    continue  # it was not quiet
                first = before[-1].cycle + 1
                later = (
                    results(there, task, options.seed, [k])[0]
                    for k in range(first, first + PATIENCE)
                )
                found.append(noticed_after(before, later))
            soon = sum(n is not None and n <= SOON for n in found)
            print(
                f"{name} × {size:g}: within {SOON} in {soon} of {len(found)}: {found}", flush=True
            )


if __name__ == "__main__":
    main()
