"""Command of the model lab that forecasts which effects a study could detect: power."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from cell.cli.arguments import Workers, taking, workers
from cell.cli.lab import InModel, LineModel, Results, StudyFolder
from cell.cli.output import JsonCommand, deliver_result
from cell.cli.shared import Force, group, refusing, stoppable, tell_notes, working

app = group()


@dataclass(frozen=True, kw_only=True)
class _Power:
    """Options of `cell power`."""

    study: StudyFolder
    effect: Annotated[
        list[str],
        typer.Option(
            "--try",
            help="NAME, NAME=SIZE or NAME.PARAMETER=SIZE of an effect of the library or of a "
            "file.py; SIZE in the parameter's unit.  Without SIZE: the smallest that is found.  "
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
            help="A motion, as `cell suggest` writes it, as if it had been recorded too and held "
            "out.  Repeat the option for more.",
        ),
    ] = None
    known: InModel = None
    config: LineModel = None
    results: Results = None
    force: Force = False
    workers: Workers = None


@app.command(cls=JsonCommand)
@taking(_Power)
def power(given: _Power) -> None:
    """Forecast which effects a diagnosis of this study would find, and from which size on.

    The study's own motions, markers and noise count.  A few seconds tell the probability, the
    smallest size that is found with 95 %, and the effect that it is most like.
    """
    from cell.api.lab import planned, set_up
    from cell.api.results import PowerResult
    from cell.lab.data.work import DIAGNOSIS, Work
    from cell.lab.next.asked import select_asked
    from cell.lab.next.study_power import power_of

    with refusing(*given.results or [], force=given.force), working("power") as progress:
        asked, selection = select_asked(given.effect, given.known or [])
        work = Work(DIAGNOSIS)
        with stoppable(work.stop) as interrupted:
            fits = set_up(given.study, selection, None, given.config, progress, tell_notes, work)
            fits = planned(fits, given.motion or [])
            config = given.config if given.verify else None  # no cluster is asked for nothing
            with workers(given.workers, config) as executor:
                found = power_of(
                    fits, asked, given.verify or 0, progress=progress, executor=executor
                )
    result = PowerResult(found)
    deliver_result(result.to_json(), given.results or [], result.parts)
    if interrupted:
        raise typer.Exit(interrupted.code)
