"""The command that emulates a cell's devices: emulate."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.shared import NOT_ALL_DONE, Config, group, interrupted_once, refuse


class TypedLines:
    """Lines of standard input as they come, without waiting for its end.

    A process in the background of a terminal reads nothing, because that would halt it.
    """

    def __init__(self) -> None:
        self._begun = b""
        try:
            self._descriptor = -1 if sys.stdin is None else sys.stdin.fileno()
        except (OSError, ValueError):
            self._descriptor = -1

    def within(self, seconds: float) -> list[str]:
        """Those that come within a time, without the blanks around them; empty ones are left out.

        It returns with the first that comes.
        """
        if self._descriptor < 0 or not self._is_ours():
            time.sleep(seconds)
            return []
        if not select.select([self._descriptor], [], [], seconds)[0]:
            return []
        try:
            new = os.read(self._descriptor, 4096)
        except OSError:
            new = b""
        if not new:  # it has ended, or the terminal is gone
            self._descriptor = -1
        *lines, self._begun = (self._begun + new).split(b"\n")
        words = (line.decode(errors="replace").strip() for line in lines)
        return [w for w in words if w]

    def _is_ours(self) -> bool:
        if not os.isatty(self._descriptor):
            return True
        try:
            return os.tcgetpgrp(self._descriptor) == os.getpgrp()
        except OSError:
            return False


if TYPE_CHECKING:
    from cell.wiring.faults import DeviceFaults

app = group()


@app.command()
def emulate(
    config: Config,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of hidden cables and noise.")] = 1,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            "--fault",
            help="A fault of a device, NAME@2s = 2 s after the next cable is gripped, NAME = at "
            "once; `cell help commission` lists them.  The option may be repeated.",
        ),
    ] = None,
) -> None:
    """Emulate arm, camera and gripper at the addresses in the settings, until Ctrl-C.

    The settings need a section `emulated`.  `cell run` with the same settings then uses these
    devices; any other client of their protocols can use them too.  You can type faults while it
    runs, as with --fault; `repair` ends all of them.  The command also ends if its parent process
    ends.  Exit codes: 0; 1 if an emulator ended by itself; 2 if the settings or a fault are wrong
    or the addresses are in use.
    """
    from cell.files.input_error import InputError
    from cell.settings import load_settings
    from cell.wiring.build import emulating
    from cell.wiring.faults import DeviceFaults, read_fault

    parent = os.getppid()
    try:
        given = [read_fault(f) for f in fault or []]
    except ValueError as error:
        refuse(ValueError(f"--fault {error}"))
    try:
        settings = load_settings(config)
        with (
            interrupted_once(),
            emulating(settings, config, seed) as cell,
            contextlib.suppress(KeyboardInterrupt),
        ):
            print(cell.whereabouts(), flush=True)
            faults = DeviceFaults(cell, lambda text: print(text, file=sys.stderr, flush=True))
            for one in given:
                faults.give(one)
            typed = TypedLines()
            while os.getppid() == parent:
                if ended := cell.ended():
                    _report_ended(ended, config)
                    raise typer.Exit(NOT_ALL_DONE)
                for line in typed.within(0.2):
                    _apply(faults, line)
    except InputError as error:
        refuse(error)


def _apply(faults: DeviceFaults, line: str) -> None:
    """Do what was typed; what is not understood is said, and changes nothing."""
    from cell.wiring.faults import REPAIR, read_fault

    try:
        if line == REPAIR:
            faults.repair()
        else:
            faults.give(read_fault(line))
    except ValueError as error:
        print(f"{error}; or {REPAIR}", file=sys.stderr)


def _report_ended(ended: Sequence[str], config: Path) -> None:
    """Name the emulators that have ended, and what to do."""
    verb = "have" if len(ended) > 1 else "has"
    print(
        f"{' and '.join(ended)} {verb} ended; so do the others: start them again with "
        f"`cell emulate --config {config}`",
        file=sys.stderr,
    )
