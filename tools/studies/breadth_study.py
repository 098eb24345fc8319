"""What the lab says of studies over the breadth of what users bring; a table by condition.

    python -m tools.studies.breadth_study FILE.csv [--complete 200] [--one 100] [--outside 50]
                                          [--seed 1] [--uneven 0.6] [--pixel 8] [--colour 0.92]
    python -m tools.studies.breadth_study FILE.csv --table [--beside EARLIER.csv]

With `--beside` the table has both files' shares, and the power of a study that stands in the
earlier file is not worked out again.

`complete` studies lack nothing.  `one` hides an effect of the library, `outside` one that is taken
out of it (even numbers) or that it never had (`outside_laws.py`); both move the markers by 5 … 50
times the noise.  Each study is a row of the file as soon as it is judged; rows that are there
already are kept, so that a stopped study goes on.  Two processes work side by side.

With `--uneven` each marker of each trial has noise of its own level, up to 1.8 times more or less.
With `--pixel` all values are rounded, to steps of so many standard deviations of their noise.
With `--colour` the noise of neighbouring frames has such a correlation, as in tracks that were
filtered.

Only effects that a test which knows the truth would see (power 0.8, as in `confusion_study.py`)
count as seen.  A study that the lab refuses, with an error that says why, is `refused`.
"""

from __future__ import annotations

import argparse
import csv
import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType

import numpy as np
from scipy import stats

from cell.cable.effects import Effect, library
from cell.cable.solver import DivergedError
from cell.cable.statics import UnsettledError
from cell.files.input_error import InputError
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.lab.data.named_effects import EffectSelection
from cell.lab.data.noise_model import NoiseUnknownError
from cell.lab.data.opened_study import open_study
from cell.lab.data.prepared import all_fitted
from cell.lab.data.results import Diagnosis
from cell.lab.search.setup import fit_cache_of
from cell.lab.verdict.diagnose import diagnose
from cell.study.folder import write_study
from tools.studies.confusion_study import ONE_CLASS, evidence, power_of, without_noise
from tools.worlds.breadth_world import Conditions, World, hypercube
from tools.worlds.outside_laws import LAWS

KINDS = ("complete", "one", "outside")
#: Conditions that an option makes the same in all studies.
CHANGED = ("uneven", "pixel", "colour")
SEEN = 0.8


@dataclass(frozen=True)
class Row:
    """A study and what was said of it.

    hidden    the effect, or empty
    reached   its rms shift of the markers over the noise
    power     of a test that knows the truth
    named     what is claimed, or named with `cannot_tell` (so where no trial is held out): ties
              joined by "|", effects by "+"
    """

    kind: str
    number: int
    hidden: str
    reached: float
    power: float
    verdict: str
    named: str
    warnings: str
    noise_ratio: float
    error_ratio: float
    simulated_s: float
    cpu_s: float
    refused: str

    @property
    def seen(self) -> bool:
        return self.kind == "complete" or self.power >= SEEN

    @property
    def noise_unknown(self) -> bool:
        """Whether the lab says that the rest tells too little of the noise."""
        return self.verdict == "refused" or "noise_unknown" in self.warnings

    @property
    def right(self) -> bool:
        if self.kind == "complete":
            return self.verdict == "complete"
        if self.kind == "outside":
            return self.verdict == "unexplained"
        return self.verdict == "missing" and self.found

    @property
    def found(self) -> bool:
        """Whether just the hidden effect is named, claimed or not, or is tied with what is."""
        named = self.named.split("+")
        return len(named) == 1 and bool(self._alike & {*named[0].split("|")})

    @property
    def wrong(self) -> bool:
        """Whether something is claimed that is not there."""
        named = [{*n.split("|")} for n in self.named.split("+")]
        return self.verdict == "missing" and any(not self._alike & n for n in named)

    @property
    def _alike(self) -> set[str]:
        """The hidden effect and what no motion tells from it."""
        return set(ONE_CLASS) if self.hidden in ONE_CLASS else {self.hidden}


def judged(kind: str, conditions: Conditions, seed: int, known_power: float | None = None) -> Row:
    """Make a study and diagnose it.

    known_power  of a test that knows the truth, if it was worked out before
    """
    world = World.of(conditions, seed)
    known = library()
    offered, there, power, reached = dict(known), "", 0.0, 0.0
    if kind == "complete":
        clean = world.clean()
    else:
        effect, offered = _hidden(kind, conditions.number, known)
        there = effect.name
        try:
            _, clean, reached = world.showing(effect)
        except (DivergedError, UnsettledError) as error:  # no cable swings so: nothing to judge
            return _unmade(kind, conditions, there, str(error))
        power = known_power
        if power is None:
            power = _power(world, clean, seed, len(known))
    began = time.process_time()
    found, refused, simulated_s = Diagnosis(np.nan, None, "cannot_tell"), "", 0.0  # type: ignore[arg-type]
    with TemporaryDirectory() as folder:
        write_study(world.study(clean, seed), Path(folder))
        try:
            fits = fit_cache_of(open_study(Path(folder)), EffectSelection((), offered))
            found = diagnose(fits).diagnosis
            simulated_s = fits.prepared.work.simulated_s
        except (InputError, NoiseUnknownError) as error:
            refused = str(error).replace(folder, "").replace("\n", " ")[:200]
    verdict = "refused" if refused else found.verdict
    errors = [] if refused else [found.baseline.fit_rms_m, found.baseline.heldout_rms_m]
    named = "+".join("|".join((m.effect, *m.tied_with)) for m in found.missing)
    return Row(
        kind, conditions.number, there, round(reached, 2), round(power, 3), verdict, named,
        " ".join(w.code for w in found.warnings),
        round(found.noise_m / _true_noise_m(conditions), 3),
        round(float(np.nanmax(errors)) / _true_noise_m(conditions), 3) if errors else np.nan,
        round(simulated_s), round(time.process_time() - began, 1), refused,
    )  # fmt: skip


def _true_noise_m(conditions: Conditions) -> float:
    """With what rounding adds to it."""
    return conditions.noise_m * float(np.sqrt(1.0 + conditions.pixel**2 / 12.0))


def _hidden(
    kind: str, number: int, known: dict[str, type[Effect]]
) -> tuple[type[Effect], dict[str, type[Effect]]]:
    """The effect of a study, and those that the lab is offered."""
    names = sorted(known)
    if kind == "one":
        return known[names[number % len(names)]], dict(known)
    if number % 2:
        laws = sorted(LAWS)
        return LAWS[laws[number // 2 % len(laws)]], dict(known)
    effect = known[names[number // 2 % len(names)]]
    gone = ONE_CLASS if effect.name in ONE_CLASS else {effect.name}
    return effect, {n: e for n, e in known.items() if n not in gone}


def _power(world: World, clean: Sequence[np.ndarray], seed: int, tests: int) -> float:
    conditions = world.conditions
    study = all_fitted(world.study(clean, seed, quiet=True))
    rounding = conditions.pixel**2 / 12.0
    noise = Noise(_true_noise_m(conditions), conditions.colour, white=rounding / (1.0 + rounding))
    quiet = without_noise(study, noise)
    return power_of(evidence(quiet, ParameterSpace.of(study.cable)), quiet, tests)


def _unmade(kind: str, conditions: Conditions, hidden: str, why: str) -> Row:
    """Of a world that cannot be simulated."""
    return Row(kind, conditions.number, hidden, 0.0, 0.0, "not made", "", "", np.nan, np.nan, 0,
               0.0, why.replace("\n", " ")[:200])  # fmt: skip


def _judge(task: tuple[str, Conditions, int, float | None]) -> Row:
    try:
        return judged(*task)
    except Exception as error:  # a crash is an outcome, and counts
        kind, conditions, *_ = task
        return Row(kind, conditions.number, "", 0.0, 0.0, "crash", "", "", np.nan, np.nan, 0, 0.0,
                   f"{type(error).__name__}: {error}".replace("\n", " ")[:200])  # fmt: skip


def run(
    file: Path,
    counts: dict[str, int],
    seed: int,
    workers: int,
    beside: Path | None = None,
    changed: Mapping[str, float] = MappingProxyType({}),
) -> None:
    """Judge what the file lacks.

    changed  conditions that are the same in all studies
    """
    powers = {(r.kind, r.number): r.power for r, _ in read(beside)} if beside else {}
    done = {(r.kind, r.number) for r, _ in read(file)} if file.exists() else set()
    tasks = [
        (kind, replace(conditions, **changed), seed, powers.get((kind, conditions.number)))
        for place, kind in enumerate(KINDS)
        for conditions in hypercube(counts[kind], 100 * seed + place)
        if (kind, conditions.number) not in done
    ]
    names = [f.name for f in fields(Row)] + [
        f.name for f in fields(Conditions) if f.name != "number"
    ]
    with file.open("a", newline="") as out, ProcessPoolExecutor(workers) as pool:
        writer = csv.DictWriter(out, names)
        if out.tell() == 0:
            writer.writeheader()
        waiting = {pool.submit(_judge, task): task for task in tasks}
        for count, future in enumerate(as_completed(waiting), 1):
            row, conditions = future.result(), waiting[future][1]
            told = {k: v for k, v in asdict(conditions).items() if k != "number"}
            writer.writerow(asdict(row) | {k: _short(v) for k, v in told.items()})
            out.flush()
            print(f"{count:4d} of {len(tasks)}  {row.kind} {row.number} {row.hidden}: "
                  f"{row.verdict} {row.named} {row.warnings} {row.refused} ({row.cpu_s:.0f} s)",
                  flush=True)  # fmt: skip


def _short(value: object) -> object:
    return float(f"{value:.4g}") if isinstance(value, float) else value


def read(file: Path) -> list[tuple[Row, dict[str, float]]]:
    """Rows of a file, each with its conditions."""
    out = []
    with file.open(newline="") as lines:
        for line in csv.DictReader(lines):
            told = {f.name: _value(line[f.name], f.type) for f in fields(Row)}
            rest = {f.name: line.get(f.name, "0") for f in fields(Conditions) if f.name != "number"}
            numbers = {k: float(v == "True") if v in ("True", "False") else float(v)
                       for k, v in rest.items()}  # fmt: skip
            out.append((Row(**told), numbers))
    return sorted(out, key=lambda r: (KINDS.index(r[0].kind), r[0].number))


def _value(text: str, kind: object) -> object:
    return {"int": int, "float": float}.get(str(kind), str)(text)


#: Conditions of the table: name, what is asked of the conditions.
BINS: dict[str, Callable[[dict[str, float]], bool]] = {
    "all": lambda c: True,
    "1 marker": lambda c: c["markers"] == 1,
    "2–3 markers": lambda c: 2 <= c["markers"] <= 3,
    "4–11 markers": lambda c: c["markers"] >= 4,
    "6–19 rest frames": lambda c: c["rest_frames"] < 20,
    "20–39 rest frames": lambda c: 20 <= c["rest_frames"] < 40,
    "40–200 rest frames": lambda c: c["rest_frames"] >= 40,
    "1 trial": lambda c: c["trials"] == 1,
    "2–8 trials, none held out": lambda c: c["trials"] > 1 and not c["held_out"],
    "held-out trials": lambda c: c["held_out"] == 1,
    "30–100 frames/s": lambda c: c["rate_hz"] < 100,
    "100–500 frames/s": lambda c: c["rate_hz"] >= 100,
    "AR(1) 0–0.35": lambda c: c["colour"] < 0.35,
    "AR(1) 0.35–0.7": lambda c: c["colour"] >= 0.35,
    "not rounded": lambda c: c["pixel"] == 0,
    "rounded to 1–2 times the noise": lambda c: 0 < c["pixel"] <= 2,
    "rounded to 2–4 times the noise": lambda c: c["pixel"] > 2,
    "droop 0.5–3": lambda c: c["droop"] < 3,
    "droop 3–20": lambda c: c["droop"] >= 3,
    "hand log 30–120 Hz": lambda c: c["log_hz"] < 120,
    "hand log 120–500 Hz": lambda c: c["log_hz"] >= 120,
    "noise 0.02–0.1 %": lambda c: c["noise"] < 1e-3,
    "noise 0.1–0.5 %": lambda c: c["noise"] >= 1e-3,
    "6–35 cm": lambda c: c["length_m"] < 0.35,
    "0.35–2 m": lambda c: c["length_m"] >= 0.35,
}
COLUMNS = ("complete", "complete: noise unknown", "complete: effect named",
           "complete: unexplained", "one: named right", "one: claimed wrong",
           "outside: unexplained", "outside: claimed")  # fmt: skip


def table(rows: Iterable[tuple[Row, dict[str, float]]]) -> dict[str, list[str]]:
    """Of each condition the shares of `COLUMNS`."""
    out = {}
    told = list(rows)
    for name, holds in BINS.items():
        here = [r for r, c in told if holds(c) and r.seen]
        of = {k: [r for r in here if r.kind == k] for k in KINDS}
        hits = {
            "complete": [r.right for r in of["complete"]],
            "complete: noise unknown": [r.noise_unknown for r in of["complete"]],
            "complete: effect named": [bool(r.named) for r in of["complete"]],
            "complete: unexplained": [r.verdict == "unexplained" for r in of["complete"]],
            "one: named right": [r.found for r in of["one"]],
            "one: claimed wrong": [r.wrong for r in of["one"]],
            "outside: unexplained": [r.right for r in of["outside"]],
            "outside: claimed": [r.wrong for r in of["outside"]],
        }  # fmt: skip
        out[name] = [f"{sum(hits[c])}/{len(hits[c])}" for c in COLUMNS]
    return out


def print_table(file: Path, beside: Path | None) -> None:
    """As a table in Markdown; of an earlier file the shares stand before an arrow."""
    after = table(read(file))
    before = table(read(beside)) if beside else {}
    print("| condition | " + " | ".join(COLUMNS) + " |")
    print("|---|" + "---|" * len(COLUMNS))
    for name, cells in after.items():
        pairs = zip(before.get(name, cells), cells, strict=True)
        print(f"| {name} | " + " | ".join(
            b if not beside else f"{a} → {b}" for a, b in pairs) + " |")  # fmt: skip
    rows = [r for r, _ in read(file)]
    print(
        f"\ncrashes: {sum(r.verdict == 'crash' for r in rows)}; CPU: median "
        f"{np.median([r.cpu_s for r in rows]):.0f} s, longest {max(r.cpu_s for r in rows):.0f} s"
    )
    false = [r for r in rows if r.kind == "complete" and not r.right]
    count = sum(r.kind == "complete" for r in rows)
    sure = stats.binomtest(len(false), count).proportion_ci()
    print(f"complete studies not called complete: {len(false)} of {count} "
          f"({sure.low:.1%} … {sure.high:.1%})")  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    for kind, count in zip(KINDS, (200, 100, 50), strict=True):
        parser.add_argument(f"--{kind}", type=int, default=count)
    parser.add_argument("--seed", type=int, default=1)
    for name in CHANGED:
        parser.add_argument(f"--{name}", type=float)
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--beside", type=Path)
    given = parser.parse_args()
    if not given.table:
        counts = {kind: getattr(given, kind) for kind in KINDS}
        asked = {name: getattr(given, name) for name in CHANGED}
        changed = {name: value for name, value in asked.items() if value is not None}
        run(given.file, counts, given.seed, given.workers, given.beside, changed)
    print_table(given.file, given.beside)
    return 0


if __name__ == "__main__":
    sys.exit(main())
