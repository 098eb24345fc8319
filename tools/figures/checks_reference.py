"""References of checks and warnings as Markdown, from the tables that the programs read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from cell.lab.data.check import Check
from cell.lab.data.thresholds import DEFAULT_RULES
from cell.lab.line.learning_checks import GATES, LEARNING, LineRules
from cell.lab.verdict.checks import CHECKS
from cell.lab.verdict.doubts import MEANINGS
from cell.study.checks import CHECKS as DATA_CHECKS

#: Codes of warnings in files of versions before.
OLD_CODES = {
    "heldout_insensitive": "unconfirmed",
    "weakly_identified": "barely_seen",
    "possibly_omitted": "suspected",
    "prior_driven": "prior_only",
    "wider_law": "other_law",
}


def table(checks: Sequence[Check[Any]], rules: object) -> list[str]:
    """Checks in Markdown: their limits, what a failure says, and why the limit is what it is."""
    lines = ["| check | question | passes if | if not |", "|---|---|---|---|"]
    for c in checks:
        limit = f"{c.unit} {c.passes} {getattr(rules, c.limit):g}"
        lines.append(f"| `{c.name}` | {c.question} | {limit} | `{c.failing}` |")
    lines += ["", "What a check that fails says, and why its limit is what it is:", ""]
    for c in checks:
        code = OLD_CODES.get(c.name)
        old = f" In files of earlier versions: `{code}`." if code else ""
        lines.append(f"- `{c.name}`: {c.failed} Judged by {c.reason}.{old}")
    return lines


def of_diagnosis() -> str:
    """The checks of a diagnosis, and its other warnings."""
    lines = table(CHECKS, DEFAULT_RULES)
    lines += ["", "Warnings that come of no check:", ""]
    lines += ["| code | what was found | verdict |", "|---|---|---|"]
    for code, (meaning, verdict) in MEANINGS.items():
        lines.append(f"| `{code}` | {meaning} | {f'`{verdict}`' if verdict else '–'} |")
    return "\n".join(lines)


def of_line() -> str:
    """The checks of what many cables teach, and the gates of a candidate."""
    return "\n".join(table((*LEARNING, *GATES), LineRules()))


def of_data() -> str:
    """The checks of a study's data: what is asked, how it is measured, what a failure says."""
    lines = ["| check | question | if not |", "|---|---|---|"]
    lines += [f"| `{c.name}` | {c.question} | {c.outcome} |" for c in DATA_CHECKS]
    lines += ["", "The statistic and its limit, and what a check that fails says:", ""]
    for c in DATA_CHECKS:
        sentence = re.sub(r"\{[^}]*\}", "…", f"{c.says} {c.remedy}".strip())
        lines.append(f"- `{c.name}`: {c.statistic}; limit {c.limit}. It says: {sentence}.")
    return "\n".join(lines)
