"""Commands that calibrate a cell: calibrate, and its parts."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.output import print_json
from cell.cli.shared import (
    ALL_DONE,
    NOT_ALL_DONE,
    Config,
    MaybeConfig,
    OfProduct,
    interrupted_once,
    refuse,
    refusing,
    working,
)

if TYPE_CHECKING:
    from cell.calibration.work import CalibrationJob

_LOG = logging.getLogger(__name__)

app = typer.Typer(
    name="calibrate",
    help="Calibrate a cell, or a part of it, and state the errors of the result.",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]
Source = Annotated[
    Path | None,
    typer.Option("--from", help="A folder of recordings, used instead of the devices."),
]
Dialogue = Annotated[
    bool,
    typer.Option(
        "--dialogue",
        help="For programs: JSON lines on the standard output, answers on the standard input.",
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Random seed of a simulated or emulated cell.")]


@app.callback()
def everything(
    context: typer.Context,
    config: MaybeConfig = None,
    product: OfProduct = None,
    seed: Seed = 1,
    as_json: AsJson = False,
    dialogue: Dialogue = False,
) -> None:
    """Calibrate camera, cell, time and grip, one after the other.

    A person shows the board.  Then the gripper moves within `limits`, first with empty jaws, last
    with a cable.  Exit codes: 0 if the result is good enough for `cell run`; 1 if not; 2 if the
    settings are wrong or the measurements contradict each other.
    """
    if context.invoked_subcommand is not None:
        return
    if config is None:
        refuse(ValueError("cell calibrate: --config is missing; give the settings of the cell"))
    with _workshop(config, seed, as_json, product=product, dialogue=dialogue) as work:
        for part in ("camera", "cell", "time", "grip"):
            work.do(part)
        _end(work, as_json)


@app.command()
def camera(
    config: Config,
    source: Source = None,
    seed: Seed = 1,
    as_json: AsJson = False,
    dialogue: Dialogue = False,
) -> None:
    """Find the lens from pictures of the board, live or from a folder.

    Exit codes: 0 if the result is good enough for `cell run`; 1 if not; 2 if the settings are wrong
    or the measurements contradict each other.
    """
    _part("camera", config, source, seed, as_json, dialogue)


@app.command()
def cell(
    config: Config,
    source: Source = None,
    seed: Seed = 1,
    as_json: AsJson = False,
    dialogue: Dialogue = False,
) -> None:
    """Find the map from pixels to the cell's plane, by the plate on the gripper; needs the lens.

    Exit codes: 0 if the result is good enough for `cell run`; 1 if not; 2 if the settings are wrong
    or the measurements contradict each other.
    """
    _part("cell", config, source, seed, as_json, dialogue)


@app.command("time")
def time_(
    config: Config,
    source: Source = None,
    seed: Seed = 1,
    as_json: AsJson = False,
    dialogue: Dialogue = False,
) -> None:
    """Find the camera's latency and the arm's lag from one motion; needs the cell.

    Exit codes: 0 if the result is good enough for `cell run`; 1 if not; 2 if the settings are wrong
    or the measurements contradict each other.
    """
    _part("time", config, source, seed, as_json, dialogue)


@app.command()
def grip(
    config: Config,
    product: OfProduct = None,
    source: Source = None,
    seed: Seed = 1,
    as_json: AsJson = False,
    dialogue: Dialogue = False,
) -> None:
    """Find gripping point, clamp angle and free length of a cable in the jaws; needs the cell.

    Each product of the settings has its own.

    Exit codes: 0 if the result is good enough for `cell run`; 1 if not; 2 if the settings are wrong
    or the measurements contradict each other.
    """
    _part("grip", config, source, seed, as_json, dialogue, product)


@app.command()
def check(
    config: Config, seed: Seed = 1, as_json: AsJson = False, dialogue: Dialogue = False
) -> None:
    """Check the stored calibration in less than a minute, and name the command that corrects it.

    Exit codes: 0 if the calibration is still valid; 1 if not.
    """
    with _workshop(config, seed, as_json, gripped=False, dialogue=dialogue) as work:
        found = work.check()
        if as_json:
            print_json(vars(found))
        else:
            print(found.sentence + ("" if found.command is None else f"; run `{found.command}`"))
        raise typer.Exit(ALL_DONE if found.good else NOT_ALL_DONE)


@app.command()
def board(
    out: Annotated[Path, typer.Option("--out", "-o", help="The PDF file to write.")] = Path(
        "board.pdf"
    ),
    columns: Annotated[int, typer.Option(min=3, max=40, help="Squares across.")] = 12,
    rows: Annotated[int, typer.Option(min=3, max=40, help="Squares down.")] = 9,
    square_mm: Annotated[float, typer.Option(min=1.0, max=200.0, help="Side of a square.")] = 20.0,
    dictionary: Annotated[
        str, typer.Option(help="Dictionary of the markers in OpenCV.")
    ] = "4X4_100",
    legacy: Annotated[
        bool, typer.Option("--legacy", help="Use the pattern of OpenCV before 4.6.")
    ] = False,
) -> None:
    """Write the board as a PDF at full scale, with rulers to check the printout."""
    from calib.board import Board, board_pdf
    from cell.files.atomic import write_atomic

    with refusing(out, force=out.suffix.lower() == ".pdf"):
        board = Board(columns, rows, square_mm / 1e3, dictionary=dictionary, legacy=legacy)
        write_atomic(out, board_pdf(board))
    print(f"{out}: print at 100 %, measure ten squares, put the result in calibration.square_m")


def _part(
    part: str,
    config: Path,
    source: Path | None,
    seed: int,
    as_json: bool,
    dialogue: bool,
    product: str | None = None,
) -> None:
    with _workshop(
        config,
        seed,
        as_json,
        live=source is None,
        product=product,
        gripped=part == "grip",
        dialogue=dialogue,
    ) as work:
        made = work.do(part, source)
        if made is None:
            raise typer.Exit(NOT_ALL_DONE)
        _end(work, as_json)


def _end(work: CalibrationJob, as_json: bool) -> None:
    if as_json:
        print_json(work.summary())
    else:
        print("\n".join(work.lines()))
    wrong = work.shortcomings()
    for line in wrong:
        print(line, file=sys.stderr)
    raise typer.Exit(NOT_ALL_DONE if wrong else ALL_DONE)


@contextmanager
def _workshop(
    config: Path,
    seed: int,
    as_json: bool,
    *,
    live: bool = True,
    product: str | None = None,
    gripped: bool = True,
    dialogue: bool = False,
) -> Iterator[CalibrationJob]:
    """Everything that calibrating needs; what goes wrong is said and ends with 2.

    gripped  a cable is gripped, so that it must be said of which product
    """
    from cell.calibration.assistants import write_coverage
    from cell.calibration.work import BrokenOffError, CalibrationJob
    from cell.cli.logs import to_file
    from cell.files.input_error import InputError
    from cell.settings import load_settings
    from cell.settings.loading import load_product

    progress = working("calibrate")

    def tell(**message: object) -> None:
        print(json.dumps(message, ensure_ascii=False), flush=True)

    def say(text: str, done: int = 0, total: int = 0) -> None:
        """Kept as a line, and under way until the next one."""
        _LOG.info("%s", text)
        if dialogue:
            tell(say=text, done=done, total=total)
            return
        print(f"{text}, {done} of {total}" if total else text, file=sys.stderr, flush=True)
        progress(text, done, total)

    def ask(words: str) -> str:
        if dialogue:
            tell(ask=words)
            answer = sys.stdin.readline()
            if not answer:
                raise EOFError
            return answer.strip()
        if as_json or not sys.stdin.isatty():
            raise EOFError
        with progress.paused():
            return input(words + " ")

    try:
        settings = load_product(config, product) if gripped else load_settings(config)
        if settings.calibration is not None:
            to_file(settings.calibration.folder / "calibration.log")
        look = (
            partial(write_coverage, settings.calibration.folder)
            if (dialogue and settings.calibration is not None)
            else None
        )
        with (
            interrupted_once(),
            progress,
            CalibrationJob(settings, config, seed, say, ask, live=live, look=look) as work,
        ):
            yield work
    except (InputError, BrokenOffError) as error:
        refuse(error)
    except OSError as error:
        refuse(
            ValueError(f"{error.filename or config}: {error.strerror or error}; make room there")
        )
