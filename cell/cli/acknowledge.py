"""The command by which a person acknowledges faults: acknowledge."""

from __future__ import annotations

import getpass
import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.ledger import LedgerPlace, ledger_errors, open_ledger
from cell.cli.shared import AsJson, MaybeConfig, group, refusing
from cell.cli.streams import emit

if TYPE_CHECKING:
    from cell.records.ledger.ledger import ListedCycle

app = group()


def _user() -> str:
    """Who is logged in; a service may have no name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "somebody"


def _ended_by_fault(faults: Sequence[ListedCycle], folder: Path) -> ListedCycle:
    """The cycle of a folder, or that of its name: records may be on other computers.

    raises  ValueError: there is none; or several lines have one of this name
    """
    named = [c for c in faults if c.folder.name == folder.name]
    found = [c for c in named if c.folder.resolve() == folder] or named
    if not found:
        raise ValueError(f"{folder.name}: no cycle of this name was ended by a fault")
    if len(found) > 1:
        lines = " and of ".join(c.line for c in found)
        raise ValueError(f"{folder.name}: is a cycle of {lines}; say which line with --config")
    return found[0]


@app.command()
def acknowledge(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(help="Folders of failed cycles; default: the newest failed cycle."),
    ] = None,
    *,
    by: Annotated[str | None, typer.Option(help="Who; default: who is logged in.")] = None,
    note: Annotated[str, typer.Option(help="What was found, what was done.")] = "",
    everything: Annotated[
        bool, typer.Option("--all", help="All faults that nobody has acknowledged.")
    ] = False,
    config: MaybeConfig = None,
    ledger: LedgerPlace = None,
    as_json: AsJson = False,
) -> None:
    """Acknowledge that a fault was looked at: who, when, and what was done about it.

    It is kept in the ledger beside the fault, and in the cycle's folder; `cell history --open`
    lists faults that nobody has acknowledged.  An acknowledgement moves nothing: after a fault the
    next `cell run` begins anew.

    Exit codes: 0; 2 if there is no such fault, or the ledger cannot be used.
    """
    from cell.records.folder import acknowledge_record
    from cell.records.ledger.entry import Acknowledgement
    from cell.records.ledger.ledger import LedgerQuery
    from cell.settings import load_settings
    from cell.settings.provenance import line_name

    with refusing(), ledger_errors():
        if everything and folders:
            raise ValueError("give folders or --all, not both")
        settings = None if config is None else load_settings(config)
        line = None if settings is None else line_name(settings)
        said = Acknowledgement(datetime.now(UTC), by or _user(), note)
        with open_ledger(settings, ledger, create=True, must_exist=True) as listed:
            wanted = LedgerQuery(line=line, fault="", acknowledged=None if folders else False)
            faults = listed.listed(wanted)
            chosen = faults if everything else faults[-1:]
            if folders:
                each = [_ended_by_fault(faults, folder.resolve()) for folder in folders]
                chosen = list({c.uid: c for c in each}.values())
            if not chosen:
                raise ValueError("no fault is open: every one was acknowledged, or there was none")
            for cycle in chosen:
                if cycle.folder.is_dir():  # records of other computers, and removed ones, are not
                    acknowledge_record(cycle.folder, said.by, note)
            listed.acknowledge(chosen, said)
    data = [
        {"folder": str(c.folder), "fault": c.fault.code, "cause": c.fault.cause, **said.to_json()}
        for c in chosen
        if c.fault is not None
    ]
    if as_json:
        emit(json.dumps(data, indent=2, ensure_ascii=False))
        return
    for one in data:
        print(f"acknowledged by {said.by}: {one['fault']}: {one['cause']}: {one['folder']}")
