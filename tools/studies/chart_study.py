"""How soon the line's charts notice an effect that appears, and how often they alarm falsely.

Cables without pictures (`fast_cell`), judged by the chart that `cell run` uses.  First a quiet
line; then lines of 40 of its cables, after which an effect appears in the world, or cables come
warm (`warm`: EI a fifth lower and viscosity by half higher, at size 1).  With `--batch S` EI and
damping of the cables differ by ± S alone.
`python -m tools.studies.chart_study [--quiet 1000] [--lines 5] [--effects tip_mass warm …]
[--sizes 1] [--seed 700] [--batch S] [--json F]`: the quiet line goes to F as it comes, and is
continued from there.  With `--drawn N` instead N lines of 1000 and of 80 cables whose EI and
viscosity are drawn from the batch and identified to 1 and 3 %, none simulated, for the charts of
cables alone.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cell.cable.effects import library
from cell.cable.model import CableModel
from cell.plan.passage import height_at_mouth_m
from cell.records.chart import signals
from cell.records.result import Outcome, Result
from cell.run.progress import parameters_of
from cell.run.station import Task
from cell.settings import Settings, load_settings
from cell.simulated.hidden import hidden_cable
from cell.wiring.build import cell_task
from tools.studies.line_study import CONFIG
from tools.studies.loop_study import SEEN
from tools.worlds.fast_cell import FastCycle, fast_cycle, typical, with_world

#: A line is quiet for so many cables, and must then notice within so many.
QUIET, SOON, PATIENCE = 40, 5, 40
#: The quiet line is saved, and what it has said is printed, every so many cables.
SAVED = 50
#: EI and viscosity of a warm cable, times those of the same cable cold.
SOFTER, MORE_VISCOUS = 0.8, 1.5


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
        prediction_error_m=c.true_tip_error_m,
        parameters=parameters_of(c.identified) if c.identified else {},
    )


def results(
    settings: Settings, task: Task, seed: int, numbers: Iterable[int], warmth: float = 0.0
) -> Iterator[Result]:
    """Of these cables of a seed, one after another, each as it comes."""
    for k in numbers:
        hidden = warmed(hidden_cable(settings, seed, k), warmth)
        c = fast_cycle(settings, seed, k, task=task, errors=SEEN, hidden=hidden, only_chosen=True)
        yield result(task, k, c)


def warmed(cable: CableModel, warmth: float) -> CableModel:
    """A cable that is softer and more viscous by so many times what makes it `warm`."""
    return replace(
        cable,
        rigidity_n_m2=np.asarray(cable.rigidity_n_m2) * SOFTER**warmth,
        viscosity_n_m2_s=cable.viscosity_n_m2_s * MORE_VISCOUS**warmth,
    )


def alarms(line: Sequence[Result]) -> list[str]:
    """What was said at each alarm of a line; after it the charts begin anew."""
    said, begin = [], 0
    while found := signals(line[begin:]):
        first = min(found, key=lambda s: s.at)
        said.append(f"at {first.at}: {first}")
        begin = 1 + next(i for i, r in enumerate(line) if r.folder == first.at)
    return said


def noticed_after(
    quiet: Sequence[Result], later: Iterable[Result]
) -> tuple[int | None, list[Result]]:
    """Cables of the changed world until the charts say so, None = they never did; and these."""
    line, count = list(quiet), None
    for r in later:
        line.append(r)
        if any(s.at >= line[len(quiet)].folder for s in signals(line)):
            count = len(line) - len(quiet)
            break
    return count, line[len(quiet) :]


def error_mm(line: Iterable[Result]) -> float:
    """Root mean square over cables of the forecast's largest error in the mouth, in truth, mm."""
    known = [r.prediction_error_m for r in line if r.prediction_error_m is not None]
    return 1e3 * float(np.sqrt(np.nanmean(np.square(known))))


def alike(settings: Settings, share: float) -> Settings:
    """Cables of a batch that differ by ± this share in EI and damping, about the middle."""
    world = settings.world
    narrow = {
        name: tuple(
            float(np.sqrt(np.prod(getattr(world, name)))) * f for f in (1 - share, 1 + share)
        )
        for name in ("rigidity_n_m2", "damping_ratio")
    }
    return settings.model_copy(update={"world": world.model_copy(update=narrow)})


def quiet_line(
    still: Settings, task: Task, seed: int, count: int, path: Path | None
) -> list[Result]:
    """So many cables of a world without an effect; what is in the file already is not run again."""
    line: list[Result] = []
    if path and path.exists():
        line = [Result.from_json(r) for r in json.loads(path.read_text())][:count]
    for r in results(still, task, seed, range(len(line) + 1, count + 1)):
        line.append(r)
        if len(line) % SAVED == 0 or len(line) == count:
            print(f"{len(line)} quiet cycles, {len(alarms(line))} false alarms", flush=True)
            if path:
                path.write_text(json.dumps([q.to_json() for q in line]))
    return line


def drawn(settings: Settings, lines: int, seed: int, sizes: Sequence[float]) -> list[str]:
    """What the charts of cables say of lines of which nothing is simulated."""
    rng, world = np.random.default_rng(seed), settings.world

    def said(count: int, warmth: float) -> int | None:
        """Cables from the 41st until one is noticed; None = none is."""
        rigidity = np.exp(rng.uniform(*np.log(world.rigidity_n_m2), count))
        viscosity = rng.uniform(*world.damping_ratio, count) * np.sqrt(rigidity)
        warm = np.arange(count) >= QUIET
        rigidity *= np.where(warm, SOFTER**warmth, 1.0) * np.exp(0.01 * rng.normal(size=count))
        viscosity *= np.where(warm, MORE_VISCOUS**warmth, 1.0)
        viscosity *= np.exp(0.03 * rng.normal(size=count))
        found = signals(
            [
                Result(i, Outcome.INSERTED, str(i), parameters={"rigidity_0": a, "viscosity": b})
                for i, (a, b) in enumerate(zip(rigidity, viscosity, strict=True))
            ]
        )
        return min((int(s.at) for s in found), default=None)

    quiet = [said(1000, 0.0) for _ in range(lines)]
    out = [f"drawn: {sum(n is not None for n in quiet)} of {lines} lines of 1000 gave an alarm"]
    for size in sizes:
        at = [n for n in (said(2 * QUIET, size) for _ in range(lines)) if n is None or n >= QUIET]
        soon = [sum(n is not None and n < QUIET + k for n in at) for k in (SOON, 2 * SOON)]
        out.append(
            f"drawn, warm × {size:g}: of {len(at)} lines within {SOON} in {soon[0]}, "
            f"within {2 * SOON} in {soon[1]}"
        )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quiet", type=int, default=1000, help="cables of the quiet line")
    parser.add_argument("--lines", type=int, default=5, help="of each effect and size")
    parser.add_argument("--effects", nargs="*", default=["tip_mass", "stress_relaxation", "warm"])
    parser.add_argument("--sizes", nargs="*", type=float, default=[1.0])
    parser.add_argument("--seed", type=int, default=700)
    parser.add_argument("--batch", type=float, help="share by which cables differ")
    parser.add_argument("--drawn", type=int, help="lines of cables that are not simulated")
    parser.add_argument("--json", type=Path, help="the quiet line: continued if there, written")
    options = parser.parse_args()
    settings = load_settings(CONFIG)
    settings = alike(settings, options.batch) if options.batch else settings
    if options.drawn:
        print("\n".join(drawn(settings, options.drawn, options.seed, options.sizes)))
        return
    task, still = cell_task(settings), with_world(settings, {})
    begun_s = time.process_time()
    quiet = quiet_line(still, task, options.seed, options.quiet, options.json)
    said = alarms(quiet)
    print(f"quiet: {len(said)} false alarms in {len(quiet)} cycles", *said, sep="\n  ", flush=True)
    for name in options.effects:
        for size in options.sizes:
            warmth = size if name == "warm" else 0.0
            hidden = {} if warmth else {name: typical(library()[name], size)}
            there = with_world(settings, hidden)
            found, before_all, after_all = [], list[Result](), list[Result]()
            for i in range(options.lines):
                before = quiet[QUIET * i : QUIET * (i + 1)]
                if len(before) < QUIET or signals(before):
                    continue  # it was not quiet
                first = before[-1].cycle + 1
                later = range(first, first + PATIENCE)
                noticed, after = noticed_after(
                    before, results(there, task, options.seed, later, warmth)
                )
                found.append(noticed)
                before_all, after_all = [*before_all, *before], [*after_all, *after]
            soon = sum(n is not None and n <= SOON for n in found)
            print(
                f"{name} × {size:g}: within {SOON} in {soon} of {len(found)}: {found}; forecasts "
                f"err by {error_mm(before_all):.4f} → {error_mm(after_all):.4f} mm",
                flush=True,
            )
    print(f"{time.process_time() - begun_s:.0f} s of CPU")


if __name__ == "__main__":
    main()
