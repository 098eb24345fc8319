"""Commands about the records of past cycles: list, show, report."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from cell.cli.arguments import Runs, folder_of
from cell.cli.output import deliver, print_json
from cell.cli.printing import show as show_parts
from cell.cli.shared import AsJson, Force, group, refuse, refusing, working

app = group()


@app.command("list")
def list_cycles(
    runs: Annotated[
        Path, typer.Argument(help="Folder of the cycles: that of `cell run --runs`.")
    ] = Path("runs"),
    as_json: AsJson = False,
) -> None:
    """List past cycles, the newest last: outcome, offset, forecast error, pictures.

    Exit codes: 0, or 2 if the folder is wrong.
    """
    from cell.cli.cycle_tables import history_table
    from cell.files.input_error import InputError
    from cell.records.past_cycles import history

    try:
        past = history(runs)
    except InputError as error:
        refuse(error)
    if as_json:
        print_json([p.to_json() for p in past])
    elif past:
        show_parts(history_table(past), f"look at one: cell show {runs}/FOLDER")
    else:
        print(f"{runs}: has no cycles; `cell run --runs {runs}` records some")


@app.command()
def show(
    folder: Annotated[
        Path | None, typer.Argument(help="A cycle's folder; default: the newest.")
    ] = None,
    runs: Runs = Path("runs"),
    as_json: AsJson = False,
    pictures: Annotated[
        bool, typer.Option("--open", help="Open the pictures with the computer's viewer.")
    ] = False,
) -> None:
    """Show a past cycle: how it ended and why, the cable's parameters, times, pictures.

    Exit codes: 0, or 2 if the folder is wrong.
    """
    from cell.cli.cycle_tables import record_parts
    from cell.files.input_error import InputError
    from cell.records.folder import pictures_in, read_record
    from cell.records.past_cycles import newest

    try:
        record = read_record(newest(runs) if folder is None else folder)
    except InputError as error:
        refuse(error)
    images = pictures_in(record.folder)
    if as_json:
        result = None if record.result is None else record.result.to_json()
        content = {"folder": str(record.folder), "state": dict(record.state), "result": result}
        print_json({**content, "pictures": [str(image) for image in images]})
    else:
        show_parts(*record_parts(record, images))
    if pictures:
        for image in images:
            typer.launch(str(image))


@app.command()
def report(
    ctx: typer.Context,
    folder: Annotated[
        Path | None,
        typer.Argument(help="A cycle's folder or its recording; default: the newest."),
    ] = None,
    runs: Runs = Path("runs"),
    out: Annotated[Path, typer.Option("-o", "--out", help="Write the page to this file.")] = Path(
        "report.html"
    ),
    force: Force = False,
) -> None:
    """Write one HTML page of one cycle: result, film strip, path of the tip, decision, times.

    The page needs no network.  Exit codes: 0; 2 if the folder is wrong.
    """
    from cell.files.page import write_page
    from cell.records.cycle_page import cycle_page
    from cell.records.folder import read_record
    from cell.records.past_cycles import newest
    from cell.records.recording import form
    from cell.records.recording.reading import read_recording

    with refusing(out, force=force), working("report") as progress:
        given = newest(runs) if folder is None else folder
        film = given if given.is_file() else given / form.FILE
        record = read_record(folder_of(ctx, given))
        progress("drawing")
        page = cycle_page(record, read_recording(film) if film.exists() else None)
    deliver(lambda: None, (out, partial(write_page, page)))
    print(f"written to {out}")
