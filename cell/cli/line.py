"""Commands from the lab to the line: learn, promote."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.arguments import Workers, folder_in, taking, workers
from cell.cli.ledger import LedgerPlace, Since, listed_cycles
from cell.cli.output import Delivery, deliver, show
from cell.cli.shared import (
    ALL_DONE,
    NOT_ALL_DONE,
    Config,
    Interruption,
    OfProduct,
    answering,
    group,
    refusing,
    working,
)

if TYPE_CHECKING:
    from cell.api.line import LearnResult
    from cell.lab.data.work import Progress
    from cell.lab.line.effect_fit import LearningResult
    from cell.settings.model import Settings

app = group()


OwnEffects = Annotated[
    list[str] | None,
    typer.Option("--try", help="A file.py with an effect of your own; it is tried too."),
]
Recorded = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Folders of recorded cycles, folders of such folders, or recordings.  Default: "
        "the line's cycles in the ledger; with --since they are added.",
    ),
]
LawsFolder = Annotated[
    Path | None,
    typer.Option(
        "--laws", help="Also try laws outside the library; write those found to this folder."
    ),
]


@dataclass(frozen=True)
class LearnOptions:
    """Options of `cell learn`, as typer takes them."""

    config: Config
    runs: Recorded = None
    product: OfProduct = None
    since: Since = None
    ledger: LedgerPlace = None
    out: Annotated[Path, typer.Option("-o", "--out", help="Write the candidate model here.")] = (
        Path("candidate.yaml")
    )
    effect: OwnEffects = None
    laws: LawsFolder = None
    where: Workers = None

    def folders(self, settings: Settings, opened: ExitStack) -> list[Path]:
        """Folders of the cycles: the arguments, and those of the ledger if named or without any.

        opened  keeps the folders of recordings until it is closed
        """
        folders = [folder_in(opened.enter_context, run) for run in self.runs or ()]
        if self.since or self.ledger or not folders:
            folders += listed_cycles(settings, self.ledger, self.since)
        return folders

    def repeated(self, product: str | None) -> str:
        """`cell learn` again, with the cables that are measured meanwhile."""
        cycles: list[object] = [*(self.runs or ())]
        for option, value in (("--since", self.since), ("--runs", self.ledger)):
            cycles += [option, value] if value else []
        cycles = cycles or ["--since", "2000-01-01"]
        measured = _recording_folder(self.out)
        words = [*cycles, *([] if measured in cycles else [measured]), *_line(self.config, product)]
        words += [w for effect in self.effect or () for w in ("--try", effect)]
        words += [] if self.laws is None else ["--laws", self.laws]
        return _command_line(["cell", "learn", *words, "-o", self.out])


@app.command()
@taking(LearnOptions)
def learn(options: LearnOptions) -> None:
    """Find the effect that the line's model lacks, from recorded cycles of many cables.

    Effects are shared by all cables; EI(s), N and viscosity are fitted per cable.  Every recorded
    insertion is forecast from the hold of its own cycle, with the effect that was fitted to the
    other cables.  Exit codes: 0 if a candidate passed every gate or nothing is missing; 1 if a
    candidate did not pass; 2 if the input is wrong.
    """
    from cell.api.line import judged
    from cell.lab.data.cycles import read_cycles
    from cell.lab.data.named_effects import select_effects
    from cell.lab.line.candidate import lines_of
    from cell.lab.line.learn import learn as learn_from
    from cell.lab.next.discover import Laws, laws_in
    from cell.settings.loading import load_product
    from cell.settings.promotion import other_lines
    from cell.settings.translate import cable_of, identification_of

    known: list[LearningResult] = []
    config, out, laws = options.config, options.out, options.laws
    own = options.effect or []
    more = Laws({}, ())
    with (
        refusing(out, _motion(out)),
        working("learn") as progress,
        answering() as interrupted,
        _so_far(known, interrupted, lambda: more.keep(())),
        ExitStack() as opened,
    ):
        settings = load_product(config, options.product)
        cable, identification = cable_of(settings), identification_of(settings)
        folders = options.folders(settings, opened)
        cycles, left_out = read_cycles(folders, cable, settings.product)
        lines = lines_of(cycles, settings)
        library = select_effects([], own).candidates
        if laws is not None:
            known_effects = (*identification.kind.effects, *library.values())
            more = laws_in(laws, [c.study for c in cycles], known_effects)
        with workers(options.where, config) as executor:
            tried = library | more.effects
            learning = learn_from(
                cycles, cable, identification, tried, progress, known.append, executor=executor
            )
        learned = judged(learning, settings, left_out)
        result = learned.learned
        law_files = more.keep(result.best.effects if result.best else ())
        todo, motion = _asking(result, options, settings.product, progress)
    missed = [f"left out: {line}" for line in learned.left_out]
    for line in (*missed, *other_lines(lines, settings)):
        print(line, file=sys.stderr)
    more_lines = (*(f"the law is written to {path}" for path in law_files), *todo)
    raise typer.Exit(_deliver(learned, more_lines, motion, options))


def _deliver(
    learned: LearnResult, more: Sequence[str], motion: Sequence[Delivery], options: LearnOptions
) -> int:
    """Print what was learned and write the candidate; the exit code."""
    config, out = options.config, options.out

    def printed() -> None:
        show(*learned.parts(), *more)

    if learned.learned.best is None:
        deliver(printed)
        print(f"{out} is not written: there is no candidate")
        return ALL_DONE
    deliver(printed, (out, learned.write), *motion)
    if learned.fit_for_line:
        print(f"written to {out}; use it with: cell promote {out} --config {config}")
        return ALL_DONE
    failed = ", ".join(learned.judgement.failed)
    laws = "" if options.laws else f", or with --laws {out.with_suffix('.laws')}"
    print(f"{out} is not fit for the line: {failed}; record more cycles and learn again{laws}")
    return NOT_ALL_DONE


@contextmanager
def _so_far(
    known: Sequence[LearningResult], interrupted: Interruption, tidy_up: Callable[[], object]
) -> Iterator[None]:
    """Interrupted, it prints the last of what is known by then, and ends the command."""
    from cell.lab.report.line_tables import learning_lines

    try:
        yield
    except KeyboardInterrupt as error:
        tidy_up()
        if not known:
            raise
        for line in learning_lines(known[-1], so_far=True):
            print(line)
        raise typer.Exit(interrupted.code) from error


def _line(config: Path, product: str | None) -> list[object]:
    """Options that name a line and its product."""
    return ["--config", config, *([] if product is None else ["--product", product])]


def _command_line(words: Sequence[object]) -> str:
    """A command as it can be typed."""
    return " ".join(shlex.quote(str(w)) for w in words)


def _motion(out: Path) -> Path:
    """File of a requested motion; the trial is named after the file."""
    return out.with_name(re.sub(r"\W", "_", f"{out.stem}_motion") + ".yaml")


def _recording_folder(out: Path) -> Path:
    """Folder for recordings of cables that are measured because of a candidate."""
    return out.with_suffix(".measured")


def _asking(
    result: LearningResult, options: LearnOptions, product: str | None, progress: Progress
) -> tuple[list[str], list[Delivery]]:
    """Commands for the motion that distinguishes the tied effects, and its file."""
    from cell.lab.next.motion_file import write_motion
    from cell.lab.next.suggest import (
        MOST_CANDIDATES,
        MOST_REQUESTED,
        distinguishing_motions,
        worth_measuring,
    )
    from cell.settings.surroundings import Surroundings

    if not result.tied:
        return [], []
    if sum(c.held is None for c in result.cycles) >= MOST_REQUESTED:  # measured by such a motion
        sentence = (
            f"{MOST_REQUESTED} motions could not distinguish the tied effects on these cables"
        )
        return [sentence], []
    try:
        around = Surroundings.read(options.config, product)
        cable = result.baseline.cables[0]
        rivals = result.rivals()[:MOST_CANDIDATES]
        suggestion = distinguishing_motions(cable, rivals, around, progress)
    except ValueError as error:
        return [f"no motion distinguishes the tied effects: {error}"], []
    best = worth_measuring(suggestion)
    if best is None:
        return ["no safe motion is likely to distinguish the tied effects on these cables"], []
    motion, line = _motion(options.out), _line(options.config, product)
    words = ["cell", "run", *line, "--motion", motion, "--runs", _recording_folder(options.out)]
    lines = [
        f"this motion distinguishes the tied effects with probability {best.power:.2f}: "
        f"{best.motion.describe()}; measure a cable with it, and learn again:",
        f"  {_command_line(words)}",
        f"  {options.repeated(product)}",
    ]
    return lines, [(motion, partial(write_motion, suggestion))]


@app.command()
def promote(
    config: Config,
    candidate: Annotated[
        Path | None,
        typer.Argument(help="Candidate written by `cell learn -o`.", show_default=False),
    ] = None,
    product: OfProduct = None,
    undo: Annotated[
        bool, typer.Option("--undo", help="Restore the model before the last promotion.")
    ] = False,
    from_another_line: Annotated[
        bool,
        typer.Option(
            "--from-another-line", help="Accept a candidate that was learned on another line."
        ),
    ] = False,
) -> None:
    """Write a candidate's model into the settings, or remove the last one again.

    A candidate that was learned with another data sheet, camera, arm, calibration or simulated
    world is refused, unless --from-another-line is given.

    In settings with products, the model is written to the section of its product.
    Comments and order of the settings are kept.  The former settings are saved in a folder beside
    the file.  If the command is killed, the file has either the old settings or the new ones.
    """
    from cell.settings.loading import load_product
    from cell.settings.promotion import promote as promote_model
    from cell.settings.promotion import read_candidate
    from cell.settings.promotion import undo as undo_last

    with refusing():
        if undo == (candidate is not None):
            both = "" if candidate is None else ", not both"
            raise ValueError(f"give a candidate, or --undo{both}")
        if candidate is None:
            entry = undo_last(config, load_product(config, product).product)
            print(f"{config}: the model is again that of {entry}")
        else:
            learned = read_candidate(candidate)
            if product is not None and learned.product != product:
                raise ValueError(f"{candidate}: is of product {learned.product}, not {product}")
            entry = promote_model(learned, config, from_another_line=from_another_line)
            print(f"{config}: has the model of {candidate}; the former settings are in {entry}")
