"""Command that identifies recorded cables again: one, or all of a folder."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.arguments import Workers, folder_of, taking, workers
from cell.cli.output import Json, JsonCommand, deliver_result
from cell.cli.shared import (
    NOT_ALL_DONE,
    Force,
    group,
    refusing,
    stoppable,
    tell_notes,
    working,
)
from cell.files.words import counted

if TYPE_CHECKING:
    from cell.lab.line.identify_all import IdentifiedAll

app = group()


@dataclass(frozen=True, kw_only=True)
class _Identify:
    """Options of `cell identify`."""

    folder: Annotated[
        Path,
        typer.Argument(
            help="A cycle's folder or its recording, or any study.  With --all: a folder of them.",
            callback=folder_of,
        ),
    ]
    every: Annotated[
        bool,
        typer.Option(
            "--all",
            help="Identify every cable that was recorded below FOLDER, each with the model of its "
            "settings, and compare with what was identified then.",
        ),
    ] = False
    csv: Annotated[
        Path,
        typer.Option(
            "--csv",
            help="With --all: the table of results.  It is written row by row; the same command "
            "goes on with it after an interruption.",
        ),
    ] = Path("identified.csv")
    config: Annotated[
        Path | None,
        typer.Option(
            "--config", "-c", help="Settings whose `model` is used; default: those of the record."
        ),
    ] = None
    out: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", help="Write the model to this file, for --prior; with --all the summary."
        ),
    ] = None
    as_json: Json = None
    force: Force = False
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            help="Part of the model: an effect's name, or a file.py with one of your own.",
        ),
    ] = None
    workers: Workers = None


@app.command(cls=JsonCommand)
@taking(_Identify)
def identify(given: _Identify) -> None:
    """Identify a cable again, from its folder alone, with the model of its settings.

    With --all every recording below a folder is identified, many at a time.

    Exit codes: 0; 1 if a cable cannot be identified; 2 if the folder is wrong.
    """
    if given.every:
        _all(given)
    else:
        _one(given)


def _one(given: _Identify) -> None:
    from cell.cli.cycle_tables import parameters_table
    from cell.identify.individual import CableRejectedError
    from cell.lab.line.recordings import (
        identify_again,
        options_with,
        recorded_settings,
        study_to_identify,
    )

    with (
        refusing(given.out, given.as_json, force=given.force),
        working("identify") as progress,
    ):
        if given.workers is not None:
            raise ValueError("--workers is of --all: one cable is identified on this computer")
        study = study_to_identify(given.folder)
        settings = given.config or recorded_settings(given.folder)
        options = options_with(settings, given.effect or [])
        tell_notes(study.notes)
        progress("fitting the model")
        try:
            identified = identify_again(study, options)
        except CableRejectedError as error:
            print(f"{given.folder}: cable rejected: {error}", file=sys.stderr)
            raise typer.Exit(NOT_ALL_DONE) from None
    model = identified.to_dict()
    stated = ""
    if study.noise_std_m is not None:
        stated = f" (stated error of the measurement: {study.noise_std_m * 1e3:.3f} mm)"
    errors = (
        f"residual {identified.residual_rms_m * 1e3:.3f} mm rms, camera noise at rest "
        f"{identified.noise.std_m * 1e3:.3f} mm{stated}, {identified.frames_used} of "
        f"{identified.frames_total} frames"
    )
    places = given.out, given.as_json
    deliver_result(model, places, lambda: (parameters_table(model), errors))


def _all(given: _Identify) -> None:
    from cell.lab.data.work import Work, WorkStoppedError
    from cell.lab.line.identify_all import IdentifiedAll, identified_table, identify_all
    from cell.lab.line.recordings import packer, recordings_in
    from cell.lab.report.line_tables import identified_parts

    wanted = Work()
    with (
        refusing(given.out, given.as_json, force=given.force),
        working("identify") as progress,
    ):
        recordings = recordings_in(given.folder)
        pack = packer(given.folder, given.config, given.effect or [])
        found = IdentifiedAll(len(recordings))
        with (
            identified_table(given.csv, afresh=given.force) as table,
            workers(given.workers, given.config) as executor,
            stoppable(wanted.stop) as interrupted,
        ):
            try:
                for so_far in identify_all(
                    recordings, pack, table, executor, progress, wanted.check
                ):
                    found = so_far
            except WorkStoppedError:
                pass
    data = {**found.to_json(), "table": str(given.csv)}
    places = given.out, given.as_json
    deliver_result(data, places, lambda: identified_parts(found, given.csv))
    if interrupted:
        print(
            f"{_residual_text(found)}; the same command goes on with {given.csv}", file=sys.stderr
        )
        raise typer.Exit(interrupted.code)
    if found.outcomes["identified"] < found.done:
        raise typer.Exit(NOT_ALL_DONE)


def _residual_text(found: IdentifiedAll) -> str:
    left = found.recordings - found.done
    return f"{left} of {counted(found.recordings, 'recording')} {'is' if left == 1 else 'are'} left"
