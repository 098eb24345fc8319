"""Commands that move a cell, or emulate one: run, emulate."""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.options import taking
from cell.cli.part_ids import SCANNED, part_ids
from cell.cli.shared import (
    ALL_DONE,
    BAD_INPUT,
    NOT_ALL_DONE,
    Config,
    group,
    interrupted_once,
    refuse,
)
from cell.cli.streams import emit
from cell.cli.typed import TypedLines

if TYPE_CHECKING:
    from cell.records.result import Result
    from cell.run.cycle import Cell
    from cell.run.plans import Plan
    from cell.settings.model import Settings
    from cell.simulated.faults import Faults
    from cell.terminal.console import RunProgress

app = group()

_NEVER_SLOW = (
    "only with --dry-run; a cable that is moved slowly hardly swings, and a cable that does not "
    "swing cannot be identified"
)


DryRun = Annotated[
    bool,
    typer.Option(
        "--dry-run",
        help="Make all motions of a cycle with empty jaws, and check arm, camera and gripper.",
    ),
]
RunSeed = Annotated[
    int,
    typer.Option(
        min=0, help="Random seed of simulated cables and noise; the same seed repeats a run."
    ),
]
Records = Annotated[Path, typer.Option(help="Folder of the records: one folder in it per cycle.")]
PartId = Annotated[
    str | None,
    typer.Option(
        "--part-id",
        help="Id of the cable; of further ones its number counts on: A-09, A-10.  With - an id is "
        "read from standard input before each, as a scanner types it.",
    ),
]
MotionFile = Annotated[
    Path | None,
    typer.Option(help="Only measure, with this motion file (see `cell suggest`); insert nothing."),
]


@dataclass(frozen=True)
class RunOptions:
    """What `cell run` is told."""

    config: Config
    cycles: Annotated[int, typer.Option(min=1, help="Number of cables.")] = 1
    seed: RunSeed = 1
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object per cycle instead of tables.")
    ] = False
    out: Records = Path("runs")
    motion: MotionFile = None
    part_id: PartId = None
    dry_run: DryRun = False
    speed: Annotated[
        float,
        typer.Option(min=0.01, max=1.0, help="Share of full speed; only with --dry-run."),
    ] = 1.0


@app.command()
@taking(RunOptions)
def run(options: RunOptions) -> None:
    """Insert cables one after another, or measure them for the model lab, or make a dry run.

    Exit codes: 0 if all cables were inserted or measured, or if the dry run found no error; 1 if a
    cable was rejected or missed, a cycle failed or the dry run found an error; 2 if the settings or
    the motion are wrong, and nothing has moved.

    At a terminal, press h to hold: the current motion is finished, then the hand stays still with
    what it holds.  Press u to continue.  A hold never clears a stop.  Ctrl-C stops the arm and
    closes the record.
    """
    from cell.build import build_cell, emulators_asked_for
    from cell.files.input_error import InputError
    from cell.lab.next.motion_file import load_motion
    from cell.records.folder import RecordError
    from cell.run.plans import INSERTING, measuring
    from cell.settings import load_settings
    from cell.settings.calibrated import calibrated
    from cell.terminal.console import RunProgress, troubles
    from cell.terminal.logs import to_file

    if options.speed != 1.0 and not options.dry_run:
        refuse(ValueError(f"--speed {options.speed:g}: {_NEVER_SLOW}"))
    try:
        part_ids(options.part_id)
    except ValueError as error:
        refuse(ValueError(f"--part-id {error}"))
    results: list[Result] = []
    try:
        settings = load_settings(options.config)
        known = calibrated(settings, options.config)
        plan = (
            INSERTING
            if options.motion is None
            else measuring(load_motion(options.motion, settings))
        )
        to_file(options.out.with_name(f"{options.out.name}.log"))
        with (
            emulators_asked_for(settings, options.config, options.seed),
            interrupted_once() as not_lost,
            ExitStack() as shown,
        ):

            def on_step(number: int, step: str) -> None:
                not_lost()
                progress.step(number, step)

            made = partial(
                build_cell, seed=options.seed, on_step=on_step, known=known, recorded=True
            )
            cell = made(settings, options.out, cycles=0 if options.dry_run else options.cycles)
            try:
                if options.dry_run:
                    plan = cell.rehearsal(plan, options.speed)
                progress = shown.enter_context(RunProgress(options.cycles, plan.names))
                for result in _results(cell, plan, progress, options, settings):
                    results.append(result)
                    if options.as_json:
                        emit(json.dumps(result.to_json(), ensure_ascii=False))
            finally:
                cell.close()
    except InputError as error:
        refuse(error)
    except RecordError as error:  # it cannot even be begun: nothing of this cycle has moved
        print(
            f"{error}; choose another folder with --out, or make it writable, with room",
            file=sys.stderr,
        )
        raise typer.Exit(NOT_ALL_DONE if results else BAD_INPUT) from error
    if not options.as_json:
        _show(results, plan.names, options.dry_run, known.notes)
    changes = _changes(options.out, results, options.config, settings)
    for line in (*troubles(results), *cell.notes(), *changes):
        print(line, file=sys.stderr)
    reached = [r for r in results if r.outcome is plan.aim]
    raise typer.Exit(ALL_DONE if len(reached) == options.cycles else NOT_ALL_DONE)


def _results(
    cell: Cell, plan: Plan, progress: RunProgress, options: RunOptions, begun: Settings
) -> Iterator[Result]:
    """Results of one cycle after another, up to the first that fails; keys hold and go on.

    While ids are typed, no key holds the cell.
    begun  what the settings' file said when the run began: told once if it has changed
    """
    from cell.records.result import Outcome
    from cell.terminal.console import KEYS, MAY_HOLD
    from cell.terminal.keyboard import Keyboard

    def on_key(key: str) -> None:
        if key in KEYS:
            event, hint = KEYS[key]
            cell.command(event, f"key {key}")
            progress.hint(hint)

    said, parts = "", part_ids(options.part_id)
    with ExitStack() as listening:
        if options.part_id != SCANNED and listening.enter_context(Keyboard(on_key)).listens:
            progress.hint(MAY_HOLD)
        for number in range(1, options.cycles + 1):
            try:
                part = next(parts)
            except StopIteration:
                progress.say("no more ids are typed: the run ends")
                return
            result = cell.run_cycle(number, plan, part)
            if not said and (said := _another_model(options.config, begun)):
                progress.say(said)
            yield result
            if result.outcome is Outcome.FAILED:
                return


def _show(
    results: Sequence[Result], steps: Sequence[str], dry_run: bool, notes: Sequence[str]
) -> None:
    """Print the tables of a run, and where its records are."""
    from rich.console import Console

    from cell.terminal.console import checks_table, results_table, seconds_table
    from cell.terminal.fitting import show

    console = Console()
    if dry_run:
        for result in results:
            show(console, checks_table(result))
    else:
        show(console, results_table(results))
    show(console, seconds_table(results, steps))
    show(console, *notes)
    for result in results:
        what = "dry run" if dry_run else "cable"
        show(console, f"{what} {result.cycle}: {result.folder}")


def _changes(out: Path, results: list[Result], config: Path, settings: Settings) -> list[str]:
    """What has changed in the line's cycles, and what to do; also for a cable that was rejected
    because the model misses it, and for a promoted model that does worse.
    """
    from cell.records.changed_model import worsenings
    from cell.records.chart import signals
    from cell.records.ledger.error import LedgerError
    from cell.records.ledger.ledger import Ledger
    from cell.records.mean_error import mean_error
    from cell.settings.referred import line_of

    if not results or results[-1].model is None or settings.ledger is None:
        return []
    try:
        ledger = Ledger(settings.ledger.url or out)
        history = ledger.results(line_of(settings))
        ledger.close()
    except LedgerError as error:
        return [f"whether anything has changed cannot be said: {error}"]
    of_model = [r for r in history if r.model == results[-1].model]
    found, common = signals(of_model), mean_error(of_model)
    lines = [*map(str, found), *([] if common is None else [str(common)])]
    unforecast = common is not None or any(not s.of_cables for s in found)
    if unforecast or any(r.model_misses for r in results):
        lines.append(f"to learn what the model lacks: cell learn {out} --config {config}")
    elif found:
        lines.append(
            "each cable is identified anew, so forecasts follow; to test whether the model lacks "
            f"anything now: cell learn {out} --config {config}"
        )
    worse = worsenings(history)
    if worse:
        lines += [*map(str, worse), _taken_back(config, settings.promotion.withdraw)]
    return lines


def _another_model(config: Path, settings: Settings) -> str:
    """That the settings' file has another model by now than this run was begun with; or ""."""
    from cell.files.input_error import InputError
    from cell.settings import load_settings
    from cell.settings.translate import model_hash

    try:
        now, begun = model_hash(load_settings(config).model), model_hash(settings.model)
    except InputError:  # it is being edited: whoever reads it next says what is wrong
        return ""
    if now == begun:
        return ""
    return (
        f"{config} has another model by now, {now}: the cycles of this run still use {begun}, with "
        "which it was begun; end it and run again to use the new one"
    )


def _taken_back(config: Path, withdraw: bool) -> str:
    """Take a promoted model back if the settings say so; what was done, or can be."""
    from cell.files.input_error import InputError
    from cell.settings.promotion import undo

    if not withdraw:
        return f"to go back to the model before: cell promote --undo --config {config}"
    try:
        entry = undo(config)
    except InputError as error:
        return f"the model cannot be taken back: {error}"
    return f"withdrawn, as promotion.withdraw says: {config} has again the model of {entry}"


@app.command()
def emulate(
    config: Config,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of hidden cables and noise.")] = 1,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            "--fault",
            help="A fault of a device, NAME@2s = 2 s after the next cable is gripped, NAME = at "
            "once; docs/commissioning.md lists them.  The option may be repeated.",
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
    from cell.build import emulating
    from cell.files.input_error import InputError
    from cell.settings import load_settings
    from cell.simulated.faults import Faults, read_fault

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
            faults = Faults(cell, lambda text: print(text, file=sys.stderr, flush=True))
            for one in given:
                faults.give(one)
            typed = TypedLines()
            while os.getppid() == parent:
                if ended := cell.ended():
                    _say_ended(ended, config)
                    raise typer.Exit(NOT_ALL_DONE)
                for line in typed.within(0.2):
                    _obey(faults, line)
    except InputError as error:
        refuse(error)


def _obey(faults: Faults, line: str) -> None:
    """Do what was typed; what is not understood is said, and changes nothing."""
    from cell.simulated.faults import REPAIR, read_fault

    try:
        if line == REPAIR:
            faults.repair()
        else:
            faults.give(read_fault(line))
    except ValueError as error:
        print(f"{error}; or {REPAIR}", file=sys.stderr)


def _say_ended(ended: Sequence[str], config: Path) -> None:
    """Name the emulators that have ended, and what to do."""
    verb = "have" if len(ended) > 1 else "has"
    print(
        f"{' and '.join(ended)} {verb} ended; so do the others: start them again with "
        f"`cell emulate --config {config}`",
        file=sys.stderr,
    )
