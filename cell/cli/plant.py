"""Commands about a cell that runs: status, send; and its unit for systemd: service."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from cell.cli.arguments import Runs, checked_id
from cell.cli.output import print_json
from cell.cli.shared import (
    ALL_DONE,
    NOT_ALL_DONE,
    AsJson,
    Config,
    MaybeConfig,
    group,
    refuse,
    refusing,
    user_name,
)
from cell.cli.streams import emit

if TYPE_CHECKING:
    from cell.plant.messages import Notice, Status
    from cell.run.machine import CellState, MachineEvent

app = group()

#: Exit code: no cell runs there.
NO_CELL = 3
#: Time limit for the answer of a running cell, s: one that compiles on a busy computer is slow.
_ANSWER_S = 30.0


@app.command()
def status(
    *,
    config: MaybeConfig = None,
    runs: Runs = Path("runs"),
    as_json: AsJson = False,
    watch: Annotated[
        bool, typer.Option("--watch", help="Print a line for each event, until Ctrl-C.")
    ] = False,
) -> None:
    """Print the status of a running cell: state, step, cycle, counts, fault with cause and remedy.

    With --config, only the cell of these settings is asked.

    Exit codes: 0 if the cell works or is ready; 1 if it waits for a person, after a fault or a
    stop; 2 if the settings are wrong or those of another cell; 3 if no cell runs there.
    """
    from cell.plant.client import Client
    from cell.plant.messages import Status
    from cell.plant.wire import LinkError

    line = _line_of(config)
    client = Client(runs, timeout_s=_ANSWER_S, on_lost=_lost, on_there=_reconnected)
    try:
        now = client.status()
        _check_line(line, now, runs)
        if watch:
            for message in client.follow():
                if as_json:
                    emit(json.dumps(asdict(message), ensure_ascii=False))
                elif isinstance(message, Status):
                    emit("\n".join(_lines(message)))
                else:
                    emit(_line(message))
    except LinkError as error:
        if as_json:
            emit(json.dumps({"state": None, "cause": str(error)}, ensure_ascii=False))
        _no_cell(error)
    except KeyboardInterrupt:
        raise typer.Exit(ALL_DONE) from None
    if as_json:
        print_json(asdict(now))
    else:
        emit("\n".join(_lines(now)))
    needs_person = now.fault is not None or now.state.value in ("stopped", "aborted")
    raise typer.Exit(NOT_ALL_DONE if needs_person else ALL_DONE)


@app.command()
def send(
    command: Annotated[
        str,
        typer.Argument(
            help="start, hold, unhold, suspend, unsuspend, stop, abort, clear, reset, acknowledge "
            "or product."
        ),
    ],
    *,
    config: MaybeConfig = None,
    runs: Runs = Path("runs"),
    by: Annotated[str | None, typer.Option(help="Your name; default: the logged-in user.")] = None,
    note: Annotated[str, typer.Option(help="The cause that was found, and what was done.")] = "",
    part: Annotated[str | None, typer.Option(help="With start: id of the cable.")] = None,
    product: Annotated[str | None, typer.Option(help="Product of the next cycles.")] = None,
    as_json: AsJson = False,
) -> None:
    """Send a command to a running cell, and print its answer.

    After a fault or a stop, `clear` (in state Aborted) and `reset` confirm that you have looked at
    the cause; the ledger records this. `reset` opens the jaws and moves the gripper home.
    `acknowledge` only confirms, and nothing moves. `product` sets the product of the next cycles.
    With --config, only the cell of these settings gets the command.

    Exit codes: 0 if the cell accepts the command; 1 if it refuses; 2 if there is no such command,
    or the settings are wrong or those of another cell; 3 if no cell runs there.
    """
    from cell.plant.client import Client
    from cell.plant.messages import COMMANDS, Request
    from cell.plant.wire import LinkError
    from cell.run.machine import MachineEvent

    others = ("acknowledge", "product")
    if command not in others and command not in COMMANDS:
        known = ", ".join([*sorted(COMMANDS), *others])
        refuse(ValueError(f"{command!r} is no command; those are {known}"))
    if command == "product" and product is None:
        refuse(ValueError("product: --product is missing, what the next cycles make"))
    try:
        part = None if part is None else checked_id(part)
    except ValueError as error:
        refuse(ValueError(f"--part {error}"))
    if command == "acknowledge" and product is not None:
        refuse(ValueError("acknowledge: --product is not for it; leave it out"))
    event = None if command in others else MachineEvent(command)
    line, client = _line_of(config), Client(runs, timeout_s=_ANSWER_S)
    try:
        if line is not None:
            _check_line(line, client.status(), runs)
        answer = client.send(Request(event, by or user_name(), note, part, product))
    except LinkError as error:
        _no_cell(error)
    if as_json:
        emit(json.dumps(asdict(answer), ensure_ascii=False))
    elif answer.accepted:
        emit(f"{command}: accepted; {_what_follows(answer.state, event)}")
    else:
        print(answer.reason, file=sys.stderr)
    raise typer.Exit(ALL_DONE if answer.accepted else NOT_ALL_DONE)


@app.command()
def service(
    config: Config,
    out: Runs = Path("runs"),
    user: Annotated[
        str | None, typer.Option(help="User of the service; default: the logged-in user.")
    ] = None,
) -> None:
    """Print a unit for systemd, which runs the cell as a service (cell help service).

    Exit codes: 0; 2 if the settings are wrong.
    """
    from cell.plant.systemd import unit_of
    from cell.settings import load_settings

    with refusing():
        load_settings(config)
        emit(unit_of(config.resolve(), out.resolve(), Path.cwd(), user or user_name()))


def _line_of(config: Path | None) -> str | None:
    """Line of the settings, if any."""
    if config is None:
        return None
    from cell.settings import load_settings
    from cell.settings.provenance import line_name

    with refusing():
        return line_name(load_settings(config))


def _check_line(line: str | None, now: Status, runs: Path) -> None:
    """Refuse the cell that runs there if it is not of the line that is meant."""
    if line not in (None, now.line):
        refuse(
            ValueError(
                f"--config is of line {line!r}, the cell of {runs} of {now.line!r}; give --runs of "
                "the cell that you mean, or its settings"
            )
        )


def _what_follows(state: CellState, event: MachineEvent | None) -> str:
    """State that an accepted command leads to, at once or later in the cycle."""
    from cell.run.machine import target_of

    to = None if event is None else target_of(state, event)
    if to is None:
        return f"the cell is {state.value}"
    return f"the cell goes from {state.value} to {to.value}"


def _lost() -> None:
    print("the cell has ended, or says nothing any more; it is waited for", file=sys.stderr)


def _reconnected() -> None:
    print("the cell is there again", file=sys.stderr)


def _no_cell(error: Exception) -> NoReturn:
    print(error, file=sys.stderr)
    raise typer.Exit(NO_CELL) from error


def _lines(status: Status) -> list[str]:
    """A status as a person reads it."""
    step = f", step {status.step.replace('_', ' ')}" if status.step else ""
    part = f", part {status.part}" if status.part else ""
    product = f", product {status.product}" if status.product else ""
    counts = ", ".join(f"{number} {outcome}" for outcome, number in status.counts.items())
    lines = [
        f"{status.line}: {status.state.value}{step}",
        f"cycle {status.cycle}{part}{product}; in this run: {counts or 'no cable yet'}",
    ]
    if status.waiting_for:
        lines.append(f"waits for {', '.join(status.waiting_for)}")
    lines += [f"adapter {name} {trouble}" for name, trouble in status.adapters.items()]
    if status.fault is not None:
        fault = status.fault
        device = f"{fault.device}: " if fault.device else ""
        lines.append(f"fault in cycle {fault.cycle}, step {fault.step}: {device}{fault.cause}")
        lines += [line for line in (fault.remedy, fault.cable) if line]
    return lines


def _line(notice: Notice) -> str:
    """A notice as a person reads it."""
    if notice.kind.value == "result":
        return f"result: cycle {notice.data['cycle']} {notice.data['outcome']}"
    values = ", ".join(
        f"{key} {value}"
        for key, value in notice.data.items()
        if value not in (None, "", []) and key not in ("since", "time_s")
    )
    return f"{notice.kind.value}: {values or 'nothing'}"
