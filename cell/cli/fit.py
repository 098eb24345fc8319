"""Commands that fit a cable's model: fit, to a study or a chain; identify, to recorded cables."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cell.cli.arguments import Workers, folder_of, taking, workers
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
            callback=folder_of,
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
        """Options in use that only a fit to a study has."""
        named = {"effect": "--with", "prior": "--prior", "config": "--config"}
        named["profile"] = "--profile"
        return [named[f.name] for f in fields(self) if f.name in named and getattr(self, f.name)]


class FitCommand(JsonCommand):
    """`cell fit`: the study, its argument, is optional with `--from`."""

    def is_complete(self, values: Mapping[str, Any]) -> bool:
        """Whether its input, a study or a chain, is given."""
        return any(isinstance(values.get(name), str) for name in ("study", "chain"))


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
    """A model of a chain in MuJoCo's XML; parts of the file that it omits are reported."""
    from cell.exchange.from_mujoco import model_from_mujoco
    from cell.lab.report.model_tables import model_table

    with refusing(options.out, options.as_json, force=options.force):
        if options.study is not None:
            raise ValueError(f"{options.study} and --from: a model is fitted to one; leave one out")
        if only := options.of_study_only():
            raise ValueError(f"{', '.join(only)}: with a study only; leave out, or --from")
        converted = model_from_mujoco(chain)
    tell_notes(converted.notes)
    data = converted.model.to_dict()
    note = "Nothing was measured: the intervals are those of a weak prior."
    places = options.out, options.as_json
    deliver_result(data, places, lambda: (model_table(converted.model), note))


def _fit_to_study(options: FitCommandOptions, study: Path) -> None:
    """A model of a study, with its warnings, and profiles on request."""
    from cell.api.lab import fitted, set_up
    from cell.lab.data.named_effects import select_effects

    profiles: list[ParameterProfile] = []
    sentences: list[str] = []
    out, as_json, profile = options.out, options.as_json, options.profile
    with (
        refusing(out, as_json, profile, force=options.force),
        working("fit") as progress,
        answering() as interrupted,
    ):
        selection = select_effects(options.effect or [])
        inputs = selection, options.prior, options.config, progress, tell_notes
        result = fitted(set_up(study, *inputs))
        with suppress(KeyboardInterrupt):
            if profile is not None and not interrupted:
                from cell.lab.strength.profiles import each_profile, profile_sentences

                at = result.reestimated, result.candidate.fit, result.model
                for parameter in each_profile(*at, progress):
                    profiles.append(parameter)
                    sentences = [f"{sentence}." for sentence in profile_sentences(profiles)]
        result = result.interrupted() if interrupted else result
    written = result.to_json()
    if profile is not None:
        written["profiles"] = [p.to_json() for p in profiles]

    def page(path: Path) -> None:
        from cell.files.page import write_page
        from cell.lab.report.report import profile_page

        write_page(profile_page(result.prepared.study.name, profiles), path)

    files = ((profile if profiles else None, page),)
    deliver_result(written, (out, as_json), lambda: (*result.parts(), *sentences), *files)
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
def identify(command: _Identify) -> None:
    """Identify a cable again, from its folder alone, with the model of its settings.

    With --all every recording below a folder is identified, many at a time.

    Exit codes: 0; 1 if a cable cannot be identified; 2 if the folder is wrong.
    """
    if command.every:
        _all(command)
    else:
        _one(command)


def _one(command: _Identify) -> None:
    from cell.cli.cycle_tables import parameters_table
    from cell.identify.individual import CableRejectedError
    from cell.lab.line.recordings import (
        identify_again,
        options_with,
        recorded_settings,
        study_to_identify,
    )

    with (
        refusing(command.out, command.as_json, force=command.force),
        working("identify") as progress,
    ):
        if command.workers is not None:
            raise ValueError("--workers is of --all: one cable is identified on this computer")
        study = study_to_identify(command.folder)
        settings = command.config or recorded_settings(command.folder)
        options = options_with(settings, command.effect or [])
        tell_notes(study.notes)
        progress("fitting the model")
        try:
            identified = identify_again(study, options)
        except CableRejectedError as error:
            print(f"{command.folder}: cable rejected: {error}", file=sys.stderr)
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
    places = command.out, command.as_json
    deliver_result(model, places, lambda: (parameters_table(model), errors))


def _all(command: _Identify) -> None:
    from cell.lab.data.work import Work, WorkStoppedError
    from cell.lab.line.identify_all import IdentifiedAll, identified_table, identify_all
    from cell.lab.line.recordings import packer, recordings_in
    from cell.lab.report.line_tables import identified_parts

    wanted, table_anew = Work(), command.csv if command.force else None
    with (
        refusing(command.out, command.as_json, table_anew, force=command.force),
        working("identify") as progress,
    ):
        recordings = recordings_in(command.folder)
        pack = packer(command.folder, command.config, command.effect or [])
        done = IdentifiedAll(len(recordings))
        with (
            identified_table(command.csv, afresh=command.force) as table,
            workers(command.workers, command.config) as executor,
            stoppable(wanted.stop) as interrupted,
        ):
            try:
                for so_far in identify_all(
                    recordings, pack, table, executor, progress, wanted.check
                ):
                    done = so_far
            except WorkStoppedError:
                pass
    data = {**done.to_json(), "table": str(command.csv)}
    places = command.out, command.as_json
    deliver_result(data, places, lambda: identified_parts(done, command.csv))
    if interrupted:
        print(
            f"{_residual_text(done)}; the same command goes on with {command.csv}", file=sys.stderr
        )
        raise typer.Exit(interrupted.code)
    if done.outcomes["identified"] < done.done:
        raise typer.Exit(NOT_ALL_DONE)


def _residual_text(done: IdentifiedAll) -> str:
    rest = done.recordings - done.done
    return f"{rest} of {counted(done.recordings, 'recording')} {'is' if rest == 1 else 'are'} left"
