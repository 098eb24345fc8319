"""Commands about studies: study gathers and writes tables, look shows one before any fit."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.arguments import folder_of, folders_of
from cell.cli.output import Json, JsonCommand, deliver_result
from cell.cli.printing import show
from cell.cli.shared import (
    ALL_DONE,
    NOT_ALL_DONE,
    STDOUT,
    Force,
    group,
    refusing,
    tell_notes,
    working,
)
from cell.files.overwriting import check_new_study
from cell.files.words import counted

if TYPE_CHECKING:
    from cell.files.table import TableData
    from cell.lab.report.look_page import StudyOverview

app = group()


@app.command()
def study(
    runs: Annotated[
        list[Path],
        typer.Argument(
            help="Folders of recorded cycles, recordings, or studies.", callback=folders_of
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder of the new study.")
    ] = None,
    csv: Annotated[
        Path | None,
        typer.Option(
            "--csv",
            help="Folder for a wide CSV table of each trial, and the mapping with which "
            "`cell import` reads them again.",
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Gather recorded cycles of one cable into a study, or write a study as wide tables."""
    from cell.lab.data.cycles import measured
    from cell.lab.data.merge_studies import merge_studies
    from cell.study.folder import write_study
    from cell.study.imports.write import write_wide

    with refusing(), working("study"):
        if out is None and csv is None:
            raise ValueError("--out is missing: name the folder of the new study, or --csv")
        if out is not None:
            check_new_study(out, force=force)
        if csv is not None and csv.exists() and any(csv.iterdir()) and not force:
            raise ValueError(f"{csv}: is not empty; give another folder, or --force to write there")
        found, left_out = measured(runs)
        name = out.name if out is not None else runs[0].name
        gathered = merge_studies(found, name)
        if out is not None:
            write_study(gathered, out)
        tables = [] if csv is None else write_wide(gathered, csv)
    tell_notes(gathered.notes)
    for line in left_out:
        print(f"left out: {line}", file=sys.stderr)
    if out is not None:
        trials = counted(len(gathered.trials), "trial")
        print(f"{out}: {trials} of {counted(len(runs) - len(left_out), 'cycle')}")
    if csv is not None:
        print(f"{csv}: {len(tables) - 1} tables, and import.yaml to read them again")


@app.command("look", cls=JsonCommand)
def look_at_study(
    study: Annotated[
        Path,
        typer.Argument(
            help="A study: a folder with study.yaml, a recorded cycle's folder, or its recording.",
            callback=folder_of,
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Write the page to this file.")
    ] = None,
    open_it: Annotated[
        bool, typer.Option("--open", help="Open the page with the computer's browser.")
    ] = False,
    as_json: Json = None,
    force: Force = False,
) -> None:
    """Look at a study before any fit: shapes, tip, gripper, spectrum, and what is odd.

    A study that is refused is shown too, with what must be mended.  Exit codes: 0; 1 if something
    must be mended; 2 if there is nothing to be shown.
    """
    from functools import partial

    from cell.files.page import write_page
    from cell.lab.report.look_page import FACT_NOTE, facts_table, look_page
    from cell.lab.report.wrench_report import wrench_facts_table

    page = out or (Path("look.html") if open_it else None)
    with refusing(page, as_json, force=force), working("look"):
        look = _look(study)

    def parts() -> Iterator[str | TableData]:
        yield from (facts_table(look), f"{FACT_NOTE}.")
        if look.wrenches:
            yield wrench_facts_table(look.wrenches)
        for head, lines in (("Odd:", look.odd), ("To be mended:", look.wrong)):
            yield from [head, *(f"  {s}" for s in lines)] if lines else []
        if not look.odd and not look.wrong:
            yield "Nothing is odd."

    file = page, partial(write_page, look_page(look))
    deliver_result(look.to_json(), [as_json], parts, file)
    if page is not None and as_json != STDOUT:
        show(f"{page}: pictures of every trial")
    if open_it and page is not None:
        typer.launch(str(page))
    raise typer.Exit(NOT_ALL_DONE if look.wrong else ALL_DONE)


def _look(folder: Path) -> StudyOverview:
    """A study as it is, with all that is known to be wrong and odd.  Raises InputError."""
    from cell.files.input_error import InputError
    from cell.lab.data.opened_study import open_study, rest_drifts
    from cell.lab.report.look_page import StudyOverview
    from cell.study.facts import facts_of
    from cell.study.folder import study_as_it_is, study_folder
    from cell.study.independence import Independence
    from cell.study.left_out import notes_of_samples
    from cell.study.record_checks import oddities
    from cell.study.wrench import wrench_facts

    study, problems = study_as_it_is(study_folder(folder))
    notes = list(study.notes)
    wrong, independence = [str(p) for p in problems], None
    if not wrong:
        try:
            notes += notes_of_samples(study)
            independence = Independence.of(open_study(folder))
        except InputError as error:
            wrong = [str(p) for p in error.problems]
    facts = facts_of(study.trials, study.arc_length_m, study.gravity_m_per_s2)
    wrenches = [w for t in study.trials if (w := wrench_facts(t)) is not None]
    odd = [*notes, *map(str, rest_drifts(study)), *oddities(facts, study.noise_std_m)]
    title = f"A look at {study.name}"
    return StudyOverview(
        study.name, title, study.trials, facts, {}, wrong, odd, wrenches, independence
    )
