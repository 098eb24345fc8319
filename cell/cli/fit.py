"""Command that fits a cable's model: to a study, or to a chain of another program."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cell.cli.arguments import maybe_folder_of, taking
from cell.cli.lab import InModel, LineModel, PriorFile
from cell.cli.output import Json, JsonCommand, deliver_result
from cell.cli.shared import answering, group, refusing, tell_notes, working

if TYPE_CHECKING:
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
    force: Annotated[
        bool, typer.Option("--force", help="Overwrite files that this program did not write.")
    ] = False

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
    if interrupted:
        raise typer.Exit(interrupted.code)
