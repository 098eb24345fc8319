"""Benchmark of hidden effects: claims of this lab and its peers about studies with a known truth.

    python -m tools.studies.benchmark_effects FOLDER --seed SEED [--share 0.1] [--entrants NAME …]
                              [--claims NAME=FILE.csv …] [--table FILE.csv] [--search]

The full benchmark has 300 studies, over the conditions of the Validation page: 100 complete, 120
with one effect, 40 with a pair and 40 with a law outside the library.  A sixth, but of no pairs, is
by MuJoCo, which shares no code with the model; the others are by this project's engine on meshes
that are extrapolated.  A study is drawn again if an ideal test misses its effect (power < 0.8).

Entrants (`entrants.py`) run one by one, each in a separate process.  Its only input is a copy of
one study, in random order and with anonymous names; the folder, with `truth.csv`, and all other
processes are hidden from it.  External entrants provide a file of claims on FOLDER/studies, with
columns `study`, `claim`, `probability`; a claim is `complete`, `outside`, or effects joined by `+`,
with `|` between tied ones.  Existing results are kept, so that a stopped benchmark goes on.

A claim counts if its probability is at least 0.5, and no tie has more than four members; else the
entrant abstains.  It is *in part* right if it names only hidden effects, but not all.  Any other
false statement is *wrong*: also `complete` or `outside`, if an effect of the library is hidden.
Log score: mean of ln p of the truth, where the members of a tie share p, and all claims of at most
two effects share the remaining probability.  Intervals: 95 %, Clopper–Pearson.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from math import comb, nan
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import yaml
from scipy.stats import binomtest

from cell.cable.effects import library
from cell.cable.solver import DivergedError
from cell.cable.statics import UnsettledError
from tools.studies import entrants
from tools.studies.answers import StudyAnswer
from tools.studies.entrants import ENTRANTS, Claims
from tools.studies.rows import added_rows, read_rows, write_measured
from tools.worlds.cases import Case, made
from tools.worlds.known_truth import SHOWS

ROOT = Path(__file__).parents[2]
FULL = {"complete": 100, "one": 120, "pair": 40, "outside": 40}
#: Kinds of the worlds by class of the hidden effects; one in `BY_MUJOCO` of these is by MuJoCo.
KINDS = {"complete": "complete", "one": "one", "pair": "pair", "outside": "law"}
BY_MUJOCO, ATTEMPTS, SEEDS = 6, 20, 10_000
THRESHOLDS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.985, 0.995)
USUAL = 0.5
#: Largest tie of a claim: an entrant that names more effects abstains.
MOST_TIED = 4
#: Weight of a uniform guess in every log score, which makes it finite.
GUESS = 1e-3
OUTCOMES = ("right", "in part", "abstained", "wrong")
#: Time limit of an entrant for a study, s of wall clock.
PATIENCE_S = 1800.0
#: The truth is hidden before the entrant's code is loaded.
CHILD = """
import sys; from pathlib import Path; from cell.computer.confinement import hide
name, study, result, secret = sys.argv[1:]; hide(Path(secret))
from tools.studies.benchmark_effects import enter; enter(name, Path(study), Path(result))
"""


@dataclass(frozen=True)
class Truth:
    """Truth of a study: class and names of hidden effects, joined by "+", and how to make it."""

    study: str
    hidden: str
    effects: str
    source: str
    kind: str
    number: str
    seed: int
    power: float
    conditions: str


@dataclass(frozen=True)
class Entry:
    """Claims of an entrant about a study, as JSON; `failed`: why it has none."""

    study: str
    entrant: str
    versions: str
    claims: str
    cpu_s: float
    failed: str = ""


def cases(seed: int, share: float, changed: dict[str, float]) -> Iterator[tuple[str, str, Case]]:
    """Name, class and case of the studies: a share of each class, in random order."""
    listed = []
    for hidden, count in FULL.items():
        for i in range(count):
            by_mujoco = hidden != "pair" and i % BY_MUJOCO == BY_MUJOCO - 1 and not changed
            source, number = ("mujoco", i // BY_MUJOCO) if by_mujoco else ("breadth", i)
            listed.append((hidden, Case(source, KINDS[hidden], str(number), seed, count, changed)))
    remaining = {hidden: max(1, round(share * count)) for hidden, count in FULL.items()}
    for place, i in enumerate(np.random.default_rng([seed, 6]).permutation(len(listed))):
        hidden, case = listed[i]
        remaining[hidden] -= 1
        if remaining[hidden] >= 0:
            yield f"study_{place:03d}", hidden, case


def make_studies(folder: Path, wanted: Iterable[tuple[str, str, Case]]) -> list[Truth]:
    """Make the missing studies of the folder, and list their truths in `truth.csv`."""
    folder.mkdir(parents=True, exist_ok=True)
    by_name = {each[0]: each for each in wanted}
    done = {t.study for t in read_rows(folder / "truth.csv", Truth)}
    rows = (_made(folder, *each) for name, each in by_name.items() if name not in done)
    for truth in added_rows(folder / "truth.csv", Truth, rows):
        print(f"{truth.study} is made", flush=True)
    return [t for t in read_rows(folder / "truth.csv", Truth) if t.study in by_name]


def _made(folder: Path, name: str, hidden: str, case: Case) -> Truth:
    """Make a study with a detectable effect, with further seeds if necessary."""
    for attempt in range(ATTEMPTS):
        again, study = replace(case, seed=case.seed + SEEDS * attempt), folder / "studies" / name
        with suppress(DivergedError, UnsettledError), made(again) as there:
            if there.power >= SHOWS:
                shutil.copytree(there.folder, study, dirs_exist_ok=True)
                header = yaml.safe_load((study / "study.yaml").read_text(encoding="utf-8"))
                text = yaml.safe_dump(header | {"name": name}, sort_keys=False)
                (study / "study.yaml").write_text(text, encoding="utf-8")
                effects, power = "+".join(there.hidden), round(there.power, 4)
                return Truth(name, hidden, effects, case.source, case.kind, case.number,
                             again.seed, power, json.dumps(dict(there.conditions)))  # fmt: skip
    raise RuntimeError(f"{name}: {ATTEMPTS} seeds from {case.seed} show nothing; take another one")


def enter(name: str, study: Path, result: Path) -> None:
    """Write the claims of an entrant about a study; in an isolated process."""
    from tools.processes import own_cpu_s

    before_s, claims, failed = own_cpu_s(), Claims(), ""
    try:
        claims = ENTRANTS[name][0](study)
    except Exception as error:  # whatever it is: it claims nothing
        failed = f"{type(error).__name__}: {str(error).replace(str(study), '')[:200]}"
    cpu_s = round(own_cpu_s() - before_s, 2)
    rounded = {claim: round(p, 6) for claim, p in claims.items()}
    result.write_text(json.dumps({"claims": rounded, "failed": failed, "cpu_s": cpu_s}))


def entered(name: str, study: Path, secret: Path, child: str = CHILD) -> Entry:
    """An entrant's claims about a copy of a study, from a process without access to `secret`."""
    env = {k: os.environ[k] for k in ("PATH", "HOME", "LANG") if k in os.environ}
    with TemporaryDirectory() as root:
        copy, result = Path(root) / "study", Path(root) / "result.json"
        shutil.copytree(study, copy)
        try:
            subprocess.run(
                [sys.executable, "-c", child, name, copy, result, secret], cwd=root,
                timeout=PATIENCE_S, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                env={**env, "PYTHONPATH": str(ROOT), "TMPDIR": root, "OPENBLAS_NUM_THREADS": "1"},
            )  # fmt: skip
            data = json.loads(result.read_text(encoding="utf-8"))
        except subprocess.TimeoutExpired:
            data = {"claims": {}, "failed": f"takes more than {PATIENCE_S:g} s", "cpu_s": nan}
        except subprocess.CalledProcessError as error:
            raise RuntimeError(f"{name} does not run: {error.stderr.decode()[-500:]}") from error
    claims = json.dumps(data["claims"])
    return Entry(study.name, name, versions(name), claims, data["cpu_s"], data["failed"])


def versions(name: str) -> str:
    """Packages of an entrant, with versions.  Raises PackageNotFoundError."""
    return " ".join(f"{package} {version(package)}" for package in ENTRANTS[name][1])


def run(folder: Path, truths: Sequence[Truth], names: Sequence[str]) -> dict[str, str]:
    """Run entrants on the studies without their claims; reasons of skipped entrants, by name."""
    skipped = {}
    for name in names:
        try:
            versions(name)
        except PackageNotFoundError as error:
            skipped[name] = f"{error.name} is not installed"
    file = folder / "claims.csv"
    done = {(e.study, e.entrant) for e in read_rows(file, Entry)}
    pairs = [(t.study, n) for t in truths for n in names if n not in skipped]
    todo = [pair for pair in pairs if pair not in done]
    rows = (entered(name, folder / "studies" / study, folder) for study, name in todo)
    began_s = time.monotonic()
    for count, entry in enumerate(added_rows(file, Entry, rows), 1):
        remaining_min = (time.monotonic() - began_s) / count * (len(todo) - count) / 60.0
        best = max(json.loads(entry.claims).items(), key=lambda c: c[1], default=("–", nan))
        print(f"{count} of {len(todo)}  {entry.study} {entry.entrant}: {best[0]} {best[1]:.2f} "
              f"{entry.failed} ({entry.cpu_s:.0f} s; about {remaining_min:.0f} min left)",
              flush=True)  # fmt: skip
    return skipped


def read_claims(name: str, file: Path, truths: Sequence[Truth]) -> list[Entry]:
    """An entrant's own file: study, claim, probability.  Raises ValueError: a wrong line."""
    claims: dict[str, Claims] = {t.study: {} for t in truths}
    with file.open(newline="", encoding="utf-8") as lines:
        for number, line in enumerate(csv.DictReader(lines), 2):
            claim, p = line["claim"], float(line["probability"])
            of_library = library().keys() >= {*claim.replace("+", "|").split("|")}
            if not (0.0 <= p <= 1.0 and (of_library or claim in ("complete", "outside"))):
                raise ValueError(f"{file}:{number}: {claim!r} {p}: give a probability of 0 to 1, "
                                 f"and `complete`, `outside` or names of {list(library())}, joined "
                                 "by + and |")  # fmt: skip
            claims.setdefault(line["study"], {})[claim] = p
    return [Entry(study, name, file.name, json.dumps(c), nan) for study, c in claims.items()]


def judged(truth: Truth, claim: str) -> str:
    """Whether a claim is `right`, `in part` or `wrong`; `abstained` if its ties are too wide."""
    if any(part.count("|") >= MOST_TIED for part in claim.split("+")):
        return "abstained"
    verdict = {"complete": "complete", "outside": "unexplained"}.get(claim, "missing")
    named = claim if verdict == "missing" else ""
    row = StudyAnswer("", truth.hidden, "", truth.effects, "", 1.0, verdict, named)
    if row.right:
        return "right"
    in_part = verdict == "missing" and bool(truth.effects) and not row.names_other(named)
    return "in part" if in_part else "wrong"


def outcome(truth: Truth, claims: Claims, threshold: float = USUAL) -> str:
    """The outcome of the likeliest claim; `abstained` if it is less likely than a threshold."""
    claim, p = max(claims.items(), key=lambda c: c[1], default=("", -1.0))
    return judged(truth, claim) if p >= threshold else "abstained"


def log_score(truth: Truth, claims: Claims) -> float:
    """ln p of the truth."""
    effects, total = len(library()), max(1.0, sum(claims.values()))
    uniform = 1.0 / (2 + effects + comb(effects, 2))
    p = uniform * max(0.0, 1.0 - sum(claims.values()))
    for claim, probability in claims.items():
        if judged(truth, claim) == "right":
            members = np.prod([part.count("|") + 1 for part in claim.split("+")])
            p += probability / total / float(members)
    return float(np.log((1.0 - GUESS) * p + GUESS * uniform))


def scores(truths: Sequence[Truth], entries: Sequence[Entry]) -> list[dict[str, object]]:
    """Rows by entrant, class of study and threshold: counts, intervals, log score, CPU seconds."""
    by_study, rows = {t.study: t for t in truths}, []
    for name in dict.fromkeys(e.entrant for e in entries):
        mine = [(by_study[e.study], json.loads(e.claims), e) for e in entries
                if e.entrant == name and e.study in by_study]  # fmt: skip
        for hidden in ("all", *FULL):
            here = [row for row in mine if hidden in ("all", row[0].hidden)]
            for threshold in THRESHOLDS if hidden == "all" else (USUAL,):
                if here:
                    rows.append(_score(name, hidden, threshold, here))
    return rows


def _score(name: str, hidden: str, threshold: float, here: Sequence[tuple]) -> dict[str, object]:
    outcomes = [outcome(truth, claims, threshold) for truth, claims, _ in here]
    counts = {o.replace(" ", "_"): outcomes.count(o) for o in OUTCOMES}
    ends = {}
    for of in ("right", "wrong"):
        interval = binomtest(counts[of], len(here)).proportion_ci(method="exact")
        ends |= {f"{of}_low": round(interval.low, 3), f"{of}_high": round(interval.high, 3)}
    each = [log_score(truth, claims) for truth, claims, _ in here]
    return {"condition": name, "hidden": hidden, "threshold": threshold, "n": len(here), **counts,
            **ends, "log_score": round(float(np.mean(each)), 3),
            "cpu_s": round(float(np.median([e.cpu_s for *_, e in here])), 1),
            "versions": here[0][2].versions}  # fmt: skip


def table(rows: Sequence[dict[str, object]]) -> Iterator[str]:
    """Lines in Markdown, at the usual threshold."""
    yield ("| entrant | studies | n | right (95 %) | in part | abstained | wrong (95 %) | "
           "log score | CPU s |")  # fmt: skip
    yield "|---" * 9 + "|"
    for r in (r for r in rows if r["threshold"] == USUAL):
        right, wrong = (
            f"{r[o]} ({r[o + '_low']:.0%} … {r[o + '_high']:.0%})" for o in ("right", "wrong")
        )
        yield (f"| {r['condition']} | {r['hidden']} | {r['n']} | {right} | {r['in_part']} | "
               f"{r['abstained']} | {wrong} | {r['log_score']} | {r['cpu_s']} |")  # fmt: skip


def search(folder: Path, truths: Sequence[Truth]) -> Iterator[str]:
    """Claims of PySINDy with other settings, a line each."""
    by_settings: dict[tuple[float, float, int], list[tuple[str, float]]] = {}
    for truth, frames in itertools.product(truths, (7, 11, 21)):
        fits = entrants.fits_of(folder / "studies" / truth.study)
        if (regressed := entrants.accelerations(fits, frames)) is None:
            continue
        for threshold, ridge in itertools.product((0.02, 0.05, 0.1, 0.2, 0.4), (1e-3, 0.05, 1.0)):
            claims = entrants.selected(fits, *regressed, threshold, ridge)
            result = outcome(truth, claims), log_score(truth, claims)
            by_settings.setdefault((threshold, ridge, frames), []).append(result)
    for settings, results in by_settings.items():
        outcomes, logs = zip(*results, strict=True)
        counts = {o: outcomes.count(o) for o in OUTCOMES}
        yield f"PySINDy {settings}: {counts}, log score {np.mean(logs):.2f}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, required=True, help="younger than all entrants")
    parser.add_argument("--share", type=float, default=1.0, help="of the full benchmark")
    parser.add_argument("--changed", type=json.loads, default={}, help="conditions of all studies")
    parser.add_argument("--entrants", nargs="+", choices=ENTRANTS, default=list(ENTRANTS))
    parser.add_argument("--claims", nargs="*", default=[], metavar="NAME=FILE.csv")
    parser.add_argument("--table", type=Path, help="write the scores, as of docs/measured")
    parser.add_argument("--search", action="store_true", help="PySINDy with other settings instead")
    options = parser.parse_args()
    wanted = cases(options.seed, options.share, options.changed)
    truths = make_studies(options.folder, wanted)
    if options.search:
        print(*search(options.folder, truths), sep="\n")
        return 0
    skipped = run(options.folder, truths, options.entrants)
    entries = read_rows(options.folder / "claims.csv", Entry)
    for name, _, file in (c.partition("=") for c in options.claims):
        entries += read_claims(name, Path(file), truths)
    rows = scores(truths, entries)
    print(*table(rows), *(f"| {n} | skipped: {why} |" for n, why in skipped.items()), sep="\n")
    if options.table:
        arguments = f"FOLDER --seed {options.seed} --share {options.share:g}"
        write_measured(options.table, rows, f"make benchmark-effects ARGS='{arguments}'")
    return 0


if __name__ == "__main__":
    sys.exit(main())
