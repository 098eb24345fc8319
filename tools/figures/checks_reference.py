"""The reference of checks and warnings in docs/lab.md, written from the tables that the lab reads.

python -m tools.figures.checks_reference
"""

from __future__ import annotations

from pathlib import Path

from cell.lab.verdict.checks import CHECKS
from cell.lab.verdict.doubts import MEANINGS
from cell.lab.verdict.thresholds import DEFAULT_RULES

PAGE = Path(__file__).parents[2] / "docs" / "lab.md"
BEGIN, END = "<!-- checks: begin -->", "<!-- checks: end -->"
#: Codes of warnings in files of versions before.
OLD_CODES = {
    "heldout_insensitive": "unconfirmed",
    "weakly_identified": "barely_seen",
    "possibly_omitted": "suspected",
    "prior_driven": "prior_only",
    "wider_law": "other_law",
}


def reference() -> str:
    """Tables in Markdown."""
    lines = ["| check | question | passes if | if not |", "|---|---|---|---|"]
    for c in CHECKS:
        limit = f"{c.unit} {c.passes} {getattr(DEFAULT_RULES, c.limit):g}"
        lines.append(f"| `{c.name}` | {c.question} | {limit} | `{c.failing}` |")
    lines += ["", "What a check that fails says, and why its limit is what it is:", ""]
    for c in CHECKS:
        code = OLD_CODES.get(c.name)
        old = f" In files of earlier versions: `{code}`." if code else ""
        lines.append(f"- `{c.name}`: {c.failed} Judged by {c.reason}.{old}")
    lines += ["", "Warnings that come of no check:", ""]
    lines += ["| code | what was found | verdict |", "|---|---|---|"]
    for code, (meaning, verdict) in MEANINGS.items():
        lines.append(f"| `{code}` | {meaning} | {f'`{verdict}`' if verdict else '–'} |")
    return "\n".join(lines)


def page(text: str) -> str:
    """The page with the reference in its place."""
    before, _, rest = text.partition(BEGIN)
    after = rest.partition(END)[2]
    return f"{before}{BEGIN}\n\n{reference()}\n\n{END}{after}"


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
