"""Commands of the model lab: fit, compare, diagnose, effects, discover, suggest."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.delivery import deliver, json_files
from cell.cli.given import folder_of
from cell.cli.result_json import STDOUT, Json, JsonCommand, print_result
from cell.cli.shared import BAD_INPUT, answering, group, stoppable, tell_notes
from cell.files.overwriting import check_apart, check_output
from cell.files.rescue import no_room, remedy

if TYPE_CHECKING:
    from cell.files.table import TableData
    from cell.lab.data.progress import Progress
    from cell.lab.data.results import Agreement, Doubt
    from cell.lab.data.selection import EffectSelection
    from cell.lab.search.fit_cache import FitCache
    from cell.lab.strength.compare import Comparison
    from cell.lab.strength.profiles import ParameterProfile
    from cell.terminal.progress import ProgressLine

app = group()

StudyFolder = Annotated[
    Path,
    typer.Argument(
        help="A study: a folder with study.yaml, a recorded cycle's folder, or its recording.",
        callback=folder_of,
    ),
]
InModel = Annotated[
    list[str] | None,
    typer.Option(
        "--effect", help="Part of the model: an effect's name, or a file.py with one of your own."
    ),
]
EffectOption = Annotated[
    list[str] | None,
    typer.Option(
        "--effect",
        help="A file.py with an effect of your own: it is tried beside the library. A name that "
        "is tried anyway: it is part of the model.",
    ),
]
Known = Annotated[
    list[str] | None,
    typer.Option("--known", help="Name or file.py of an effect that is part of the model."),
]
PriorFile = Annotated[
    Path | None,
    typer.Option("--prior", help="Model of an earlier cable, written by `cell fit -o`."),
]
LineModel = Annotated[
    Path | None,
    typer.Option(
        "--config", "-c", help="Settings of a cell: its `model` is the model to start from."
    ),
]
Results = Annotated[
    list[Path] | None,
    typer.Option(
        "--json",
        "-o",
        "--out",
        help="-o FILE writes the result as JSON; --json prints it instead of tables.",
        show_default=False,
        metavar="FILE",
    ),
]
ReportFile = Annotated[
    Path | None,
    typer.Option("--report", help="Write an HTML report to this file; it needs no network."),
]

Force = Annotated[
    bool, typer.Option("--force", help="Overwrite files that this program did not write.")
]


@app.command(cls=JsonCommand)
def fit(
    study: StudyFolder,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Write the model to this file.")
    ] = None,
    effect: InModel = None,
    prior: PriorFile = None,
    config: LineModel = None,
    profile: Annotated[
        Path | None,
        typer.Option(
            "--profile",
            help="Write profile-likelihood intervals to this HTML page: each parameter is held at "
            "values near its best one, and all others are refitted.",
        ),
    ] = None,
    as_json: Json = None,
    force: Force = False,
) -> None:
    """Fit the cable's parameters, and those of effects, to the study's `fit` trials."""
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
    with (
        refusing(out, as_json, profile, force=force),
        working("fit") as progress,
        answering() as interrupted,
    ):
        selection = select_effects(effect or [])
        fits = explorer(study, selection, prior, progress, config)
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


@app.command(cls=JsonCommand)
def compare(
    study: StudyFolder,
    model: Annotated[
        list[Path],
        typer.Option("--model", help="Model written by `cell fit -o`; repeat the option for more."),
    ],
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--effect", help="The file.py of an effect in the model, if the file was moved."
        ),
    ] = None,
    results: Results = None,
    report: ReportFile = None,
    force: Force = False,
) -> None:
    """Compare models with every trial of a study: overlay, error, noise, place of the errors.

    Give several models in the order in which they were made.  Their errors are shown side by side:
    how the error falls as effects are added, and maps before and after.
    """
    from cell.lab.data.opened_study import open_study
    from cell.lab.report.model_tables import (
        comparison_sentence,
        comparison_table,
        comparisons_table,
        correlations_table,
    )
    from cell.lab.search.setup import read_models
    from cell.lab.strength.compare import compare_model, comparisons_json, model_names

    with refusing(*results or [], report, force=force), working("compare") as progress:
        opened = open_study(study)
        tell_notes(opened.notes)
        individuals = read_models(model, opened.cable, effect or [])
        comparisons: list[Comparison] = []
        for m, name in zip(individuals, model_names(model), strict=True):
            progress(f"comparing {name}", len(comparisons), len(individuals))
            comparisons.append(compare_model(opened, m.model, name))
    data = comparisons_json(comparisons)

    def printed() -> None:
        if print_result(data, *results or []):
            last = comparisons[-1]
            side_by_side = [comparisons_table(comparisons)] if len(comparisons) > 1 else []
            show(
                comparison_sentence(comparisons),
                *side_by_side,
                comparison_table(last),
                correlations_table(last),
            )

    def page(path: Path) -> None:
        from cell.files.page import write_page
        from cell.lab.report.report import comparison_page

        write_page(comparison_page(comparisons), path)

    deliver(printed, *json_files(data, *results or []), (report, page))


@app.command(cls=JsonCommand)
def diagnose(
    study: StudyFolder,
    effect: EffectOption = None,
    known: Known = None,
    prior: PriorFile = None,
    config: LineModel = None,
    results: Results = None,
    report: ReportFile = None,
    force: Force = False,
) -> None:
    """Find the physical effect that the model lacks, if it lacks one."""
    from cell.lab.data.results import to_json
    from cell.lab.data.selection import select_for_diagnosis
    from cell.lab.next.advice import Paths, advice
    from cell.lab.report.tables import diagnosis_parts
    from cell.lab.strength.compare import compare_model
    from cell.lab.strength.kept_model import identified
    from cell.lab.verdict.diagnose import diagnose as diagnose_study
    from cell.lab.verdict.limits_and_agreement import with_agreement, with_limits

    with refusing(*results or [], report, force=force), working("diagnose") as progress:
        selection = select_for_diagnosis(effect or [], known or [])
        fits = explorer(study, selection, prior, progress, config)
        gc.freeze()  # what is loaded stays: not looked through for garbage again and again
        with stoppable(fits.work.stop) as interrupted:
            examination = with_agreement(with_limits(diagnose_study(fits)))
        fits = examination.fits
        steps = [fits.prior_candidate(), *examination.steps[1:]]
        shown = steps if report else [steps[0], *steps[1:][-1:]]
        comparisons = [compare_model(fits.prepared.study, c.fit.model) for c in shown]
        in_model = fits.space.effects
        todo = advice(
            examination.diagnosis,
            Paths.of(study, [*in_model, *fits.library.values()]),
            known=tuple(e.name for e in in_model),
            accepted=tuple(e.name for e in examination.accepted.effects if e not in in_model),
        )
    diagnosis = examination.diagnosis
    data = to_json(diagnosis)

    def printed() -> None:
        if print_result(data, *results or []):
            show(*diagnosis_parts(diagnosis, comparisons, todo))

    def page(path: Path) -> None:
        from cell.files.page import write_page
        from cell.lab.report.report import diagnosis_page

        fitted = examination.steps[-1].fit
        model = identified(fits.prepared, fitted, fits.library.values())
        write_page(diagnosis_page(diagnosis, comparisons, model, todo), path)

    deliver(printed, *json_files(data, *results or []), (report, page))
    if interrupted:
        raise typer.Exit(interrupted.code)


@app.command(cls=JsonCommand)
def effects(
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--effect", help="A file.py with an effect of your own, to check and list too."
        ),
    ] = None,
    results: Results = None,
    force: Force = False,
) -> None:
    """List the effects that a model can have: laws, parameters, units and limits."""
    from cell.lab.data.selection import select_effects
    from cell.lab.report.model_tables import describe_effects, effects_table

    with refusing(*results or [], force=force):
        library = select_effects([], effect or []).candidates
        described = {"format": "cable-effects/1", "effects": describe_effects(library)}

    def printed() -> None:
        if print_result(described, *results or []):
            show(effects_table(library))

    deliver(printed, *json_files(described, *results or []))


@app.command(cls=JsonCommand)
def discover(
    study: StudyFolder,
    out: Annotated[Path, typer.Option("-o", "--out", help="Write the effect to this file.")],
    effect: InModel = None,
    prior: PriorFile = None,
    as_json: Json = None,
    force: Force = False,
) -> None:
    """Infer the missing law from the residual and write it as a readable effect file."""
    from cell.lab.data.selection import select_effects
    from cell.lab.next.advice import Paths, after_discovery
    from cell.lab.next.discover import NothingFoundError, effect_name
    from cell.lab.next.discover import discover as discover_effect
    from cell.lab.report.model_tables import discovery_sentence, discovery_table
    from cell.lab.report.tables import steps_text

    with refusing(out, as_json, force=force), working("discover") as progress:
        effect_name(out)
        selection = select_effects(effect or [])
        fits = explorer(study, selection, prior, progress)
        with stoppable(fits.work.stop) as interrupted:
            try:
                discovery = discover_effect(fits, out)
            except NothingFoundError as error:
                if not interrupted:
                    raise
                print(error)
                raise typer.Exit(interrupted.code) from error
    known = fits.space.effects
    paths = Paths.of(study, known)
    paths = Paths(study, {**(paths.files or {}), discovery.effect: out})
    todo = after_discovery(
        discovery.effect, discovery.complete, paths, tuple(e.name for e in known)
    )
    data = discovery.to_json()

    def printed() -> None:
        if print_result(data, as_json):
            show(discovery_table(discovery), discovery_sentence(discovery))

    deliver(printed, (out, discovery.write), *json_files(data, as_json))
    if as_json != STDOUT:
        show(f"written to {out}", steps_text(todo))
    if interrupted:
        raise typer.Exit(interrupted.code)


@app.command(cls=JsonCommand)
def suggest(
    study: StudyFolder,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Write the motion to this file, for `cell run --motion`."),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option("--config", "-c", help="Settings of the cell: its limits and `model`."),
    ] = None,
    effect: EffectOption = None,
    known: Known = None,
    prior: PriorFile = None,
    as_json: Json = None,
    force: Force = False,
) -> None:
    """Suggest the safe motion that best distinguishes the remaining candidates, and its power."""
    from cell.lab.data.selection import select_for_diagnosis
    from cell.lab.next.suggest import suggest_motion
    from cell.lab.next.suggestion import write_motion
    from cell.lab.report.model_tables import suggestion_table
    from cell.lab.report.tables import verdict_line, warning_lines
    from cell.lab.verdict.diagnose import diagnose as diagnose_study
    from cell.settings.surroundings import Surroundings

    with refusing(out, as_json, force=force), working("suggest") as progress:
        surroundings = Surroundings.read(config)
        selection = select_for_diagnosis(effect or [], known or [])
        fits = explorer(study, selection, prior, progress, config)
        with stoppable(fits.work.stop) as interrupted:
            diagnosed = diagnose_study(fits)
        if interrupted:
            show(verdict_line(diagnosed.diagnosis), *warning_lines(diagnosed.diagnosis.warnings))
            raise typer.Exit(interrupted.code)
        with answering() as interrupted:
            suggestion = suggest_motion(diagnosed, surroundings)
        if interrupted:
            tell_notes(["interrupted: the result is the best of the motions evaluated so far"])
    data = suggestion.to_json()

    def printed() -> None:
        if print_result(data, as_json):
            show(suggestion_table(suggestion))

    deliver(printed, (out, partial(write_motion, suggestion)), *json_files(data, as_json))
    if interrupted:
        raise typer.Exit(interrupted.code)


@contextmanager
def refusing(*outputs: Path | None, force: bool = False) -> Iterator[None]:
    """Ends with 2 and a message, nothing written, if what was given is wrong.

    outputs  files to be written at the end of a long computation: tried at its beginning
    force    whether they may take the place of what no command wrote
    """
    try:
        files = [output for output in outputs if output is not None and output != STDOUT]
        check_apart(files)
        for output in files:
            check_output(output, force=force)
        yield
    except (FileNotFoundError, ValueError) as error:  # InputError, EffectError … among them
        if isinstance(error, FileNotFoundError) and error.filename is not None:
            print(f"{error.filename}: {error.strerror}; check the name", file=sys.stderr)
        else:
            print(error, file=sys.stderr)
        raise typer.Exit(BAD_INPUT) from error
    except OSError as error:  # of a name that no file can have, a folder that nobody may enter …
        if error.filename is None or no_room(error):
            raise
        print(f"{error.filename}: {error.strerror}; {remedy(error)}", file=sys.stderr)
        raise typer.Exit(BAD_INPUT) from error


def explorer(
    folder: Path,
    selection: EffectSelection,
    prior: Path | None,
    progress: Progress,
    config: Path | None = None,
) -> FitCache:
    """A study made ready, with the model files and settings that the command line names.

    What is odd about the study is told.
    """
    from cell.lab.data.opened_study import open_study
    from cell.lab.search.setup import fit_cache_of, read_kind, read_prior
    from cell.lab.search.wrong_samples import without_wrong_samples

    study = open_study(folder)
    tell_notes(study.notes)
    fits = fit_cache_of(
        study,
        selection,
        read_prior(prior, selection.own),
        progress,
        read_kind(config),
    )
    fits, more = without_wrong_samples(fits)
    tell_notes(more)
    return fits


def working(command: str) -> ProgressLine:
    """A line that tells what a command is doing, on the error stream."""
    from cell.terminal.progress import ProgressLine

    return ProgressLine(command)


def show(*parts: str | TableData) -> None:
    """Print texts as they are, and tables of which no number is cut."""
    from rich.console import Console

    from cell.cli.text_table import text_table
    from cell.files.table import TableData
    from cell.terminal.fitting import show as show_on

    show_on(Console(), *(text_table(p) if isinstance(p, TableData) else p for p in parts))
