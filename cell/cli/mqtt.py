"""The command that reports a cell to an MQTT broker: mqtt."""

from __future__ import annotations

import asyncio
import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.arguments import records_folder
from cell.cli.shared import MaybeConfig, group, refuse, refusing
from cell.cli.streams import emit
from drivers.installing import install_extra

if TYPE_CHECKING:
    from cell.plant.mqtt.adapter import MqttAdapter
    from cell.plant.mqtt.form import PayloadForm
    from cell.plant.mqtt.outbox import MqttOutbox
    from cell.settings.model import Settings
    from cell.settings.plant import Mqtt

app = group()


@app.command()
def mqtt(
    *,
    config: MaybeConfig = None,
    runs: Annotated[
        Path, typer.Option(help="Folder of the cell's records.", callback=records_folder)
    ] = Path("runs"),
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
        from cell.plant.mqtt.plain_json import schema as of_messages

        emit(json.dumps(of_messages(), ensure_ascii=False, indent=2))
        return
    warnings_to_terminal()
    with refusing():
        settings, said = _settings(config)
        try:
            outbox = MqttOutbox(outbox_of(runs), said.most_waiting)
            asyncio.run(_run(lambda: _adapter(settings, said, runs, outbox)))
        except (OutboxError, LinkError) as error:
            refuse(error)
        except ExceptionGroup as errors:  # of what ran at the same time
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


def _settings(config: Path | None) -> tuple[Settings, Mqtt]:
    from cell.files.input_error import InputError
    from cell.settings import load_settings

    if config is None:
        raise ValueError("--config is missing: name the settings of the cell")
    settings = load_settings(config)
    if settings.plant is None or settings.plant.mqtt is None:
        raise InputError.at(config, "is missing; name a broker", key="plant.mqtt")
    try:
        import aiomqtt  # noqa: F401
    except ImportError as error:
        raise ValueError(f"MQTT needs aiomqtt: {install_extra('mqtt')}") from error
    return settings, settings.plant.mqtt


def _adapter(settings: Settings, said: Mqtt, runs: Path, outbox: MqttOutbox) -> MqttAdapter:
    from cell.plant.mqtt.adapter import Access, MqttAdapter, password_of, tls_of
    from cell.plant.mqtt.plain_json import PlainJson
    from cell.plant.mqtt.sparkplug import EdgeNode
    from cell.settings.provenance import line_name

    line = said.line or line_name(settings)
    if set(line) & set("/+#"):
        raise ValueError(f"{line!r} cannot be a part of a topic (/+#); give plant.mqtt.line")

    def form_anew() -> PayloadForm:
        if said.format == "json":
            return PlainJson(f"{said.prefix}/{line}")
        return EdgeNode(said.group, line, outbox.count_up("births") - 1, said.primary_host)

    access = Access(said.client_id or f"cell-{line}", password_of(said), tls_of(said.tls))
    return MqttAdapter(said, access, runs, outbox, form_anew)
