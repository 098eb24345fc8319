"""Shared by the commands: exit codes, options, refusal of bad input, interruption."""

from __future__ import annotations

import getpass
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout, suppress
from contextvars import ContextVar
from dis import opname
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from cell.computer.watched import ANSWERED, responds_after_interrupt
from cell.files.overwriting import CommandLine, check_distinct, check_output
from cell.files.rescue import no_room, remedy
from drivers.installing import install_extra

if TYPE_CHECKING:
    from cell.cli.progress import ProgressLine

#: Of a signal: gets its number and the interrupted frame.
_Handler = Callable[[int, FrameType | None], None]

ALL_DONE, NOT_ALL_DONE, BAD_INPUT = 0, 1, 2
#: The command that is being run.
COMMAND_LINE: ContextVar[CommandLine | None] = ContextVar("COMMAND_LINE", default=None)
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
    bool, typer.Option("--force", help="Overwrite files that this command did not write.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]


def group(name: str | None = None, **more: Any) -> typer.Typer:
    """Typer app for the commands of one module.

    name  of a command with subcommands; None = `cell.cli` adds them at its top level
    more  arguments of `typer.Typer`
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
    """Name of the logged-in user; a service may have none."""
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
        """Register a signal; whether it is the first, which is reported on the error stream."""
        if self:
            return False
        self._number = number
        print("interrupted: the results so far follow; Ctrl-C again ends it", file=sys.stderr)
        return True


@contextmanager
def stoppable(stop: Callable[[], None]) -> Iterator[Interruption]:
    """Let Ctrl-C or SIGTERM call `stop`, which ends the work early; the command goes on.

    If `stop` raises KeyboardInterrupt, there are no results.
    """
    interruption = Interruption()

    def ask(number: int, frame: FrameType | None) -> None:
        interruption.give(number)
        stop()

    with _interrupting(ask, interruption):
        yield interruption


#: Callbacks of these packages drop exceptions, and they fail afterwards …
_NEVER_WITHIN = ("numba", "llvmlite")
#: … so an interruption is retried until they have ended, at this interval, s.
_POSTPONED_S = 0.05


@contextmanager
def answering() -> Iterator[Interruption]:
    """Let the first Ctrl-C or SIGTERM raise KeyboardInterrupt, so that results so far are printed.

    While something is compiled it waits.
    """
    interruption = Interruption()

    def interrupt(number: int, frame: FrameType | None) -> None:
        if interruption.give(number):
            raise_outside(number, frame)

    def raise_outside(number: int, frame: FrameType | None) -> None:
        if _is_within(frame):
            signal.setitimer(signal.ITIMER_REAL, _POSTPONED_S)
        else:
            raise KeyboardInterrupt

    with handled(raise_outside, signal.SIGALRM):
        try:
            with _interrupting(interrupt, interruption):
                yield interruption
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)


@contextmanager
def handled(handler: _Handler | signal.Handlers, *signals: signal.Signals) -> Iterator[None]:
    """Handle these signals within the `with`; then their former handlers are restored."""
    former = {s: signal.signal(s, handler) for s in signals}
    try:
        yield
    finally:
        for s, before in former.items():
            signal.signal(s, before)


def _is_within(frame: FrameType | None) -> bool:
    """Whether this frame, or one of its callers, belongs to the compiler."""
    while frame is not None:
        if str(frame.f_globals.get("__name__")).partition(".")[0] in _NEVER_WITHIN:
            return True
        frame = frame.f_back
    return False


@contextmanager
def _interrupting(handler: _Handler, interruption: Interruption) -> Iterator[None]:
    """Pass signals that end a command to a handler; after an interruption they are ignored.

    A command without results then ends, and prints so.
    """
    responds_after_interrupt()
    former = {s: signal.signal(s, handler) for s in ANSWERED}
    try:
        yield
    except KeyboardInterrupt as error:
        if not interruption:
            raise
        known = "".join(f": {word}" for word in error.args if word)
        print(f"there are no results yet, and nothing was written{known}", file=sys.stderr)
        raise typer.Exit(interruption.code) from error
    finally:
        for s, before in former.items():
            signal.signal(s, signal.SIG_IGN if interruption else before)


#: Signals that end a command that moves a cell, and the reason that is reported.
_ENDING = {
    signal.SIGINT: "",
    signal.SIGTERM: "",
    signal.SIGHUP: "the terminal was closed",
}


class SingleInterruption:
    """The signal that `interrupted_once` has received, if there was one."""

    def __init__(self) -> None:
        self.number = 0
        self.error: KeyboardInterrupt | None = None

    def raise_again(self) -> None:
        """Interrupt again: exceptions that are raised in a callback are dropped by Python."""
        if self.error is not None:
            raise self.error

    def code(self, usual: int) -> int:
        """Exit code after Ctrl-C or SIGTERM, otherwise the usual one."""
        return 128 + self.number if self.number in ANSWERED else usual


@contextmanager
def interrupted_once() -> Iterator[SingleInterruption]:
    """Let the first Ctrl-C, SIGTERM or closed terminal interrupt; ignore all later ones.

    Signals that were ignored before, as by `nohup`, stay ignored.
    """
    interruption = SingleInterruption()

    def interrupt(number: int, frame: FrameType | None) -> None:
        if interruption.error is None:
            interruption.number = number
            why = _ENDING[signal.Signals(number)]
            interruption.error = KeyboardInterrupt(*([why] if why else []))
            raise interruption.error
        with suppress(OSError):  # nobody reads it any more
            print("already stopping", file=sys.stderr)

    heard = [s for s in _ENDING if signal.getsignal(s) is not signal.SIG_IGN]
    with handled(interrupt, *heard):
        yield interruption


@contextmanager
def reserved_output() -> Iterator[None]:
    """Send what is printed to the error stream, also by processes that start in the `with`.

    The standard output is then left to a result in JSON: an effect of the user's own may print.
    """
    sys.stdout.flush()
    output = os.dup(1)
    os.dup2(2, 1)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(output, 1)
        os.close(output)


#: Packages whose errors have messages for people.
_OURS = ("calib", "cell", "drivers", "tools")


def _is_about_input(error: Exception) -> bool:
    """Whether an error has a message for people: its class is ours, or our code raised it.

    Another ValueError, such as that of `max([])`, is a fault of this program.
    """
    if isinstance(error, FileNotFoundError) or type(error).__module__.split(".")[0] in _OURS:
        return True
    traceback = error.__traceback__
    if traceback is None or error.__cause__ is not None:  # it comes from another error or process
        return True
    while traceback.tb_next is not None:
        traceback = traceback.tb_next
    frame = traceback.tb_frame
    is_raised = opname[frame.f_code.co_code[traceback.tb_lasti]] == "RAISE_VARARGS"
    return is_raised and str(frame.f_globals.get("__name__")).split(".")[0] in _OURS


@contextmanager
def refusing(*outputs: Path | None, force: bool | None = None) -> Iterator[None]:
    """Exit with code 2 and a message, before anything is written, if the input is wrong.

    outputs  files to be written after a long computation: checked before it
    force    whether they may replace files that this command did not write, inputs excepted;
             None = there is no `--force`
    """
    try:
        files = [output for output in outputs if output is not None and output != STDOUT]
        check_distinct(files)
        for output in files:
            check_output(output, force=force, command=COMMAND_LINE.get())
        with reserved_output() if STDOUT in outputs else nullcontext():
            yield
    except (FileNotFoundError, ValueError) as error:  # InputError, EffectError … among them
        if not _is_about_input(error):
            raise
        if isinstance(error, FileNotFoundError) and error.filename is not None:
            print(f"{error.filename}: {error.strerror}; check the name", file=sys.stderr)
        else:
            print(error, file=sys.stderr)
        raise typer.Exit(BAD_INPUT) from error
    except OSError as error:  # of an invalid name, a folder without access, …
        if error.filename is None or no_room(error):
            raise
        print(f"{error.filename}: {error.strerror}; {remedy(error)}", file=sys.stderr)
        raise typer.Exit(BAD_INPUT) from error


def working(command: str) -> ProgressLine:
    """Progress line of a command, on the error stream."""
    from cell.cli.progress import ProgressLine

    return ProgressLine(command)
