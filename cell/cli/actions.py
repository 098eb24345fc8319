"""The command that lists what people have done at the pages: actions."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from cell.cli.ledger import LedgerPlace, Since, ledger_errors, parse_time
from cell.cli.shared import AsJson, MaybeConfig, group, refusing
from cell.cli.streams import emit

app = group()


@app.command()
def actions(
    *,
    config: MaybeConfig = None,
    ledger: LedgerPlace = None,
    since: Since = None,
    most: Annotated[int, typer.Option("-n", "--most", min=1, help="The newest N.")] = 50,
    as_json: AsJson = False,
) -> None:
    """List what people have done at the pages: when, who, what, done or refused.

    `cell serve` takes them into the ledger from its log beside the records.

    Exit codes: 0; 2 if the ledger cannot be read.
    """
    from cell.records.ledger.actions import listed_actions
    from cell.settings import load_settings

    with refusing(), ledger_errors():
        place: str | Path = ledger or "runs"
        if ledger is None and config is not None:
            given = load_settings(config).ledger
            place = (given.url if given is not None else None) or place
        found = listed_actions(place, parse_time(since, datetime.now(UTC), "--since"), most)
    if as_json:
        emit(json.dumps([a.to_json() for a in found], indent=2, ensure_ascii=False))
        return
    for a in found:
        done = "" if a.done else "  refused"
        emit(f"{a.at:%Y-%m-%d %H:%M:%S}  {a.by}  {a.action}{done}  {a.note}".rstrip())
