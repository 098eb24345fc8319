"""Recordings identified again, as sentences and tables."""

from __future__ import annotations

from pathlib import Path

from cell.files.table import TableData
from cell.files.words import counted
from cell.lab.line.identify_all import IdentifiedAll

#: What is said of each way in which a result stands beside that of then.
_COMPARED = {
    "same": "the same values, bit for bit",
    "within": "every value within its 95 % interval of then",
    "outside": "a value outside its 95 % interval of then",
    "other model": "other parameters than then",
    "lost": "identified then, and not now",
    "nothing": "nothing was identified then",
}
_TEXT = 60


def identified_parts(found: IdentifiedAll, table: Path) -> list[str | TableData]:
    """All that is printed, in its order."""
    counts = ", ".join(f"{count} {name}" for name, count in sorted(found.outcomes.items()))
    known = f" ({found.known} known from before)" if found.known else ""
    return [
        f"{found.done} of {counted(found.recordings, 'recording')}{known}: "
        f"{counts or 'none'}; in {table}",
        *([_compared(found)] if found.done else []),
        *([_moved(found)] if found.moved else []),
        *([_unidentified(found)] if found.unidentified else []),
    ]


def _compared(found: IdentifiedAll) -> TableData:
    rows = [
        [said, str(found.compared[name])]
        for name, said in _COMPARED.items()
        if found.compared[name]
    ]
    return TableData("Beside what was identified then", ["now", "recordings"], rows, (1,))


def _moved(found: IdentifiedAll) -> TableData:
    rows = [[row.recording, row.moved, f"{row.moved_std:.2f}"] for row in found.moved]
    heads = ["recording", "parameter", "moved by"]
    note = "in standard deviations of then; the table has all"
    return TableData("What has moved most", heads, rows, (2,), note)


def _unidentified(found: IdentifiedAll) -> TableData:
    rows = [
        [row.recording, row.outcome, row.why if len(row.why) <= _TEXT else f"{row.why[:_TEXT]} …"]
        for row in found.unidentified
    ]
    count = found.done - found.outcomes["identified"]
    note = f"{len(rows)} of {count}; the table has all" if count > len(rows) else ""
    return TableData("Not identified", ["recording", "outcome", "why"], rows, (), note)
