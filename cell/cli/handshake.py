"""The command by which a PLC starts a cell with digital signals: handshake."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.arguments import records_folder
from cell.cli.shared import MaybeConfig, group, refuse, refusing

if TYPE_CHECKING:
    from cell.plant.handshake.carrier import Carrier
    from cell.settings import Settings
    from cell.settings.plant import Handshake

app = group()


@app.command()
def handshake(
    *,
    config: MaybeConfig = None,
    runs: Annotated[
        Path, typer.Option(help="Folder of the cell's records.", callback=records_folder)
    ] = Path("runs"),
) -> None:
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
        settings, said, path = _settings(config)
        try:
            with _carrier(settings, said, path) as carrier:
                adapter = HandshakeAdapter(carrier, runs, said.by)
                for number in (signal.SIGINT, signal.SIGTERM):
                    signal.signal(number, lambda *_: adapter.end())
                adapter.run()
        except (CarrierError, LinkError) as error:
            refuse(error)


def _settings(config: Path | None) -> tuple[Settings, Handshake, Path]:
    from cell.files.input_error import InputError
    from cell.settings import load_settings

    if config is None:
        raise ValueError("--config is missing: name the settings of the cell")
    settings = load_settings(config)
    if settings.plant is None or settings.plant.handshake is None:
        raise InputError.at(config, "is missing; say where the signals are", key="plant.handshake")
    return settings, settings.plant.handshake, config


@contextmanager
def _carrier(settings: Settings, said: Handshake, config: Path) -> Iterator[Carrier]:
    from cell.plant.handshake.controller import ControllerCarrier
    from cell.plant.handshake.modbus import ModbusCarrier
    from cell.settings.check import controller_of
    from cell.wiring.ownership import owned_outputs

    if said.carrier == "controller":
        host = controller_of(settings)
        assert host is not None, "checked when the settings were loaded"
        with owned_outputs(host, config), ControllerCarrier(said, host) as controller:
            yield controller
        return
    with ModbusCarrier(said) as modbus:
        yield modbus
