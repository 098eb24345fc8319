"""Commands about studies: study gathers and writes tables, look shows one, power forecasts."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.arguments import Workers, folder_of, taking, workers
from cell.cli.lab import InModel, LineModel, Results, StudyFolder
from cell.cli.output import Json, JsonCommand, deliver_result, show
from cell.cli.shared import (
    ALL_DONE,
    NOT_ALL_DONE,
    STDOUT,
    Force,
    group,
    refusing,
    stoppable,
    tell_notes,
    working,
)
from cell.files.overwriting import check_new_study, check_not_read
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
            help="Folders of recorded cycles, recordings, or studies.", callback=folder_of
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
    from cell.lab.data.cycles import measured, merge_studies
    from cell.study.folder import write_study
    from cell.study.imports.write import write_wide

    with refusing(), working("study"):
        if out is None and csv is None:
            raise ValueError("--out is missing: name the folder of the new study, or --csv")
        if out is not None:
            check_not_read(out, [run.resolve() for run in runs])
            check_new_study(out, force=force)
        if csv is not None and csv.exists() and any(csv.iterdir()) and not force:
            raise ValueError(f"{csv}: is not empty; give another folder, or --force to write there")
        studies, left_out = measured(runs)
        name = out.name if out is not None else runs[0].name
        gathered = merge_studies(studies, name)
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
    study: StudyFolder,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Write the page to this file.")
    ] = None,
    open_it: Annotated[
        bool, typer.Option("--open", help="Open the page with the computer's browser.")
    ] = False,
    as_json: Json = None,
    force: Force = False,
) -> None:
    """Plot a study before any fit: shapes, tip, gripper, spectrum, and unusual data.

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
    """A study as it is, with all errors and oddities.  Raises InputError."""
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


@dataclass(frozen=True, kw_only=True)
class _Power:
    """Options of `cell power`."""

    study: StudyFolder
    effect: Annotated[
        list[str],
        typer.Option(
            "--try",
            help="NAME, NAME=SIZE or NAME.PARAMETER=SIZE of an effect of the library or of a "
            "file.py; SIZE in the parameter's unit.  Without SIZE: the smallest that is detected.  "
            "Repeat the option for more.",
        ),
    ]
    verify: Annotated[
        int | None,
        typer.Option(
            "--verify",
            help="Hide the effect in so many copies of the study, diagnose each, and print what "
            "resulted, next to the forecast.",
            min=1,
            max=10_000,
        ),
    ] = None
    motion: Annotated[
        list[Path] | None,
        typer.Option(
            "--motion",
            help="A motion file of `cell suggest`, treated as if it was recorded and held out. "
            "Repeat the option for more.",
        ),
    ] = None
    known: InModel = None
    config: LineModel = None
    results: Results = None
    force: Force = False
    workers: Workers = None


@app.command(cls=JsonCommand)
@taking(_Power)
def power(args: _Power) -> None:
    """Forecast which effects a diagnosis of this study would find, and from which size on.

    The forecast uses the study's own motions, markers and noise. After a few seconds, it prints
    the probability, the smallest size that is detected with 95 % probability, and the most similar
    effect.
    """
    from cell.api.lab import planned, set_up
    from cell.api.results import PowerResult
    from cell.lab.data.work import DIAGNOSIS, Work
    from cell.lab.next.effect_query import effect_queries
    from cell.lab.next.study_power import power_of

    with refusing(*args.results or [], force=args.force), working("power") as progress:
        chosen, selection = effect_queries(args.effect, args.known or [])
        work = Work(DIAGNOSIS)
        with stoppable(work.stop) as interrupted:
            fits = set_up(args.study, selection, None, args.config, progress, tell_notes, work)
            fits = planned(fits, args.motion or [])
            config = args.config if args.verify else None  # no jobs, so no cluster
            with workers(args.workers, config) as executor:
                forecast = power_of(
                    fits, chosen, args.verify or 0, progress=progress, executor=executor
                )
    result = PowerResult(forecast)
    deliver_result(result.to_json(), args.results or [], result.parts)
    interrupted.end_command()
