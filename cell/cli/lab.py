"""Commands of the model lab: fit, compare, diagnose, effects, discover, suggest."""

from __future__ import annotations

import gc
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.arguments import Workers, folder_of, taking, workers
from cell.cli.output import Json, JsonCommand, deliver_result, show
from cell.cli.shared import (
    NOT_ALL_DONE,
    STDOUT,
    Force,
    answering,
    group,
    refusing,
    stoppable,
    tell_notes,
    working,
)

if TYPE_CHECKING:
    from cell.lab.data.named_effects import EffectSelection
    from cell.lab.data.work import Progress
    from cell.lab.strength.compare import Comparison

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
        "--with", help="Part of the model: an effect's name, or a file.py with one of your own."
    ),
]
MovedEffect = Annotated[
    list[str] | None,
    typer.Option("--with", help="The file.py of an effect in the model, if the file was moved."),
]
Tried = Annotated[
    list[str] | None,
    typer.Option(
        "--try",
        help="A file.py with an effect of your own, or an effect that is tried by name only, such "
        "as plastic_set: it is tried with those of the library.",
    ),
]
Candidates = Annotated[
    Path | None,
    typer.Option(
        "--candidates",
        help="A folder of files with effects, written by people or programs; all are tried with "
        "the library. A file that could do more than compute is left out.",
    ),
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

#: Why a command has ended early, by whether a person interrupted it.
ENDED = {True: "interrupted", False: "the limit of work was reached"}


@app.command(cls=JsonCommand)
def compare(
    study: StudyFolder,
    model: Annotated[
        list[Path],
        typer.Option("--model", help="Model written by `cell fit -o`; repeat the option for more."),
    ],
    effect: MovedEffect = None,
    residuals: Annotated[
        Path | None,
        typer.Option(
            "--residuals",
            help="Write measured − predicted, m, to this folder: MODEL/TRIAL.csv.",
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
    from cell.api.results import CompareResult
    from cell.lab.data.opened_study import open_study
    from cell.lab.data.work import DIAGNOSIS, Work, WorkStoppedError
    from cell.lab.search.setup import read_models
    from cell.lab.strength.compare import compare_model, model_names

    work = Work(DIAGNOSIS)
    with (
        refusing(*results or [], report, force=force),
        working("compare") as progress,
        stoppable(work.stop) as interrupted,
    ):
        opened = open_study(study)
        tell_notes(opened.notes)
        individuals = read_models(model, opened.cable, effect or [])
        comparisons: list[Comparison] = []
        for m, name in zip(individuals, model_names(model), strict=True):
            progress(f"comparing {name}", len(comparisons), len(individuals))
            try:
                comparisons.append(compare_model(opened, m.model, name, work))
            except WorkStoppedError:
                if not comparisons:
                    raise
                tell_notes([f"{name} and what follows is not compared: {ENDED[bool(interrupted)]}"])
                break
        result = CompareResult(tuple(comparisons))

    def page(path: Path) -> None:
        from cell.files.page import write_page
        from cell.lab.report.report import comparison_page

        write_page(comparison_page(comparisons), path)

    files = (report, page), (residuals, result.write_residuals)
    deliver_result(result.to_json(), results or [], result.parts, *files)
    interrupted.end_command()


@dataclass(frozen=True, kw_only=True)
class _CandidateOptions:
    """Options for the candidates of a study."""

    effect: Tried = None
    candidates: Candidates = None
    known: InModel = None
    prior: PriorFile = None

    def effects(self, progress: Progress) -> list[str]:
        """Candidates in addition to the library; files that are refused are reported."""
        from cell.lab.data.named_effects import candidates_in

        if self.candidates is None:
            return self.effect or []
        good, refused = candidates_in(self.candidates, progress)
        tell_notes(refused)
        return [*(self.effect or []), *good]


@dataclass(frozen=True, kw_only=True)
class _Diagnose(_CandidateOptions):
    """Options of `cell diagnose`."""

    studies: Annotated[
        list[Path],
        typer.Argument(
            help="A study: a folder with study.yaml, a recorded cycle's folder, or its recording. "
            "Several: of cables that may lack the same.",
            callback=folder_of,
        ),
    ]
    config: LineModel = None
    check: Annotated[
        list[str] | None,
        typer.Option("--check", help="A file.py with a check of your own of the residuals."),
    ] = None
    results: Results = None
    report: ReportFile = None
    force: Force = False
    workers: Workers = None

    def selection(self, progress: Progress) -> EffectSelection:
        """Effects that are part of the model, and candidates.

        raises  as `select_for_diagnosis`
        """
        from cell.lab.data.named_effects import select_for_diagnosis

        return select_for_diagnosis(self.effects(progress), self.known or [])


@app.command(cls=JsonCommand)
@taking(_Diagnose)
def diagnose(args: _Diagnose) -> None:
    """Find the physical effect that the model lacks, if it lacks one.

    Several studies, each of another cable, get one joint result, or the reason why there is none.
    """
    if len(args.studies) > 1:
        _diagnose_jointly(args)
        return
    (study,) = args.studies
    from cell.api.lab import diagnosed, examined, rules_with, set_up
    from cell.lab.data.work import DIAGNOSIS, Work
    from cell.lab.report.tables import verdict_line

    work = Work(DIAGNOSIS)
    results, verdict = args.results or [], ""
    with stoppable(work.stop) as interrupted:
        with (
            refusing(*results, args.report, force=args.force),
            working("diagnose") as progress,
        ):
            if args.workers is not None:
                raise ValueError(
                    "--workers is of several studies: one is diagnosed on this computer"
                )
            selection = args.selection(progress)
            rules, work.watcher = rules_with(args.check or []), progress.watch
            fits = set_up(study, selection, args.prior, args.config, progress, tell_notes, work)
            gc.freeze()  # loaded objects stay: they are excluded from garbage collection
            examination = examined(fits, rules)
            if STDOUT not in results:
                verdict = verdict_line(examination.diagnosis)
                _print_early(verdict)
            progress("comparing the models with the trials")
            result = diagnosed(examination, study, every_step=args.report is not None)
        deliver_result(
            result.to_json(),
            results,
            lambda: (part for part in result.parts() if part != verdict),
            (args.report, result.write_report),
        )
    interrupted.end_command()


def _print_early(line: str) -> None:
    """Print a line before the rest is computed; a closed output is reported at the end."""
    with suppress(OSError):
        show(line)
        sys.stdout.flush()


def _diagnose_jointly(options: _Diagnose) -> None:
    """One joint result of several studies."""
    from cell.api.lab import rules_with
    from cell.api.several import joint_diagnosis

    outputs = (*(options.results or []), options.report)
    with refusing(*outputs, force=options.force), working("diagnose") as progress:
        if options.prior is not None:
            raise ValueError("--prior is of one cable; leave it out with several studies")
        selection = options.selection(progress)
        rules = rules_with(options.check or [])
        with workers(options.workers, options.config) as executor:
            result = joint_diagnosis(
                options.studies, selection, options.config, progress, tell_notes, rules, executor
            )
    report = options.report, result.write_report
    deliver_result(result.to_json(), options.results or [], result.parts, report)


@app.command(cls=JsonCommand)
def effects(
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--try", help="A file.py with an effect of your own: check and list it, not the others."
        ),
    ] = None,
    candidates: Annotated[
        Path | None,
        typer.Option(
            "--candidates",
            help="A folder of files with effects that nobody has read: check and list these; one "
            "that could do more than compute is not run.",
        ),
    ] = None,
    results: Results = None,
    force: Force = False,
) -> None:
    """List the effects that a model can have: laws, parameters, units and limits.

    `cell help effects` shows each with a picture, similar effects and a remedy.

    Exit codes: 0; 1 if a file of --candidates is left out; 2 if another file is wrong.
    """
    from cell.lab.data.named_effects import candidates_in, select_effects
    from cell.lab.report.model_tables import describe_effects, effects_table, passed_line

    with refusing(*results or [], force=force):
        good, left_out = ([], []) if candidates is None else candidates_in(candidates)
        tell_notes(left_out)
        selection = select_effects([], [*(effect or []), *good])
        library = selection.candidates
        described = {"format": "cable-effects/1", "effects": describe_effects(library)}
    own = selection.own
    lines = [passed_line(e) for e in own.values()]
    deliver_result(described, results or [], lambda: [*lines, effects_table(own or library)])
    if left_out:
        raise typer.Exit(NOT_ALL_DONE)


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
    from cell.api.lab import set_up
    from cell.lab.data.named_effects import select_effects
    from cell.lab.data.work import DISCOVERY, Work
    from cell.lab.next.advice import Paths, after_discovery
    from cell.lab.next.discover import NothingFoundError, effect_name
    from cell.lab.next.discover import discover as discover_effect
    from cell.lab.report.model_tables import discovery_sentence, discovery_table
    from cell.lab.report.tables import steps_text

    with refusing(out, as_json, force=force), working("discover") as progress:
        effect_name(out)
        selection = select_effects(effect or [])
        work = Work(DISCOVERY)
        with stoppable(work.stop) as interrupted:
            fits = set_up(study, selection, prior, progress=progress, tell=tell_notes, work=work)
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
    deliver_result(
        discovery.to_json(),
        [as_json],
        lambda: (discovery_table(discovery), discovery_sentence(discovery)),
        (out, discovery.write),
    )
    if as_json != STDOUT:
        show(f"written to {out}", steps_text(todo))
    interrupted.end_command()


@dataclass(frozen=True, kw_only=True)
class _Suggest(_CandidateOptions):
    """Options of `cell suggest`."""

    study: StudyFolder
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--try",
            help="NAME or NAME=SIZE: suggest the motion that best shows this effect, whether or "
            "not the study has it; SIZE in the unit of its first parameter, else a typical one. "
            "A file.py: an effect of your own, tried with those of the library.",
        ),
    ] = None
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Write the motion to this file, for `cell run --motion`."),
    ] = None
    config: Annotated[
        Path | None,
        typer.Option("--config", "-c", help="Settings of the cell: its limits and `model`."),
    ] = None
    as_json: Json = None
    force: Force = False


@app.command(cls=JsonCommand)
@taking(_Suggest)
def suggest(args: _Suggest) -> None:
    """Suggest the safe motion that best distinguishes the remaining candidates, and its power.

    With `--try NAME`: the motion that best shows that effect.
    """
    from cell.api.lab import set_up
    from cell.api.results import SuggestResult
    from cell.lab.data.named_effects import select_for_diagnosis
    from cell.lab.data.work import DIAGNOSIS, Work
    from cell.lab.diagnosis import diagnose as diagnose_study
    from cell.lab.next.effect_query import effect_queries
    from cell.lab.next.suggest import showing_motion, split_effects, suggest_motion
    from cell.lab.report.tables import verdict_line, warning_lines
    from cell.settings.surroundings import Surroundings

    with refusing(args.out, args.as_json, force=args.force), working("suggest") as progress:
        surroundings = Surroundings.read(args.config)
        names, tried = split_effects(args.effects(progress))
        known = args.known or []
        chosen, selection = (
            effect_queries(names, known) if names else ((), select_for_diagnosis(tried, known))
        )
        work = Work(DIAGNOSIS)
        with stoppable(work.stop) as interrupted:
            files = args.prior, args.config
            fits = set_up(args.study, selection, *files, progress, tell_notes, work)
            if not chosen:
                diagnosed = diagnose_study(fits)
        work.renew()
        if not chosen and interrupted:
            doubts = diagnosed.diagnosis.warnings
            show(verdict_line(diagnosed.diagnosis), *warning_lines(doubts))
            raise typer.Exit(interrupted.code)
        with answering() as interrupted:
            suggestion = (
                showing_motion(fits, chosen, surroundings)
                if chosen
                else suggest_motion(diagnosed, surroundings)
            )
        result = SuggestResult(suggestion)
        if interrupted:
            tell_notes(["interrupted: the result is the best of the motions evaluated so far"])
    motion = args.out, result.write
    deliver_result(result.to_json(), [args.as_json], result.parts, motion)
    interrupted.end_command()
