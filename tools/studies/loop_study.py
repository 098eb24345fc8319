"""Learning loop from the lab to the line in worlds whose physics the model lacks.

For each effect and size: cables of a world with that effect are run, `learn` and the gates process
the recordings, a candidate that passes is promoted, and further cables of the same world are run,
with the former and with the promoted model.  The same cables in a world without the effect show
the forecast error of a complete model.  `none` is such a world: nothing may be promoted there.  A
law outside the library (`outside_laws`; `outside` = the first ten, `later` = the others) is
searched for as by `cell learn --laws`, and so in every world with `--laws`.
With `--pictures` cables are filmed, and the commands `cell run`, `cell learn`, `cell promote` used.

    python -m tools.studies.loop_study [--effects air_drag air_drag+tip_mass none …]
        [--sizes 0.5 1 2] [--cables 6] [--seed 300] [--worlds 1] [--laws] [--json F] [--pictures]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import yaml

from cell.cable.effects import ActiveEffect, library
from cell.lab.data.cycles import RecordedCycle
from cell.lab.line.candidate import best_judged, section
from cell.lab.line.effect_fit import LearningResult
from cell.lab.line.learn import learn
from cell.lab.next.discover import laws_in
from cell.lab.next.suggest import (
    MOST_CANDIDATES,
    MOST_REQUESTED,
    distinguishing_motions,
    worth_measuring,
)
from cell.run.station import Task
from cell.settings import Settings, load_settings
from cell.settings.surroundings import Surroundings
from cell.study.data import Study
from cell.wiring.build import cell_task
from cell.wiring.twins import hidden_cable
from tools.processes import own_cpu_s
from tools.shipped_settings import FAKE, with_entries
from tools.studies.learn import CYCLE_S, LEARNING_S, PROMOTING_S, Commands, learned_from
from tools.worlds.fast_cell import (
    INSERTABLE_M,
    FastCycle,
    best_margin_m,
    fast_cycle,
    fast_measured,
    typical,
    with_world,
)
from tools.worlds.fast_truth import Errors
from tools.worlds.outside_laws import LATER, LAWS

#: Of a sharp camera, assumed: nodes at the bound that vision holds across the cable, the
#: end a seventh of a pixel off.  The default of `Errors` is a poor camera's.
SEEN = Errors(node_m=1.2e-5, across_m=4e-6, end_m=3e-5)
#: Least displacement of the tip at the opening for an effect to count, m.
SHIFT_M = 3e-4


@dataclass(frozen=True)
class LearnedWorld:
    """Results of the learning loop in one world.

    effect                  hidden in the world; two are joined by `+`
    named, tied, promoted   the effects that `learn` named, ties of the last, and whether the gates
                            passed; `failed` are the gates that did not
    asked                   number of motions that `learn` requested
    before, after, complete  of the later cables: with the former model, with the promoted one, and
                            in a world without the effect
    left_out                by the limit of work
    """

    effect: str
    size: float
    seed: int
    named: tuple[str, ...]
    tied: tuple[str, ...]
    asked: int
    promoted: bool
    failed: tuple[str, ...]
    before: Cables
    after: Cables | None
    complete: Cables
    learn_cpu_s: float
    left_out: tuple[str, ...] = ()

    @property
    def shift_m(self) -> float:
        """Error of the former model at the opening beyond that of a complete one, m."""
        return float(np.sqrt(max(self.before.error_m**2 - self.complete.error_m**2, 0.0)))

    def line(self) -> str:
        """One row of the table."""
        after = self.after.line() if self.after else "-"
        fate = "promoted" if self.promoted else f"not: {', '.join(self.failed) or 'nothing found'}"
        ties = f" (tied: {', '.join(self.tied)})" if self.tied else ""
        ties += f" asked {self.asked}" if self.asked else ""
        return (
            f"{self.effect:20s} × {self.size:<4g} shift {self.shift_m * 1e3:5.2f} mm  "
            f"{self.before.line()} → {after} (complete {self.complete.line()})  "
            f"{' + '.join(self.named)}{ties} {fate}  {self.learn_cpu_s:.0f} s"
            f"{' left out: ' + '; '.join(self.left_out) if self.left_out else ''}"
        )


@dataclass(frozen=True)
class Cables:
    """Outcomes of the cables of one world with one model.

    error_m   root mean square over cables of the forecast's largest error in the opening
    """

    insertable: int
    inserted: int
    missed: int
    error_m: float

    @staticmethod
    def of(
        outcomes: Sequence[str], margins_m: Sequence[float], errors_m: Iterable[float | None]
    ) -> Cables:
        """From the outcome of each cable, its best margin, and its error, if it has one."""
        could = [o for o, m in zip(outcomes, margins_m, strict=True) if m > INSERTABLE_M]
        known = [e for e in errors_m if e is not None and np.isfinite(e)]
        error_m = float(np.sqrt(np.mean(np.square(known)))) if known else float("inf")
        return Cables(len(could), could.count("inserted"), outcomes.count("missed"), error_m)

    def line(self) -> str:
        """Inserted cables of those that a perfect model could insert, and the error."""
        return f"{self.inserted}/{self.insertable} {self.error_m * 1e3:.3f} mm"


def world(
    settings: Settings, effect: str, size: float, cables: int, seed: int, laws: bool = False
) -> LearnedWorld:
    """Run one world from the first cable to the last."""
    parts = [] if effect == "none" else effect.split("+")
    known, task = LAWS | library(), cell_task(settings)
    there = tuple(known[name].active(**typical(known[name], size)) for name in parts)
    first, later = range(1, cables + 1), range(cables + 1, 2 * cables + 1)
    cycles = cycles_of(settings, task, seed, first, there)
    recorded = [recorded_cycle(task, k, c) for k, c in zip(first, cycles, strict=True)]
    begun_s = own_cpu_s()
    result, requested = _learn(settings, task, recorded, seed, there, laws)
    result, judgement = best_judged(result, settings)
    spent_s = own_cpu_s() - begun_s
    before = complete = _counted(cycles)
    after = None
    promoted = result.best is not None and judgement.fit_for_line
    if parts or promoted:
        complete = _complete(
            seed, cables, lambda: _counted(cycles_of(settings, task, seed, later, ()))
        )
        before = _counted(cycles_of(settings, task, seed, later, there)) if parts else complete
    if promoted:
        new = settings.model_copy(update={"model": section(result, settings.model)})
        after = _counted(cycles_of(new, cell_task(new), seed, later, there))
    return LearnedWorld(
        effect,
        size,
        seed,
        tuple(e.name for e in result.best.effects) if result.best else (),
        result.tied,
        requested,
        promoted,
        tuple(f"{g.name} ({g.text})" for g in judgement.gates if not g.passed),
        before,
        after,
        complete,
        spent_s,
        result.left_out,
    )


def _counted(cycles: Sequence[FastCycle]) -> Cables:
    return Cables.of(
        [c.outcome for c in cycles],
        [c.best_margin_m for c in cycles],
        [c.true_tip_error_m for c in cycles],
    )


def _learn(
    settings: Settings,
    task: Task,
    recorded: list[RecordedCycle],
    seed: int,
    there: Sequence[ActiveEffect],
    laws: bool,
) -> tuple[LearningResult, int]:
    """Result of learning from these cables and those measured because of ties, and their number."""
    surroundings, tried = Surroundings.read(FAKE), library()
    if laws or any(a.effect.name in LAWS for a in there):
        tried |= laws_in(
            Path(tempfile.mkdtemp(prefix="laws-")), [c.study for c in recorded]
        ).effects
    result = learn(recorded, task.cable, task.identification, tried, _progress_printer())
    for done in range(MOST_REQUESTED):
        if not result.tied:
            return result, done
        try:
            cable, rivals = result.baseline.cables[0], result.rivals()[:MOST_CANDIDATES]
            suggestion = distinguishing_motions(cable, rivals, surroundings)
        except ValueError:
            return result, done
        best = worth_measuring(suggestion)
        if best is None:
            return result, done
        number, motion = 1000 + done, best.motion.motion()
        hidden = replace(hidden_cable(settings, seed, number), effects=tuple(there))
        trial = fast_measured(settings, seed, number, motion, task=task, hidden=hidden, errors=SEEN)
        study = Study(f"m{number}", task.cable, task.arc_length_m, (trial,))
        measured = RecordedCycle(study.name, Path(study.name), study, None, None, None)
        recorded = [*recorded, measured]
        result = learn(recorded, task.cable, task.identification, tried, _progress_printer())
    return result, MOST_REQUESTED


def _progress_printer() -> Callable[[str], None]:
    """Callback that prints the current step and its CPU time, separately from the table."""
    begun_s = own_cpu_s()

    def report(text: str, done: int = 0, total: int = 0) -> None:
        print(f"  {own_cpu_s() - begun_s:6.1f} s  {text}", file=sys.stderr, flush=True)

    return report


_COMPLETE: dict[tuple[int, int], Cables] = {}


def _complete(seed: int, cables: int, made: Callable[[], Cables]) -> Cables:
    """The later cables in a world without an effect: the same for every effect."""
    if (seed, cables) not in _COMPLETE:
        _COMPLETE[seed, cables] = made()
    return _COMPLETE[seed, cables]


def recorded_cycle(task: Task, number: int, c: FastCycle) -> RecordedCycle:
    """A cycle as from `read_cycles`."""
    trials = [c.held, *([c.executed] if c.executed else [])]
    study = Study(f"c{number}", task.cable, task.arc_length_m, tuple(trials))
    return RecordedCycle(f"c{number}", Path(f"c{number}"), study, c.held, c.executed, None)


def cycles_of(
    settings: Settings,
    task: Task,
    seed: int,
    numbers: Iterable[int],
    there: Sequence[ActiveEffect],
) -> list[FastCycle]:
    """Cycles of numbered cables of a world with hidden effects."""
    complete = with_world(settings, {})
    return [
        fast_cycle(
            complete,
            seed,
            k,
            task=task,
            errors=SEEN,
            hidden=replace(hidden_cable(complete, seed, k), effects=tuple(there)),
        )
        for k in numbers
    ]


# --- with rendered pictures, by commands ----------------------------------------------------------


def world_of_pictures(
    folder: Path, effect: str, size: float, cables: int, seed: int
) -> LearnedWorld:
    """Run one world from the first cable to the last; the commands' output goes to a log."""
    folder.mkdir()
    parts = [] if effect == "none" else effect.split("+")
    config, plain = folder / "cell.yaml", folder / "complete.yaml"
    hidden = {name: typical(library()[name], size) for name in parts}
    for path, effects in ((config, hidden), (plain, {})):
        # films of all worlds are 40 GB, and nothing here needs them
        text = with_entries(FAKE, {"world.effects": effects, "recording": None})
        path.write_text(text, encoding="utf-8")
    with (folder / "log.txt").open("w") as log:
        usual_s = (cables * CYCLE_S, cables * LEARNING_S, PROMOTING_S, cables * CYCLE_S)
        commands = Commands(usual_s, log=log)
        before = _run_cell(commands, config, folder / "before", seed, cables)
        begun_s = own_cpu_s()
        code = learned_from(commands, folder, config)
        spent_s, file = own_cpu_s() - begun_s, folder / "candidate.yaml"
        candidate = yaml.safe_load(file.read_text("utf-8")) if file.exists() else {}
        promoted = code == 0 and bool(candidate)
        if promoted:
            commands.run("promote", file, "--config", config)
        complete = _complete(
            seed,
            cables,
            lambda: _run_cell(commands, plain, folder / "complete", seed + 1, cables),
        )
        after = None
        if promoted:
            after = _run_cell(commands, config, folder / "after", seed + 1, cables)
    return LearnedWorld(
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


def _run_cell(commands: Commands, config: Path, out: Path, seed: int, cables: int) -> Cables:
    """Outcome of the cables of a seed; forecast errors as the cell measures them."""
    words = ("--config", config, "--cycles", cables, "--seed", seed, "--out", out)
    commands.also_run(cables * CYCLE_S, "run", *words)
    results = [json.loads(f.read_text("utf-8")) for f in sorted(out.glob("*/result.json"))]
    settings = load_settings(config)
    return Cables.of(
        [r["outcome"] for r in results],
        [best_margin_m(settings, seed, r["cycle"]) for r in results],
        [r["prediction_error_m"] for r in results],
    )


# --- all of it ------------------------------------------------------------------------------------


def summary(worlds: Sequence[LearnedWorld]) -> list[str]:
    """Sentences on each criterion: class, error, insertions, no worsening, no useless promotion."""
    hidden = [w for w in worlds if w.effect != "none" and w.effect not in LAWS]
    shown = [w for w in hidden if w.shift_m > SHIFT_M]
    named = [w for w in shown if w.promoted and set(w.effect.split("+")) <= {*w.named, *w.tied}]
    right = [w for w in named if set(w.named) == set(w.effect.split("+"))]
    after = [(w.after, w.before, w.complete) for w in hidden if w.after is not None]
    good = sum(
        a.error_m <= 1.3 * complete.error_m or a.error_m <= 0.2 * b.error_m
        for a, b, complete in after
    )
    worse = sum(a.error_m > b.error_m + 1e-5 for a, b, _ in after)
    could, done = sum(a.insertable for a, *_ in after), sum(a.inserted for a, *_ in after)
    empty = [w for w in worlds if w.effect == "none"]
    outside = [w for w in worlds if w.effect in LAWS]
    pairs = [w for w in hidden if "+" in w.effect]
    return [
        f"shift above 0.3 mm: {len(shown)} of {len(hidden)} worlds; right class promoted in "
        f"{len(right)} of them, named or tied in {len(named)}",
        f"promoted: {len(after)}; error after ≤ 1.3 × a complete world's or ≥ 5 × lower in "
        f"{good}; worse than before in {worse}; inserted {done} of {could}",
        _three_times_lower("pairs", pairs),
        _three_times_lower("outside the library", outside),
        f"complete worlds: {len(empty)}; promoted in {sum(w.promoted for w in empty)}",
    ]


def _three_times_lower(title: str, worlds: Sequence[LearnedWorld]) -> str:
    """Number of worlds whose error fell to a third, or to that of a complete world."""
    can = [w for w in worlds if w.complete.error_m <= w.before.error_m / 3.0]
    lower = [w for w in worlds if w.after and w.after.error_m <= w.before.error_m / 3.0]
    return (
        f"{title}: {len(worlds)}; error ≥ 3 × lower in {len(lower)}, of the {len(can)} in which a "
        f"complete world's is so low in {len([w for w in lower if w in can])}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pictures", action="store_true", help="rendered ones, not nodes")
    parser.add_argument("--effects", nargs="*", default=["none", *library()])
    parser.add_argument("--sizes", nargs="*", type=float, help="times the typical strength")
    parser.add_argument("--cables", type=int, default=6)
    parser.add_argument("--seed", type=int)
    parser.add_argument("--worlds", type=int, default=1, help="of each effect and size")
    parser.add_argument("--laws", action="store_true", help="tried in every world of nodes")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    sizes = options.sizes or ([1.0] if options.pictures else [0.5, 1.0, 2.0])
    first = (2200 if options.pictures else 300) if options.seed is None else options.seed
    settings, folder = load_settings(FAKE), Path(tempfile.mkdtemp(prefix="loop-study-"))
    worlds = []
    several = {"outside": tuple(n for n in LAWS if n not in LATER), "later": LATER}
    effects = [f for e in options.effects for f in several.get(e, (e,))]
    each = [(e, s) for e in effects for s in (sizes if e != "none" else [0.0])]
    for (effect, size), seed in product(each, range(first, first + options.worlds)):
        begun_s, among = own_cpu_s(), (effect, size, options.cables, seed)
        if options.pictures:
            worlds.append(world_of_pictures(folder / f"{effect}-{size:g}-{seed}", *among))
        else:
            worlds.append(world(settings, *among, options.laws))
        print(f"{worlds[-1].line()}, all {own_cpu_s() - begun_s:.0f} s", flush=True)
        if options.json:
            options.json.write_text(json.dumps([asdict(w) for w in worlds], indent=1))
    print("\n".join(summary(worlds)))
    if options.pictures:
        print(f"records: {folder}")


if __name__ == "__main__":
    main()
