"""What the commands share: exit codes, options, refusing bad input, one interruption."""

from __future__ import annotations

import getpass
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from cell.computer.watched import ANSWERED, responds_after_interrupt
from cell.files.overwriting import check_distinct, check_output
from cell.files.rescue import no_room, remedy
from drivers.installing import install_extra

if TYPE_CHECKING:
    from cell.cli.progress import ProgressLine

ALL_DONE, NOT_ALL_DONE, BAD_INPUT = 0, 1, 2
#: Stands for the standard output where a file could be given.
STDOUT = Path("-")

Config = Annotated[
    Path, typer.Option("--config", "-c", help="Settings of the cell, YAML.", show_default=False)
]

MaybeConfig = Annotated[
    Path | None, typer.Option("--config", "-c", help="Settings of the cell, YAML.")
]
OfProduct = Annotated[
    str | None,
    typer.Option("--product", help="Product of the settings; default: the entry `product`."),
]
Force = Annotated[
    bool, typer.Option("--force", help="Overwrite files that this program did not write.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]


def group(name: str | None = None, **more: Any) -> typer.Typer:
    """Typer app for the commands of one module.

    name  of a command that has others below it; None = `cell.cli` takes them in at its top level
    more  arguments of typer
    """
    return typer.Typer(
        name=name,
        no_args_is_help=name is None,
        invoke_without_command=name is not None,
        pretty_exceptions_enable=False,
        add_completion=False,
        **more,
    )


def refuse(error: Exception) -> NoReturn:
    """Exit with code 2 after printing the error."""
    print(error, file=sys.stderr)
    raise typer.Exit(BAD_INPUT) from error


@contextmanager
def needing(extra: str, need: str, *packages: str) -> Iterator[None]:
    """Exit with code 2 and the extra to install if one of `packages` is missing."""
    try:
        yield
    except ImportError as error:
        package = (error.name or "").partition(".")[0]
        if package not in packages:
            raise
        refuse(ValueError(f"{need} {package}: {install_extra(extra)}"))


def user_name() -> str:
    """Who is logged in; a service may have no name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "somebody"


def tell_notes(notes: Sequence[str]) -> None:
    """Print notes about a study or its results on the error stream."""
    for note in notes:
        print(f"note: {note}", file=sys.stderr)


class Interruption:
    """Whether Ctrl-C or SIGTERM was received; true from then on."""

    def __init__(self) -> None:
        self._number = 0

    def __bool__(self) -> bool:
        return self._number != 0

    @property
    def code(self) -> int:
        """Exit code of a command that ends because of it."""
        return 128 + self._number

    def end_command(self) -> None:
        """End the command if it was received, once its results are printed."""
        if self:
            raise typer.Exit(self.code)

    def give(self, number: int) -> bool:
        """A signal is there; whether it is the first, of which a person is told."""
        if self:
            return False
        self._number = number
        print("interrupted: the results so far follow; Ctrl-C again ends it", file=sys.stderr)
        return True


@contextmanager
def stoppable(stop: Callable[[], None]) -> Iterator[Interruption]:
    """Let Ctrl-C or SIGTERM call `stop`, which asks for the results so far; the command goes on.

    If `stop` raises KeyboardInterrupt, there are no results.
    """
    given = Interruption()

    def ask(number: int, frame: FrameType | None) -> None:
        given.give(number)
        stop()

    with _interrupting(ask, given):
        yield given


#: Of these a callback drops what is raised in it, and they fail of what they then lack …
_NEVER_WITHIN = ("numba", "llvmlite")
#: … so that one waits for their end, s.
_POSTPONED_S = 0.05


@contextmanager
def answering() -> Iterator[Interruption]:
    """Let the first Ctrl-C or SIGTERM raise KeyboardInterrupt, so that results so far are printed.

    While something is compiled it waits.
    """
    given = Interruption()

    def interrupt(number: int, frame: FrameType | None) -> None:
        if given.give(number):
            raise_outside(number, frame)

    def raise_outside(number: int, frame: FrameType | None) -> None:
        if _is_within(frame):
            signal.setitimer(signal.ITIMER_REAL, _POSTPONED_S)
        else:
            raise KeyboardInterrupt

    former = signal.signal(signal.SIGALRM, raise_outside)
    try:
        with _interrupting(interrupt, given):
            yield given
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, former)


@contextmanager
def unhindered() -> Iterator[None]:
    """Ignore Ctrl-C and SIGTERM within the `with`, which must be short."""
    former = {s: signal.signal(s, signal.SIG_IGN) for s in ANSWERED}
    try:
        yield
    finally:
        for s, handler in former.items():
            signal.signal(s, handler)


def _is_within(frame: FrameType | None) -> bool:
    """Whether this frame, or one that it was called by, is of the compiler."""
    while frame is not None:
        if str(frame.f_globals.get("__name__")).partition(".")[0] in _NEVER_WITHIN:
            return True
        frame = frame.f_back
    return False


@contextmanager
def _interrupting(
    handler: Callable[[int, FrameType | None], None], given: Interruption
) -> Iterator[None]:
    """Signals that end a command go to a handler; once one was given, no more are heard after.

    A command that knows nothing then ends, and says so.
    """
    responds_after_interrupt()
    former = {s: signal.signal(s, handler) for s in ANSWERED}
    try:
        yield
    except KeyboardInterrupt as error:
        if not given:
            raise
        known = "".join(f": {word}" for word in error.args if word)
        print(f"there are no results yet, and nothing was written{known}", file=sys.stderr)
        raise typer.Exit(given.code) from error
    finally:
        for s, before in former.items():
            signal.signal(s, signal.SIG_IGN if given else before)


#: Signals that end what moves a cell, and what they say of why.
_ENDING = {
    signal.SIGINT: "",
    signal.SIGTERM: "",
    signal.SIGHUP: "the terminal was closed",
}


@contextmanager
def interrupted_once() -> Iterator[Callable[[], None]]:
    """Let the first Ctrl-C, SIGTERM or closed terminal interrupt; ignore all later ones.

    What was ignored before, as `nohup` has a closed terminal ignored, stays so.
    """
    given: list[KeyboardInterrupt] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        if not given:
            why = _ENDING[signal.Signals(number)]
            given.append(KeyboardInterrupt(*([why] if why else [])))
            raise given[0]
        with suppress(OSError):  # nobody reads it any more
            print("already stopping", file=sys.stderr)

    def not_lost() -> None:
        """Interrupt again: where Python cannot raise, as in a callback, it drops what is raised."""
        if given:
            raise given[0]

    heard = [s for s in _ENDING if signal.getsignal(s) is not signal.SIG_IGN]
    former = {s: signal.signal(s, interrupt) for s in heard}
    try:
        yield not_lost
    finally:
        for s, handler in former.items():
            signal.signal(s, handler)


@contextmanager
def refusing(*outputs: Path | None, force: bool | None = None) -> Iterator[None]:
    """Exit with code 2 and a message, before anything is written, if the input is wrong.

    outputs  files to be written at the end of a long computation: tried at its beginning
    force    whether they may take the place of what no command wrote; None = there is no `--force`
    """
    try:
        files = [output for output in outputs if output is not None and output != STDOUT]
        check_distinct(files)
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


def working(command: str) -> ProgressLine:
    """Progress line of a command, on the error stream."""
    from cell.cli.progress import ProgressLine

    return ProgressLine(command)
