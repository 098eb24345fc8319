"""Commands of the processes between a cell and its plant: opcua, mqtt, handshake."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cell.cli.arguments import Runs
from cell.cli.output import print_json
from cell.cli.shared import Config, MaybeConfig, group, needing, refuse, refusing
from cell.cli.users import FILE, Name, RoleName, UsersFile, add_user, opcua_folder, remove_user

if TYPE_CHECKING:
    from cell.plant.handshake.carrier import Carrier
    from cell.plant.mqtt.adapter import MqttAdapter
    from cell.plant.mqtt.form import PayloadForm
    from cell.plant.mqtt.outbox import MqttOutbox
    from cell.settings import Settings
    from cell.settings.plant import Handshake, Mqtt

app = group()
opcua_app = typer.Typer(
    name="opcua",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
opcua_user = group()
opcua_app.add_typer(opcua_user, name="user", help="Users of the OPC UA server.")


def _section(config: Path | None, name: str, remedy: str) -> tuple[Settings, Any]:
    """Settings, and their section `plant.NAME`, which must be there."""
    from cell.files.input_error import InputError
    from cell.settings import load_settings

    if config is None:
        raise ValueError("--config is missing: name the settings of the cell")
    settings = load_settings(config)
    section = getattr(settings.plant, name, None)
    if section is None:
        raise InputError.at(config, f"is missing; {remedy}", key=f"plant.{name}")
    return settings, section


@app.command()
def handshake(*, config: MaybeConfig = None, runs: Runs = Path("runs")) -> None:
    """Let a PLC start a running cell with digital signals (plant.handshake).

    They come over Modbus/TCP, or are wired to the inputs and outputs of the arm's controller.

    It is a process of its own: it may begin and end before or after the cell, and be killed.  A
    start that is held at its beginning does nothing until it falls.  At its end the PLC reads a
    fault.

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
    from cell.plant.handshake.controller import ControllerCarrier
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
            asyncio.run(_run(lambda: _mqtt_adapter(settings, section, runs, outbox)))
        except (OutboxError, LinkError) as error:
            refuse(error)
        except ExceptionGroup as errors:  # of tasks that ran at the same time
            known = errors.subgroup((OutboxError, LinkError))
            if known is None:
                raise
            refuse(known.exceptions[0])


async def _run(make: Callable[[], MqttAdapter]) -> None:
    adapter = make()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, adapter.end)
    await adapter.run()


def _mqtt_adapter(settings: Settings, section: Mqtt, runs: Path, outbox: MqttOutbox) -> MqttAdapter:
    from cell.plant.mqtt.adapter import Access, MqttAdapter, password_of, tls_of
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

    access = Access(section.client_id or f"cell-{line}", password_of(section), tls_of(section.tls))
    return MqttAdapter(section, access, runs, outbox, new_form)


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
    from cell.settings import load_settings

    try:
        if config is None:
            raise ValueError("--config is missing: name the settings of the cell")
        settings = load_settings(config)
        with needing("opcua", "OPC UA needs", "asyncua", "argon2", "cryptography"):
            from cell.plant.opcua.server import serve

            warnings_to_terminal()
            if settings.plant is not None and settings.plant.opcua is not None:
                to_file(settings.plant.opcua.folder / "opcua.log")
            serve(settings, runs, lambda address: print(f"listens at {address}", flush=True), users)
    except ValueError as error:
        refuse(error)


@opcua_user.command()
def add(name: Name, *, config: Config, role: RoleName = "watch", users: UsersFile = FILE) -> None:
    """Add a user: the same as `cell user add`."""
    add_user(users, name, role, _opcua_folder(config))


@opcua_user.command()
def remove(name: Name, *, config: Config, users: UsersFile = FILE) -> None:
    """Remove a user: the same as `cell user remove`.  Sessions that are open stay."""
    remove_user(users, name, _opcua_folder(config))


def _opcua_folder(config: Path) -> Path:
    """Folder of the server; settings without one are refused."""
    folder = opcua_folder(config)
    if folder is None:
        message = f"{config}: has no section plant.opcua; add one, it may be empty: {{}}"
        refuse(ValueError(message))
    return folder
