"""The command that packs what a maker needs after a failure: bundle."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cell.cli.arguments import Runs
from cell.cli.ledger import faults_json, open_ledger
from cell.cli.output import print_json
from cell.cli.shared import AsJson, Force, MaybeConfig, group, refusing, working
from cell.files.atomic import free_bytes
from cell.files.words import counted

if TYPE_CHECKING:
    from cell.records.bundle import Item
    from cell.settings.model import Settings

app = group()

#: Number of the newest cycles of the ledger that a bundle lists.
_LISTED = 1000


@app.command()
def bundle(
    cycles: Annotated[
        list[Path] | None,
        typer.Argument(help="Folders of cycles; default: the newest, see --newest."),
    ] = None,
    runs: Runs = Path("runs"),
    newest: Annotated[
        int, typer.Option("-n", "--newest", min=0, help="So many cycles, the newest ones.")
    ] = 3,
    config: MaybeConfig = None,
    recordings: Annotated[
        bool, typer.Option("--recordings/--no-recordings", help="With the frames, or without.")
    ] = True,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="File to write; default: bundle-TIME.zip.")
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Pack what the maker of the cell needs after a failure into one ZIP file.

    In it are the log, the settings with their calibration, effects and earlier models, the newest
    cycles with their recordings, what the ledger says, and the versions of all packages.  Passwords
    in URLs, and what is named password, secret or token, are removed from texts; look through the
    file before you send it.

    Exit codes: 0; 2 if the folder or the settings are wrong, and nothing is written.
    """
    from cell.files.input_error import InputError
    from cell.records.bundle import write_bundle
    from cell.settings import load_settings

    target = Path(f"bundle-{datetime.now():%Y%m%dT%H%M%S}.zip") if out is None else out
    with refusing(target, force=force), working("bundle") as progress:
        settings, unreadable = None, ""
        if config is not None:
            try:
                settings = load_settings(config)
            except InputError as error:  # may be what failed: they are packed as they are
                if not config.is_file():
                    raise
                unreadable = str(error)
        items = [
            *_of_program(unreadable),
            *_of_settings(config, settings),
            *_of_cycles(runs, cycles or [], newest, recordings),
            *_of_ledger(runs, settings),
        ]
        done = write_bundle(items, target, progress)
    size = target.stat().st_size
    if as_json:
        data: dict[str, Any] = {"file": str(target), "bytes": size, "files": dict(done.files)}
        data |= {"left_out": dict(done.left_out), "secrets_removed_from": list(done.cleaned)}
        print_json(data)
        return
    print(f"{target}: {counted(len(done.files), 'file')}, {size / 1e6:.1f} MB")
    for name in done.cleaned:
        print(f"a secret was removed from {name}")
    for name, why in done.left_out.items():
        print(f"left out: {name}: {why}")


def _of_program(unreadable: str) -> Iterator[Item]:
    from cell.cli.logs import about
    from cell.records.bundle import Item, packages

    lines = [about(), f"{os.cpu_count()} cores"]
    with suppress(OSError):
        lines.append(f"{free_bytes(Path.cwd()) / 1e9:.1f} GB free in {Path.cwd()}")
    yield Item("versions.txt", "\n".join([*lines, "", packages()]))
    if unreadable:
        yield Item("settings/errors.txt", unreadable + "\n")


def _of_settings(config: Path | None, settings: Settings | None) -> Iterator[Item]:
    from cell.records.bundle import Item
    from cell.settings.promotion import history_of
    from cell.settings.provenance import files_of

    if config is None:
        return
    yield Item(f"settings/{config.name}", config)
    for earlier in sorted(history_of(config).glob("*.yaml")):
        yield Item(f"settings/{earlier.parent.name}/{earlier.name}", earlier)
    if settings is not None:
        for number, path in enumerate(files_of(settings)):
            yield Item(f"settings/files/{number}/{Path(path).name}", Path(path))


def _of_cycles(runs: Path, named: list[Path], newest: int, recordings: bool) -> Iterator[Item]:
    from cell.files.input_error import InputError
    from cell.records.bundle import items_of_cycle, items_of_log
    from cell.records.folder import history, is_cycle

    for folder in named:
        if not is_cycle(folder):
            raise InputError.at(folder, "is no cycle's folder; `cell list` shows those there are")
    if not named:
        past = history(runs)
        named = [p.folder for p in past[len(past) - min(newest, len(past)) :]]
    yield from items_of_log(runs.with_name(f"{runs.name}.log"))
    for folder in named:
        yield from items_of_cycle(folder, recordings=recordings)


def _of_ledger(runs: Path, settings: Settings | None) -> Iterator[Item]:
    """Newest cycles and faults as the ledger lists them, and entries not yet written to it."""
    from cell.records.bundle import Item
    from cell.records.ledger.entry import LedgerError
    from cell.records.ledger.ledger import LedgerQuery, csv_text
    from cell.records.ledger.outbox import outbox_of

    url = None if settings is None or settings.ledger is None else settings.ledger.url
    try:
        with open_ledger(None, url or str(runs)) as ledger:
            everything = LedgerQuery()
            listed = ledger.listed(everything, _LISTED, estimates=True)
            faults = ledger.faults(everything)
    except LedgerError as error:
        yield Item("ledger/errors.txt", f"{error}\n")
    else:
        yield Item("ledger/cycles.csv", csv_text(listed))
        text = json.dumps(faults_json(faults), indent=2, ensure_ascii=False)
        yield Item("ledger/faults.json", text)
    for file in sorted(outbox_of(runs).glob("*")):
        yield Item(f"ledger/outbox/{file.name}", file)
