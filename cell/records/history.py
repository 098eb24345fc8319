"""Results of the cycles that a line has behind it."""

from __future__ import annotations

import json
from pathlib import Path

from cell.records.result import Outcome, Result

#: Newest cycles that are looked at.
MOST = 500
#: Cycles that tell of forecasts and fits.
TELLING = frozenset({Outcome.INSERTED, Outcome.MISSED, Outcome.REJECTED})


def line_history(runs: Path, model: str | None = None) -> list[Result]:
    """Results of the newest cycles in a folder, oldest first.

    model    hash of the section `model` that they were made with; None = any
    A result that cannot be read is left out: it was half written, or is another program's.
    """
    found = []
    for file in sorted(runs.glob("*/result.json"), key=lambda p: p.parent.name)[-MOST:]:
        try:
            result = Result.from_json(json.loads(file.read_text(encoding="utf-8")))
        except (OSError, ValueError, KeyError, TypeError):
            continue
        if model in (None, result.model) and result.outcome in TELLING:
            found.append(result)
    return found
