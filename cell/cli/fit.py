"""Command that fits a cable's model: to a study, or to a chain of another program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cell.cli.delivery import deliver, json_files
from cell.cli.given import maybe_folder_of
from cell.cli.lab import (
    InModel,
    LineModel,
    PriorFile,
    explorer,
    refusing,
    show,
    working,
)
from cell.cli.options import taking
from cell.cli.result_json import Json, JsonCommand, print_result
from cell.cli.shared import answering, group, tell_notes

if TYPE_CHECKING:
    from cell.lab.data.results import Agreement, Doubt
    from cell.lab.strength.profiles import ParameterProfile

app = group()


@dataclass(frozen=True)
class FitOptions:
    """What `cell fit` is told."""

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
        named = {"effect": "--effect", "prior": "--prior", "config": "--config"}
        named["profile"] = "--profile"
        return [named[f.name] for f in fields(self) if f.name in named and getattr(self, f.name)]


class FitCommand(JsonCommand):
    """Command whose study may be left out if `--from` is given."""

    def is_complete(self, given: Mapping[str, Any]) -> bool:
        """Whether it has what it works on."""
        return any(isinstance(given.get(name), str) for name in ("study", "chain"))


@app.command(cls=FitCommand)
@taking(FitOptions)
def fit(options: FitOptions) -> None:
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


def _fit_to_chain(options: FitOptions, chain: Path) -> None:
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

    def printed() -> None:
        if print_result(data, options.out, options.as_json):
            show(
                model_table(found.model),
                "Nothing was measured: the intervals are those of a weak prior.",
            )

    deliver(printed, *json_files(data, options.out, options.as_json))


def _fit_to_study(options: FitOptions, study: Path) -> None:
    """A model of a study, with what is doubtful about it, and profiles if they are wanted."""
    from cell.lab.data.results import agreement_json
    from cell.lab.data.selection import select_effects
    from cell.lab.report.model_tables import errors_line, model_table
    from cell.lab.report.tables import agreement_table, warning_lines
    from cell.lab.report.wording import agreement_sentence
    from cell.lab.strength.fitted_study import fit_study
    from cell.lab.strength.trial_agreement import agreement
    from cell.lab.verdict.doubts import fit_doubts, interrupted_doubt, lacking_doubt

    found: list[ParameterProfile] = []
    said: list[str] = []
    out, as_json, profile = options.out, options.as_json, options.profile
    with (
        refusing(out, as_json, profile, force=options.force),
        working("fit") as progress,
        answering() as interrupted,
    ):
        selection = select_effects(options.effect or [])
        fits = explorer(study, selection, options.prior, progress, options.config)
        model, candidate, fitted_to = fit_study(fits)
        warnings: tuple[Doubt, ...] = lacking_doubt(model.lacks)
        trials: Sequence[Agreement] = ()
        with suppress(KeyboardInterrupt):
            warnings = (*fit_doubts(fits, candidate), *warnings)
            trials = agreement(fitted_to, candidate.fit, progress)
            if profile is not None:
                from cell.lab.strength.profiles import each_profile, profile_sentences

                for one in each_profile(fitted_to, candidate.fit, model, progress):
                    found.append(one)
                    said = [f"{sentence}." for sentence in profile_sentences(found)]
        if interrupted:
            what = "the computations after the fit are missing or incomplete"
            warnings = (interrupted_doubt(what), *warnings)
    written = model.to_dict() | {
        "warnings": [vars(w) for w in warnings],
        "agreement": agreement_json(trials),
    }
    if profile is not None:
        written["profiles"] = [p.to_json() for p in found]

    def printed() -> None:
        if print_result(written, out, as_json):
            errors = errors_line(fits.prepared, candidate.errors)
            apart = (agreement_sentence(trials), agreement_table(trials)) if trials else ()
            show(*warning_lines(warnings), errors, model_table(model), *apart, *said)

    def page(path: Path) -> None:
        from cell.files.page import write_page
        from cell.lab.report.report import profile_page

        write_page(profile_page(fits.prepared.study.name, found), path)

    deliver(printed, *json_files(written, out, as_json), (profile if found else None, page))
    if interrupted:
        raise typer.Exit(interrupted.code)
