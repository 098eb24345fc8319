"""Commands of processes that run next to a cell: emulate replaces its devices; opcua, mqtt and
handshake connect it with its plant.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cell.cli.arguments import Runs
from cell.cli.output import print_json
from cell.cli.serve import FILE, UsersFile, users_app
from cell.cli.shared import (
    NOT_ALL_DONE,
    Config,
    MaybeConfig,
    group,
    interrupted_once,
    needing,
    refuse,
    refusing,
)
from cell.cli.streams import is_in_foreground

if TYPE_CHECKING:
    from cell.plant.handshake.carrier import Carrier
    from cell.plant.mqtt.adapter import MqttAdapter
    from cell.plant.mqtt.form import PayloadForm
    from cell.plant.mqtt.outbox import MqttOutbox
    from cell.settings import Settings
    from cell.settings.plant import Handshake, Mqtt
    from cell.wiring.faults import DeviceFaults

app = group()
opcua_app = group("opcua")
opcua_app.add_typer(users_app, name="user")


def _settings(config: Path | None) -> Settings:
    """Settings that a command needs.  Raises ValueError: they are not named; InputError."""
    from cell.settings import load_settings

    if config is None:
        raise ValueError("--config is missing: name the settings of the cell")
    return load_settings(config)


def _section(config: Path | None, name: str, remedy: str) -> tuple[Settings, Any]:
    """Settings, and their section `plant.NAME`, which must be there."""
    from cell.files.input_error import InputError

    settings = _settings(config)
    section = getattr(settings.plant, name, None)
    if section is None:
        assert config is not None, "it was read"
        raise InputError.at(config, f"is missing; {remedy}", key=f"plant.{name}")
    return settings, section


@app.command()
def handshake(*, config: MaybeConfig = None, runs: Runs = Path("runs")) -> None:
    """Let a PLC start a running cell with digital signals (plant.handshake).

    The signals come over Modbus/TCP, or are wired to the inputs and outputs of the arm's
    controller.

    It is a process of its own: it may begin and end before or after the cell, and be killed.  A
    `start` that is on when the command begins does nothing until it falls. When the command ends,
    the PLC reads a fault.

    Exit codes: 0 if it was ended by Ctrl-C or SIGTERM; 2 if the settings are wrong, the port cannot
    be listened at, or another program sets the controller's outputs.  A controller that does not
    answer is waited for.
    """
    from cell.cli.logs import warnings_to_terminal
    from cell.plant.handshake.adapter import HandshakeAdapter
    from cell.plant.handshake.carrier import CarrierError
    from cell.plant.wire import LinkError

    warnings_to_terminal()
    with refusing():
        settings, section = _section(config, "handshake", "say where the signals are")
        assert config is not None, "its section was read"
        try:
            with _carrier(settings, section, config) as carrier:
                adapter = HandshakeAdapter(carrier, runs, section.by)
                for number in (signal.SIGINT, signal.SIGTERM):
                    signal.signal(number, lambda *_: adapter.end())
                adapter.run()
        except (CarrierError, LinkError) as error:
            refuse(error)


@contextmanager
def _carrier(settings: Settings, section: Handshake, config: Path) -> Iterator[Carrier]:
    from cell.plant.handshake.carrier import ControllerCarrier
    from cell.plant.handshake.modbus import ModbusCarrier
    from cell.settings.check import controller_of
    from cell.wiring.ownership import owned_outputs

    if section.carrier == "controller":
        host = controller_of(settings)
        assert host is not None, "checked when the settings were loaded"
        with owned_outputs(host, config), ControllerCarrier(section, host) as controller:
            yield controller
        return
    with ModbusCarrier(section) as modbus:
        yield modbus


@app.command()
def mqtt(
    *,
    config: MaybeConfig = None,
    runs: Runs = Path("runs"),
    schema: Annotated[
        bool, typer.Option("--schema", help="Print the JSON schema of the messages, and end.")
    ] = False,
) -> None:
    """Report states, results and faults of a running cell to an MQTT broker (plant.mqtt).

    It is a process of its own: it may begin and end before or after the cell, and be killed.  What
    the broker has not acknowledged waits in a file beside the records, `runs.mqtt.sqlite`.  No
    command is taken from the broker.

    Exit codes: 0 if it was ended by Ctrl-C or SIGTERM; 2 if the settings are wrong.
    """
    from cell.cli.logs import warnings_to_terminal
    from cell.plant.mqtt.outbox import MqttOutbox, OutboxError, outbox_of
    from cell.plant.wire import LinkError

    if schema:
        from cell.plant.mqtt.plain_json import schema as message_schema

        print_json(message_schema())
        return
    warnings_to_terminal()
    with refusing():
        settings, section = _section(config, "mqtt", "name a broker")
        with needing("mqtt", "MQTT needs", "aiomqtt"):
            import aiomqtt  # noqa: F401
        try:
            outbox = MqttOutbox(outbox_of(runs), section.most_waiting)
            asyncio.run(_run(_mqtt_adapter(settings, section, runs, outbox)))
        except (OutboxError, LinkError) as error:
            refuse(error)
        except ExceptionGroup as errors:  # of tasks that ran at the same time
            known = errors.subgroup((OutboxError, LinkError))
            if known is None:
                raise
            refuse(known.exceptions[0])


async def _run(adapter: MqttAdapter) -> None:
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, adapter.end)
    await adapter.run()


def _mqtt_adapter(settings: Settings, section: Mqtt, runs: Path, outbox: MqttOutbox) -> MqttAdapter:
    from cell.plant.mqtt.adapter import MqttAdapter
    from cell.plant.mqtt.plain_json import PlainJson
    from cell.plant.mqtt.sparkplug import EdgeNode
    from cell.settings.provenance import line_name

    line = section.line or line_name(settings)
    if set(line) & set("/+#"):
        raise ValueError(f"{line!r} cannot be a part of a topic (/+#); give plant.mqtt.line")

    def new_form() -> PayloadForm:
        if section.format == "json":
            return PlainJson(f"{section.prefix}/{line}")
        return EdgeNode(section.group, line, outbox.count_up("births") - 1, section.primary_host)

    return MqttAdapter(section, section.client_id or f"cell-{line}", runs, outbox, new_form)


@opcua_app.callback()
def opcua(
    context: typer.Context,
    config: MaybeConfig = None,
    runs: Runs = Path("runs"),
    users: UsersFile = FILE,
) -> None:
    """Show a running cell to a plant by OPC UA, after PackML, until Ctrl-C.

    It is a process of its own beside `cell run`: whatever happens to it, the cell goes on.  It may
    begin before the cell, and stays when the cell ends.

    Exit codes: 0; 2 if the settings are wrong or its address is taken.
    """
    if context.invoked_subcommand is not None:
        return
    from cell.cli.logs import to_file, warnings_to_terminal

    with refusing():
        settings = _settings(config)
        with needing("opcua", "OPC UA needs", "asyncua", "argon2", "cryptography"):
            from cell.plant.opcua.server import serve

            warnings_to_terminal()
            if settings.plant is not None and settings.plant.opcua is not None:
                to_file(settings.plant.opcua.folder / "opcua.log")
            serve(settings, runs, lambda address: print(f"listens at {address}", flush=True), users)


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
        """Lines that arrive within a time, stripped; empty lines are omitted.

        It returns with the first line.
        """
        is_ours = not os.isatty(self._descriptor) or is_in_foreground(self._descriptor)
        if self._descriptor < 0 or not is_ours:
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
        device_faults = [read_fault(f) for f in fault or []]
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
            for device_fault in device_faults:
                faults.give(device_fault)
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
    """Apply a typed fault; a line that cannot be parsed is reported and changes nothing."""
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
