"""Commands from the lab to the line: learn, promote."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from cell.cli.lab import refusing, show, working
from cell.cli.shared import ALL_DONE, NOT_ALL_DONE, Config, group

app = group()


@app.command()
def learn(
    runs: Annotated[
        list[Path], typer.Argument(help="Folders of recorded cycles, or folders of such folders.")
    ],
    config: Config,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Write the candidate model here.")
    ] = Path("candidate.yaml"),
    effect: Annotated[
        list[str] | None,
        typer.Option("--effect", help="A file.py with an effect of your own, tried as well."),
    ] = None,
) -> None:
    """Learn from recorded cycles of many cables which effect the line's model lacks.

    Effects are shared by all cables, EI(s), N and viscosity are each cable's own.  Every recorded
    execution is forecast out of sample, from that cycle's own hold, with the effect as the other
    cables show it.  Ends with 0 if a candidate passed every gate or nothing is missing, 1 if one
    was found that did not pass, 2 if what was given is wrong.
    """
    from cell.lab.candidate import write_candidate
    from cell.lab.cycles import read_cycles
    from cell.lab.gates import best_judged
    from cell.lab.learn import learn as learn_from
    from cell.lab.lesson_tables import gates_table, lesson_lines, votes_table
    from cell.lab.session import select_effects
    from cell.settings import load_settings
    from cell.settings.translate import cable_of, identification_of

    with refusing(out), working("learn") as progress:
        settings = load_settings(config)
        cable, options = cable_of(settings), identification_of(settings)
        cycles, left_out = read_cycles(runs, cable)
        library = select_effects([], effect or []).candidates
        lesson = learn_from(cycles, cable, options, library, progress)
        lesson, judgement = best_judged(lesson, settings)
        if lesson.best:
            write_candidate(out, lesson, judgement, settings.model)
    for line in left_out:
        print(f"left out: {line}", file=sys.stderr)
    for line in lesson_lines(lesson):
        print(line)
    if lesson.best is None:
        raise typer.Exit(ALL_DONE)
    show(votes_table(lesson), gates_table(judgement.gates))
    if lesson.tied:
        folder = lesson.cycles[0].folder
        print(
            f"the motion that tells them apart: cell suggest {folder / 'study'} --config {config} "
            f"-o motion.yaml, then cell run --config {config} --motion motion.yaml, and learn again"
        )
    if judgement.fit_for_line:
        print(f"written to {out}; use it with: cell promote {out} --config {config}")
        raise typer.Exit(ALL_DONE)
    failed = ", ".join(g.name for g in judgement.gates if not g.passed)
    print(f"{out} is not fit for the line: {failed}; record more cycles and learn again")
    raise typer.Exit(NOT_ALL_DONE)


@app.command()
def promote(
    config: Config,
    candidate: Annotated[
        Path | None, typer.Argument(help="Candidate by `cell learn -o`.", show_default=False)
    ] = None,
    undo: Annotated[
        bool, typer.Option("--undo", help="Go back to the model before the last promotion.")
    ] = False,
) -> None:
    """Write a candidate's model into the settings, or take the last one out again.

    Comments and order are kept; the settings as they were go to a folder beside.  Killed at any
    moment it leaves the old settings or the new ones.
    """
    from cell.settings.promotion import promote as promote_model
    from cell.settings.promotion import read_candidate
    from cell.settings.promotion import undo as undo_last

    with refusing():
        if undo == (candidate is not None):
            raise ValueError("give a candidate, or --undo")
        if candidate is None:
            entry = undo_last(config)
            print(f"{config}: the model is again that of {entry}")
        else:
            entry = promote_model(read_candidate(candidate), config)
            print(f"{config}: has the model of {candidate}; the former settings are in {entry}")
