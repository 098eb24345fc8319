"""What every check of a verdict is worth: the verdicts of many studies with each left out.

    python -m tools.studies.ablation_study FILE.csv [--breadth complete=200 one=100 outside=50]
                                            [--made pair=27 unknown=34] [--seed 2]
    python -m tools.studies.ablation_study FILE.csv --table [--limit CHECK=VALUE …]

The studies are those of `diagnosis_study.py`.  Of each, all checks are computed for the model that
the search ended at, whatever failed before, and their statistics are kept.  So the verdict without
a check, or with another limit, is worked out of the file.  Next to the lab stand plain strategies
that a user might try instead: the smallest BIC of the models fitted, the smallest held-out error,
and the largest score of an effect alone (Holm, 1 %).

The table says for each check how many false alarms of complete studies, wrong claims and right
answers there are without it, and McNemar's p-value of the answers that change; and the same of
checks with another limit.
"""

from __future__ import annotations

import argparse
import csv
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy import stats

from cell.api.lab import set_up
from cell.cable.solver import DivergedError
from cell.cable.statics import UnsettledError
from cell.files.input_error import InputError
from cell.lab.data.check import COMPARE, Check, CheckOutcome, worst_verdict
from cell.lab.data.noise_model import NoiseUnknownError
from cell.lab.data.thresholds import DEFAULT_RULES
from cell.lab.diagnosis import diagnose
from cell.lab.fit.fitting import fit_trials
from cell.lab.fit.score_test import holm
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel
from cell.lab.verdict.checks import CHECKS
from cell.lab.verdict.conclusion import Examination
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.ties import with_ties
from tools.studies.diagnosis_study import cases, kinds
from tools.worlds.cases import BREADTH, MADE, Case, made
from tools.worlds.known_truth import SHOWS, class_of

KINDS = (*BREADTH, "pair", "unknown")
PLAIN = ("bic", "heldout", "score")


@dataclass(frozen=True)
class Row:
    """A study, the model that the search ended at, and the statistic of each check.

    hidden   effects joined by "+"
    named    effects of the model joined by "+", ties by "|"
    verdict  of the lab; `crash`, `refused`, `not made`
    """

    kind: str
    number: str
    hidden: str
    power: float
    verdict: str
    named: str
    bic: str = ""
    heldout: str = ""
    score: str = ""
    statistics: dict[str, float] = field(default_factory=dict)


def judged(case: Case) -> Row:
    """Make a study, diagnose it, and compute all checks."""
    blank = Row(case.kind, case.number, "", 0.0, "refused", "")
    try:
        with made(case) as there:
            examination = diagnose(set_up(there.folder, there.selection))
            return _row(case, "+".join(there.hidden), there.power, examination)
    except (DivergedError, UnsettledError):
        return replace(blank, verdict="not made")
    except (InputError, NoiseUnknownError):
        return blank


def _row(case: Case, there: str, power: float, examination: Examination) -> Row:
    fits = examination.fits
    base = fits.base
    evidence = with_ties(Evidence(fits, examination.accepted, DEFAULT_RULES))
    statistics = {}
    for check in CHECKS:
        reading = check.evaluate(evidence).reading
        statistics[check.name] = np.nan if reading is None else float(reading.value)
    named = "+".join("|".join((e.name, *evidence.tied.get(e.name, ()))) for e in evidence.added)
    return Row(case.kind, case.number, there, round(power, 3), examination.diagnosis.verdict, named,
               *_plain(fits, base), statistics)  # fmt: skip


def _plain(fits: FitCache, base: FittedModel) -> tuple[str, str, str]:
    """What plain strategies name."""
    known = fits.known()
    values = fits.prepared.count(fit_trials(fits.prepared))

    def bic(model: FittedModel) -> float:
        return model.fit.objective + len(model.fit.q) * float(np.log(values))

    def error(model: FittedModel) -> float:
        return model.heldout.rms_m if model.heldout else model.fit.rms_m

    def added(model: FittedModel) -> str:
        return "+".join(sorted(model.names - base.names))

    screened = fits.screened(base)
    adjusted = holm([s.score.p_value for s in screened])
    best = screened[0].effect.name if screened and adjusted[0] < DEFAULT_RULES.significance else ""
    return added(min(known, key=bic)), added(min(known, key=error)), best


def run(file: Path, wanted: Sequence[Case], workers: int) -> None:
    """Judge what the file lacks."""
    done = {(r.kind, r.number) for r in read(file)} if file.exists() else set()
    todo = [c for c in wanted if (c.kind, c.number) not in done]
    names = [*(n for n in Row.__dataclass_fields__ if n != "statistics"), *(c.name for c in CHECKS)]
    with file.open("a", newline="") as out, ProcessPoolExecutor(workers) as pool:
        writer = csv.DictWriter(out, names)
        if out.tell() == 0:
            writer.writeheader()
        waiting = {pool.submit(judged, c): c for c in todo}
        for count, future in enumerate(as_completed(waiting), 1):
            case = waiting[future]
            try:
                row = future.result()
            except Exception as error:  # a crash is an outcome, and counts
                row = Row(case.kind, case.number, f"{type(error).__name__}: {error}"[:200], 0.0,
                          "crash", "")  # fmt: skip
            data = asdict(row)
            statistics = {k: f"{v:.6g}" for k, v in data.pop("statistics").items()}
            writer.writerow(data | statistics)
            out.flush()
            print(f"{count:4d} of {len(todo)}  {row.kind} {row.number} {row.hidden}: "
                  f"{row.verdict} {row.named}", flush=True)  # fmt: skip


def read(file: Path) -> list[Row]:
    """Rows of a file."""
    names = [c.name for c in CHECKS]
    with file.open(newline="") as lines:
        return [
            Row(
                d["kind"],
                d["number"],
                d["hidden"],
                float(d["power"]),
                d["verdict"],
                d["named"],
                d["bic"],
                d["heldout"],
                d["score"],
                {n: float(d[n]) for n in names if d.get(n)},
            )
            for d in csv.DictReader(lines)
        ]


def verdict(row: Row, without: str = "", limits: dict[str, float] | None = None) -> str:
    """Of a row, by its statistics, without a check or with other limits."""
    if row.verdict in ("refused", "crash", "not made"):
        return row.verdict
    return _verdict_without(row, [c for c in CHECKS if c.name != without], limits or {})


def _verdict_without(row: Row, checks: Sequence[Check], limits: dict[str, float]) -> str:
    found = []
    for check in checks:
        value = row.statistics.get(check.name, np.nan)
        limit = limits.get(check.name, getattr(DEFAULT_RULES, check.limit))
        passed = None if np.isnan(value) else bool(COMPARE[check.passes](value, limit))
        found.append(CheckOutcome(check, None, passed))
    return worst_verdict(found, is_base=not row.named)


def answer(row: Row, said: str, named: str) -> str:
    """`right`, `wrong` (something is claimed that is not so) or `no answer`."""
    there = [class_of([h]) for h in row.hidden.split("+") if h]
    classes = [{*n.split("|")} for n in named.split("+") if n]
    if row.kind == "complete":
        return {"complete": "right", "missing": "wrong", "unexplained": "wrong"}.get(
            said, "no answer"
        )
    if row.kind in ("outside", "unknown"):
        return {"unexplained": "right", "missing": "wrong", "complete": "wrong"}.get(
            said, "no answer"
        )
    if said in ("missing", "complete"):
        others = any(not any(h & n for h in there) for n in classes)
        all_named = all(any(h & n for n in classes) for h in there)
        return "wrong" if others or not classes else "right" if all_named else "no answer"
    return "no answer"


def table(rows: list[Row], limits: Mapping[str, float]) -> str:
    """In Markdown: answers by kind, with every check, without each, and of plain strategies.

    limits  other limits of checks, by name; a line each
    """
    seen = [r for r in rows if r.power >= SHOWS]
    seen = [r for r in seen if r.verdict not in ("crash", "not made")]
    lines = ["| without | " + " | ".join(KINDS) + " | changed | p |", "|---" * 8 + "|"]

    def line(name: str, says: Callable[[Row], str]) -> str:
        of = {k: [says(r) for r in seen if r.kind == k] for k in KINDS}
        cells = [f"{a.count('right')} / {a.count('wrong')} of {len(a)}" for a in of.values()]
        both = [(says(r), usual(r)) for r in seen]
        better = sum(a == "right" and b != "right" for a, b in both)
        worse = sum(a != "right" and b == "right" for a, b in both)
        p = stats.binomtest(better, better + worse).pvalue if better + worse else 1.0
        return f"| {name} | " + " | ".join(cells) + f" | +{better} −{worse} | {p:.2g} |"

    def usual(row: Row) -> str:
        return answer(row, verdict(row), row.named)

    lines.append(line("– (all checks)", usual))
    for check in CHECKS:
        lines.append(line(check.name, lambda r, n=check.name: answer(r, verdict(r, n), r.named)))
    for name, limit in limits.items():
        other = {name: limit}
        lines.append(
            line(f"{name} {limit:g}", lambda r, o=other: answer(r, verdict(r, limits=o), r.named))
        )
    for plain in PLAIN:
        lines.append(line(f"plain: {plain}", lambda r, n=plain: _of_plain(r, getattr(r, n))))
    return "\n".join(lines)


def _of_plain(row: Row, named: str) -> str:
    if row.verdict == "refused":
        return "no answer"
    return answer(row, "missing" if named else "complete", named)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    for name, known in (("made", MADE), ("breadth", BREADTH)):
        parser.add_argument(f"--{name}", nargs="+", type=kinds(known), default=[])
    parser.add_argument("--first", type=int, default=2000, help="seed of made studies")
    parser.add_argument("--seed", type=int, default=2, help="of the breadth's conditions")
    parser.set_defaults(
        rigs=[], mujoco=[], practice=None, real=False, uneven=None, pixel=None, colour=None
    )
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--limit", nargs="*", default=[], metavar="CHECK=VALUE")
    given = parser.parse_args()
    if not given.table:
        run(given.file, cases(given), given.workers)
    print("right / wrong of all, by kind; what changes in right answers; McNemar's p\n")
    limits = {name: float(value) for name, _, value in (v.partition("=") for v in given.limit)}
    print(table(read(given.file), limits))
    return 0


if __name__ == "__main__":
    sys.exit(main())
