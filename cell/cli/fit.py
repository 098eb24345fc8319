"""Commands that fit a cable's model: fit, to a study or a chain; identify, to recorded cables."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cell.cli.arguments import Workers, folder_of, maybe_folder_of, taking, workers
from cell.cli.lab import InModel, LineModel, PriorFile
from cell.cli.output import Json, JsonCommand, deliver_result
from cell.cli.shared import (
    NOT_ALL_DONE,
    Force,
    answering,
    group,
    refusing,
    stoppable,
    tell_notes,
    working,
)
from cell.files.words import counted

if TYPE_CHECKING:
    from cell.lab.line.identify_all import IdentifiedAll
    from cell.lab.strength.profiles import ParameterProfile

app = group()


@dataclass(frozen=True)
class FitCommandOptions:
    """Options of `cell fit`."""

    study: Annotated[
        Path | None,
        typer.Argument(
            help="A study: a folder with study.yaml, a recorded cycle's folder, or its recording. "
            "None with --from.",
            callback=maybe_folder_of,
            show_default=False,
        ),
    ] = None
    chain: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="Fit to a chain in MuJoCo's XML in place of a study: EI(s), exponent, viscosity.",
        ),
    ] = None
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Write the model to this file.")
    ] = None
    effect: InModel = None
    prior: PriorFile = None
    config: LineModel = None
    profile: Annotated[
        Path | None,
        typer.Option(
            "--profile",
            help="Write profile-likelihood intervals to this HTML page: each parameter is held at "
            "values near its best one, and all others are refitted.",
        ),
    ] = None
    as_json: Json = None
    force: Force = False

    def of_study_only(self) -> list[str]:
        """Options given that a fit without a study does not have."""
        named = {"effect": "--with", "prior": "--prior", "config": "--config"}
        named["profile"] = "--profile"
        return [named[f.name] for f in fields(self) if f.name in named and getattr(self, f.name)]


class FitCommand(JsonCommand):
    """`cell fit`: its argument, the study, may be omitted if `--from` is given."""

    def is_complete(self, given: Mapping[str, Any]) -> bool:
        """Whether it has what it works on."""
        return any(isinstance(given.get(name), str) for name in ("study", "chain"))


@app.command(cls=FitCommand)
@taking(FitCommandOptions)
def fit(options: FitCommandOptions) -> None:
    """Fit the cable's parameters, and those of effects, to the study's `fit` trials.

    With --from FILE.xml: to the springs and dampers of a chain, as `cell export` writes it.
    """
    if options.chain is not None:
        _fit_to_chain(options, options.chain)
        return
    with refusing():
        if options.study is None:
            raise ValueError("STUDY is missing: name its folder, or a chain with --from FILE.xml")
    _fit_to_study(options, options.study)


def _fit_to_chain(options: FitCommandOptions, chain: Path) -> None:
    """A model of a chain in MuJoCo's XML; what it does not have of the file is told."""
    from cell.exchange.from_mujoco import model_from_mujoco
    from cell.lab.report.model_tables import model_table

    with refusing(options.out, options.as_json, force=options.force):
        if options.study is not None:
            raise ValueError(f"{options.study} and --from: a model is fitted to one; leave one out")
        if only := options.of_study_only():
            raise ValueError(f"{', '.join(only)}: with a study only; leave out, or --from")
        found = model_from_mujoco(chain)
    tell_notes(found.notes)
    data = found.model.to_dict()
    note = "Nothing was measured: the intervals are those of a weak prior."
    places = options.out, options.as_json
    deliver_result(data, places, lambda: (model_table(found.model), note))


def _fit_to_study(options: FitCommandOptions, study: Path) -> None:
    """A model of a study, with what is doubtful about it, and profiles if they are wanted."""
    from cell.api.lab import fitted, set_up
    from cell.lab.data.named_effects import select_effects

    found: list[ParameterProfile] = []
    said: list[str] = []
    out, as_json, profile = options.out, options.as_json, options.profile
    with (
        refusing(out, as_json, profile, force=options.force),
        working("fit") as progress,
        answering() as interrupted,
    ):
        selection = select_effects(options.effect or [])
        given = selection, options.prior, options.config, progress, tell_notes
        result = fitted(set_up(study, *given))
        with suppress(KeyboardInterrupt):
            if profile is not None and not interrupted:
                from cell.lab.strength.profiles import each_profile, profile_sentences

                at = result.weighed, result.candidate.fit, result.model
                for one in each_profile(*at, progress):
                    found.append(one)
                    said = [f"{sentence}." for sentence in profile_sentences(found)]
        result = result.interrupted() if interrupted else result
    written = result.to_json()
    if profile is not None:
        written["profiles"] = [p.to_json() for p in found]

    def page(path: Path) -> None:
        from cell.files.page import write_page
        from cell.lab.report.report import profile_page

        write_page(profile_page(result.prepared.study.name, found), path)

    files = ((profile if found else None, page),)
    deliver_result(written, (out, as_json), lambda: (*result.parts(), *said), *files)
    interrupted.end_command()


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
    effect: InModel = None
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
