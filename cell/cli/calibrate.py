"""Commands that calibrate a cell: calibrate, and its parts."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.arguments import taking
from cell.cli.output import print_json
from cell.cli.shared import (
    ALL_DONE,
    NOT_ALL_DONE,
    Config,
    MaybeConfig,
    OfProduct,
    group,
    interrupted_once,
    refuse,
    refusing,
    working,
)

if TYPE_CHECKING:
    from cell.calibration.work import CalibrationJob

_LOG = logging.getLogger(__name__)

app = group(
    "calibrate", help="Calibrate a cell, or a part of it, and state the errors of the result."
)

#: Parts of a calibration in their order: the help text of each one's command.
_PARTS = {
    "camera": "Calibrate the lens from pictures of the board, live or from a folder.",
    "cell": "Calibrate the map from pixels to the cell's plane with the jaw plate; needs the lens.",
    "time": "Measure the camera's latency and the arm's lag in one motion; needs `calibrate cell`.",
    "grip": "Measure gripping point, clamp angle and free length of a cable; needs `calibrate "
    "cell`.\n\nEach product of the settings has its own grip calibration.",
}
_CODES = """

Exit codes: 0 if the result is good enough for `cell run`; 1 if not; 2 if the settings are wrong or
the measurements contradict each other."""

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


@dataclass(frozen=True)
class _Calibrate:
    """Options of `cell calibrate` and of its parts; each part takes those that it needs."""

    config: Config
    seed: Seed = 1
    as_json: AsJson = False
    dialogue: Dialogue = False


@dataclass(frozen=True)
class _Part(_Calibrate):
    """Options of a part that can use recordings in place of the devices."""

    source: Source = None


@dataclass(frozen=True)
class _Grip(_Part):
    """Options of `cell calibrate grip`."""

    product: OfProduct = None


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
    options = _Calibrate(config, seed, as_json, dialogue)
    with _workshop(options, product=product) as work:
        work.check_files(*_PARTS)
        for part in _PARTS:
            work.do(part)
        _end(work, as_json)


def _add_part(part: str, text: str) -> None:
    """Add the command that calibrates one part."""
    kind = _Grip if part == "grip" else _Part

    @app.command(part, help=text + _CODES)
    @taking(kind)
    def calibrate_part(options: _Part) -> None:
        product = options.product if isinstance(options, _Grip) else None
        live, gripped = options.source is None, part == "grip"
        with _workshop(options, live=live, product=product, gripped=gripped) as work:
            work.check_files(part)
            if work.do(part, options.source) is None:
                raise typer.Exit(NOT_ALL_DONE)
            _end(work, options.as_json)


for _part, _text in _PARTS.items():
    _add_part(_part, _text)


@app.command()
@taking(_Calibrate)
def check(options: _Calibrate) -> None:
    """Check the stored calibration in less than a minute, and name the command that corrects it.

    Exit codes: 0 if the calibration is still valid; 1 if not.
    """
    with _workshop(options, gripped=False) as work:
        result = work.check()
        if options.as_json:
            print_json(vars(result))
        else:
            print(result.sentence + ("" if result.command is None else f"; run `{result.command}`"))
        raise typer.Exit(ALL_DONE if result.good else NOT_ALL_DONE)


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
    options: _Calibrate, *, live: bool = True, product: str | None = None, gripped: bool = True
) -> Iterator[CalibrationJob]:
    """Everything that calibrating needs; an error is printed and ends the command with 2.

    live     devices are used, not only folders
    gripped  a cable is gripped, so the product must be known
    """
    from cell.calibration.assistants import write_coverage
    from cell.calibration.work import BrokenOffError, CalibrationJob
    from cell.cli.logs import to_file
    from cell.files.input_error import InputError
    from cell.settings import load_settings
    from cell.settings.loading import load_product
    from cell.settings.starting import refuse_examples

    progress = working("calibrate")
    config, dialogue = options.config, options.dialogue

    def tell(**message: object) -> None:
        print(json.dumps(message, ensure_ascii=False), flush=True)

    def say(text: str, done: int = 0, total: int = 0) -> None:
        """Log a line, and show it as the current step until the next one."""
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
        if options.as_json or not sys.stdin.isatty():
            raise EOFError
        with progress.paused():
            return input(words + " ")

    try:
        settings = load_product(config, product) if gripped else load_settings(config)
        if live:
            refuse_examples(settings, config, inserts=False)
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
            CalibrationJob(settings, config, options.seed, say, ask, look) as work,
        ):
            yield work
    except (InputError, BrokenOffError) as error:
        refuse(error)
    except OSError as error:
        refuse(
            ValueError(f"{error.filename or config}: {error.strerror or error}; make room there")
        )
