"""Diagnoses of studies with a known answer: verdicts compared with the truth, and CPU seconds.

    python -m tools.studies.diagnosis_study FILE.csv --made complete=100 one=100 pair=27
    python -m tools.studies.diagnosis_study FILE.csv --breadth complete=300 one=200 outside=100
    python -m tools.studies.diagnosis_study FILE.csv --rigs all=60 [--practice …] [--real]
    python -m tools.studies.diagnosis_study FILE.csv --table [--before EARLIER.csv]
                                            [--checks [--limit CHECK=VALUE …]]

Sources, each with kinds and how many of them:

    --made      usual studies (`made_studies.py`): `complete`; `step`, complete with a step of EI;
                `one` effect hidden; `unknown`, that effect removed from the library; `pair`;
                `mixed`, a pair whose second is removed; `prior`, with a wrong prior from a model
                of an earlier cable
    --breadth   the range of users' studies (`breadth_world.py`): `complete`, `one`, `outside`;
                --uneven, --pixel and --colour set a condition for all of them
    --rigs      imitated rigs (`rigs.py`), one effect hidden in each: `all` features, or one kind
                of rig; `complete=60` hides nothing
    --mujoco    made by MuJoCo (`mujoco_studies.py`): `complete`; `step` of EI; `mass`, 2 % at 60 %
    --practice, --real   of `../shared/data` next to the project; real ones have no known answer

Each study is a row of the file as soon as it is judged; existing rows are kept, so that a stopped
study goes on.  An effect counts as seen if an ideal test that knows the truth detects it (power
0.8, `known_truth.py`).  With --checks the table also has the effect of each check of the verdict
(`check_ablation.py`).  A study that the lab refuses with an error is `refused`.  Ends with 1 if any
claimed effect is absent.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import stats

from cell.api.lab import diagnosed, examined, set_up
from cell.cable.solver import DivergedError
from cell.cable.statics import UnsettledError
from cell.files.input_error import InputError
from cell.lab.data.noise_model import NoiseUnknownError
from cell.lab.data.results import MissingEffect
from tools.processes import own_cpu_s
from tools.studies import check_ablation
from tools.studies.answers import StudyAnswer
from tools.studies.rows import added_rows, read_rows
from tools.worlds.cases import BREADTH, MADE, MUJOCO, RIGS, SHARED, Case, MadeStudy, made


def judged(case: Case, checks: bool) -> StudyAnswer:
    """Make a study and diagnose it; a crash is an outcome, and counts."""
    blank = StudyAnswer(case.source, case.kind, case.number, "", "", 0.0, "not made")
    try:
        with made(case) as there:
            return _diagnose(case, there, checks)
    except (DivergedError, UnsettledError) as error:
        return replace(blank, refused=_short(error))
    except Exception as error:
        return replace(blank, verdict="crash", refused=f"{type(error).__name__}: {_short(error)}")


def _diagnose(case: Case, there: MadeStudy, checks: bool) -> StudyAnswer:
    names, unsaid = "+".join(there.hidden), "+".join(there.unsaid)
    row = StudyAnswer(
        case.source, case.kind, case.number, names, unsaid, round(there.power, 3), "refused"
    )
    row = replace(row, conditions=json.dumps(there.conditions))
    before_s = own_cpu_s()
    try:
        fits = set_up(there.folder, there.selection, there.prior)
        examination = examined(fits)
        diagnosis = diagnosed(examination, there.folder).diagnosis
    except (InputError, NoiseUnknownError) as error:
        return replace(
            row, refused=_short(error, there.folder), cpu_s=round(own_cpu_s() - before_s, 2)
        )
    noise_m = diagnosis.noise_m if np.isnan(there.noise_m) else there.noise_m
    errors = [diagnosis.baseline.fit_rms_m, diagnosis.baseline.heldout_rms_m]
    row = replace(
        row,
        verdict=diagnosis.verdict,
        named=_join_names(diagnosis.missing),
        partial=_join_names(diagnosis.partial),
        warnings=" ".join(w.code for w in diagnosis.warnings),
        noise_ratio=round(diagnosis.noise_m / noise_m, 3),
        error_ratio=round(float(np.nanmax(errors)) / noise_m, 3),
        simulated_s=round(fits.work.simulated_s),
        cpu_s=round(own_cpu_s() - before_s, 2),
        values=json.dumps(_values(diagnosis.missing)),
        knots=str(diagnosis.knots),
    )
    if not checks:
        return row
    values, accepted = check_ablation.ended_at(examination)
    return replace(row, statistics=json.dumps(values), accepted=accepted)


def _values(effects: Sequence[MissingEffect]) -> dict[str, float]:
    """Values of all parameters of effects, by `effect.parameter`."""
    named = {f"{m.effect}.{n}": e.value for m in effects for n, e in m.parameters.items()}
    return {name: float(f"{value:.5g}") for name, value in named.items()}


def _join_names(effects: Sequence[MissingEffect]) -> str:
    return "+".join("|".join((m.effect, *m.tied_with)) for m in effects)


def _short(error: Exception, folder: Path | str = "") -> str:
    return str(error).replace(str(folder) or "\0", "").replace("\n", " ")[:200]


def cases(options: argparse.Namespace) -> list[Case]:
    """All studies that the options request, in order."""
    listed: list[Case] = []
    changed = {n: v for n in CHANGED if (v := getattr(options, n)) is not None}
    for source in ("made", "breadth", "rigs", "mujoco"):
        for kind, count in getattr(options, source):
            if source == "breadth":
                of_all = (options.seed, count, changed)
                listed += [Case(source, kind, str(n), *of_all) for n in range(count)]
            else:
                seeds = range(options.first, options.first + count)
                listed += [Case(source, kind, str(seed)) for seed in seeds]
    if options.practice is not None:
        truth = json.loads((SHARED / "practice" / "truth.json").read_text(encoding="utf-8"))
        listed += [Case("practice", "all", name) for name in options.practice or truth]
    if options.real:
        folders = sorted((SHARED / "real").glob("*/study.yaml"))
        listed += [Case("real", "all", f.parent.name) for f in folders]
    return listed


def run(file: Path, wanted: Sequence[Case], workers: int, checks: bool = False) -> None:
    """Diagnose the studies that the file lacks."""
    done = {(r.source, r.kind, r.number) for r in read_rows(file, StudyAnswer)}
    todo = [c for c in wanted if (c.source, c.kind, c.number) not in done]
    for count, row in enumerate(added_rows(file, StudyAnswer, _rows(todo, workers, checks)), 1):
        print(f"{count:4d} of {len(todo)}  {row.source} {row.kind} {row.number} "
              f"{row.hidden or 'nothing'}: {row.verdict} {row.named} {row.warnings} "
              f"{row.refused} ({row.cpu_s:.0f} s)", flush=True)  # fmt: skip


def _rows(todo: Sequence[Case], workers: int, checks: bool) -> Iterator[StudyAnswer]:
    """Rows as they are computed; with one worker in this process, to count its own CPU seconds."""
    if workers == 1:
        yield from (judged(case, checks) for case in todo)
        return
    with ProcessPoolExecutor(workers) as pool:
        for future in as_completed([pool.submit(judged, case, checks) for case in todo]):
            yield future.result()


#: Conditions of breadth studies by which their rows are counted: name, and predicate.
BINS: dict[str, Callable[[dict[str, float]], bool]] = {
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
    "gripper log 30–120 Hz": lambda c: c["log_hz"] < 120,
    "gripper log 120–500 Hz": lambda c: c["log_hz"] >= 120,
    "noise 0.02–0.1 %": lambda c: c["noise"] < 1e-3,
    "noise 0.1–0.5 %": lambda c: c["noise"] >= 1e-3,
    "6–35 cm": lambda c: c["length_m"] < 0.35,
    "0.35–2 m": lambda c: c["length_m"] >= 0.35,
}
COLUMNS = ("studies", "seen", "right", "wrong", "named right", "right in part", "complete",
           "unexplained", "cannot_tell", "noise unknown", "refused")  # fmt: skip


def counts(rows: Iterable[StudyAnswer]) -> dict[str, int]:
    """Counts of verdicts and warnings of detectable studies; studies and wrong ones of all."""
    made = [r for r in rows if r.verdict != "not made"]
    detectable = [r for r in made if r.detectable]
    verdicts = [r.verdict for r in detectable]
    return dict(zip(COLUMNS, (
        len(made), len(detectable), sum(r.right for r in detectable), sum(r.wrong for r in made),
        sum(bool(r.hidden) and r.names_all(r.named) for r in detectable),
        sum(r.right_in_part for r in detectable),
        *(verdicts.count(v) for v in ("complete", "unexplained", "cannot_tell")),
        sum("noise_unknown" in r.warnings for r in detectable), verdicts.count("refused"),
    ), strict=True))  # fmt: skip


def table(rows: Sequence[StudyAnswer], before: Sequence[StudyAnswer] = ()) -> Iterator[str]:
    """Lines of a table in Markdown, CPU seconds, and every verdict that differs from before."""
    yield "| studies | " + " | ".join(COLUMNS) + " | right, 95 % |"
    yield "|---|" + "---|" * (len(COLUMNS) + 1)
    for source, kind in dict.fromkeys((r.source, r.kind) for r in rows):
        here = [r for r in rows if (r.source, r.kind) == (source, kind)]
        yield _line(f"{source} {kind}", here)
        if source == "breadth":
            drawn = [(r, json.loads(r.conditions)) for r in here if r.conditions != "{}"]
            for name, holds in BINS.items():
                yield _line(f"{kind}, {name}", [r for r, c in drawn if holds(c)])
    timed = [r for r in rows if r.cpu_s > 0.0]
    if timed:
        some = np.percentile([r.cpu_s for r in timed], [50, 95, 100])
        yield ("\nCPU of a diagnosis: median {:.1f} s, 95 % within {:.1f} s, longest {:.1f} s "
               "of {}").format(*some, len(timed))  # fmt: skip
        for r in sorted(timed, key=lambda r: -r.cpu_s)[:5]:
            yield f"  {r.cpu_s:6.1f} s  {r.source} {r.kind} {r.number} ({r.hidden}): {r.verdict}"
    yield f"crashes: {sum(r.verdict == 'crash' for r in rows)}"
    earlier = {(r.source, r.kind, r.number): r for r in before}
    for r in rows:
        was = earlier.get((r.source, r.kind, r.number), r)
        if (was.verdict, was.named, was.partial) != (r.verdict, r.named, r.partial):
            yield (f"  {r.source} {r.kind} {r.number} ({r.hidden}): {was.verdict} {was.named} "
                   f"{was.partial} -> {r.verdict} {r.named} {r.partial}")  # fmt: skip


def _line(name: str, rows: Sequence[StudyAnswer]) -> str:
    count = counts(rows)
    sure = "–"
    if count["seen"]:
        interval = stats.binomtest(count["right"], count["seen"]).proportion_ci()
        sure = f"{interval.low:.0%} … {interval.high:.0%}"
    return f"| {name} | " + " | ".join(str(count[c]) for c in COLUMNS) + f" | {sure} |"


#: Conditions that an option sets in all breadth studies.
CHANGED = ("uneven", "pixel", "colour")


def kinds(known: Sequence[str]) -> Callable[[str], tuple[str, int]]:
    """Type of an option KIND=COUNT."""

    def read_one(text: str) -> tuple[str, int]:
        kind, _, count = text.partition("=")
        if kind not in known or not count.isdecimal():
            raise argparse.ArgumentTypeError(f"{text!r}: give KIND=COUNT, KIND of {known}")
        return kind, int(count)

    return read_one


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    for name, known in (("made", MADE), ("breadth", BREADTH), ("rigs", RIGS), ("mujoco", MUJOCO)):
        parser.add_argument(f"--{name}", nargs="+", type=kinds(known), default=[])
    parser.add_argument("--practice", nargs="*", metavar="NAME", help="default: all of them")
    parser.add_argument("--real", action="store_true")
    parser.add_argument("--first", type=int, default=0, help="seed of the first study")
    parser.add_argument("--seed", type=int, default=1, help="of the breadth's conditions")
    for name in CHANGED:
        parser.add_argument(f"--{name}", type=float)
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--table", action="store_true", help="of the file as it is")
    parser.add_argument("--before", type=Path, help="an earlier file: verdicts that differ")
    parser.add_argument("--checks", action="store_true", help="what each check is worth, too")
    parser.add_argument("--limit", nargs="*", default=[], metavar="CHECK=VALUE")
    options = parser.parse_args()
    if not options.table:
        run(options.file, cases(options), options.workers, options.checks)
    rows = read_rows(options.file, StudyAnswer)
    for line in table(rows, read_rows(options.before, StudyAnswer) if options.before else ()):
        print(line)
    if options.checks:
        limits = {
            name: float(value) for name, _, value in (v.partition("=") for v in options.limit)
        }
        with_values = [r for r in rows if r.statistics != "{}" or r.verdict == "refused"]
        print("", *check_ablation.table(with_values, limits), sep="\n")
    return 1 if any(r.wrong or r.verdict == "crash" for r in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
