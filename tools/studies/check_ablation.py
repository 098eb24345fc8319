"""Ablation of the checks of a verdict: verdicts of studies without each check.

For each study all checks are computed for the final model of the search, even after a failure.  So
the verdict without a check, or with a different limit, follows from the stored statistics.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from cell.lab.data.check import COMPARE, CheckOutcome, worst_verdict
from cell.lab.data.rules import DEFAULT_RULES
from cell.lab.verdict.checks import CHECKS
from cell.lab.verdict.conclusion import Examination
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.ties import with_ties
from tools.studies.answers import StudyAnswer


def ended_at(examination: Examination) -> tuple[dict[str, float], str]:
    """Statistics of the checks that have one, for the final model of the search, and its effects.

    Effects are joined by "+", ties by "|".
    """
    evidence = with_ties(Evidence(examination.fits, examination.accepted))
    readings = {check.name: check.evaluate(evidence).reading for check in CHECKS}
    values = {name: float(r.value) for name, r in readings.items() if r is not None}
    named = ("|".join((e.name, *evidence.tied.get(e.name, ()))) for e in evidence.added)
    return values, "+".join(named)


def verdict_of(
    row: StudyAnswer, without: str = "", limits: Mapping[str, float] | None = None
) -> str:
    """Verdict from a row's statistics, without a check or with other limits."""
    if row.verdict in ("refused", "crash", "not made"):
        return row.verdict
    values, outcomes = json.loads(row.statistics), []
    for check in CHECKS:
        if check.name == without:
            continue
        value = values.get(check.name, np.nan)
        limit = (limits or {}).get(check.name, getattr(DEFAULT_RULES, check.limit))
        passed = None if np.isnan(value) else bool(COMPARE[check.passes](value, limit))
        outcomes.append(CheckOutcome(check, None, passed))
    return worst_verdict(outcomes, is_base=not row.accepted)


def answer(row: StudyAnswer, verdict: str, named: str) -> str:
    """`right`, `wrong` (a false claim) or `no answer`."""
    claim = replace(row, verdict=verdict, named=named)
    if claim.right:
        return "right"
    false_alarm = verdict == "unexplained" and not row.hidden
    return "wrong" if claim.wrong or claim.false_complete or false_alarm else "no answer"


def table(rows: Sequence[StudyAnswer], limits: Mapping[str, float]) -> Iterator[str]:
    """Lines in Markdown: answers by kind with all checks, and without each.

    limits  other limits of checks, by name; a line each
    """
    counted = [r for r in rows if r.detectable and r.verdict not in ("crash", "not made")]
    kinds = list(dict.fromkeys(r.kind for r in counted))

    def with_checks(
        row: StudyAnswer, without: str = "", other: Mapping[str, float] | None = None
    ) -> str:
        if row.verdict == "refused":
            return "no answer"
        return answer(row, verdict_of(row, without, other), row.accepted)

    def line(name: str, answer_to: Callable[[StudyAnswer], str]) -> str:
        each = {k: [answer_to(r) for r in counted if r.kind == k] for k in kinds}
        cells = [f"{a.count('right')} / {a.count('wrong')} of {len(a)}" for a in each.values()]
        both = [(answer_to(r), with_checks(r)) for r in counted]
        better = sum(a == "right" and b != "right" for a, b in both)
        worse = sum(a != "right" and b == "right" for a, b in both)
        p = stats.binomtest(better, better + worse).pvalue if better + worse else 1.0
        return f"| {name} | " + " | ".join(cells) + f" | +{better} −{worse} | {p:.2g} |"

    yield "right / wrong of all, by kind; what changes in right answers; McNemar's p\n"
    yield "| without | " + " | ".join(kinds) + " | changed | p |"
    yield "|---" * (len(kinds) + 3) + "|"
    yield line("– (all checks)", with_checks)
    for check in CHECKS:
        yield line(check.name, lambda r, name=check.name: with_checks(r, name))
    for name, limit in limits.items():
        yield line(f"{name} {limit:g}", lambda r, o={name: limit}: with_checks(r, other=o))
