"""What the settings say of the MQTT broker that a cell reports to."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from cell.settings.section import Host, Positive, Section, is_loopback

#: TCP ports registered for MQTT, without and with TLS.
_PLAIN, _ENCRYPTED = 1883, 8883

#: Part of a topic: neither its separator nor its wildcards, and no `$` at the beginning.
Level = Annotated[
    str, Field(min_length=1, max_length=100, pattern=r"^[^/+#$\x00-\x1f][^/+#\x00]*$")
]
Levels = Annotated[str, Field(max_length=200, pattern=r"^[^/+#$\x00-\x1f][^+#\x00]*[^/+#\x00]$")]


class MqttTls(Section):
    """Encrypted connection to the broker; its certificate and its name are always verified."""

    ca: Path | None = None
    """File of the certificates that are trusted, PEM.  Null = those of the system."""
    certificate: Path | None = None
    """File of the cell's own certificate, PEM.  Null = the broker asks for none."""
    key: Path | None = None
    """File of the key of the cell's certificate, PEM.  Null = it is in the certificate's file."""

    @model_validator(mode="after")
    def _key_of_something(self) -> MqttTls:
        if self.key is not None and self.certificate is None:
            raise ValueError("has a key and no certificate; give both or neither")
        return self


class Mqtt(Section):
    """MQTT broker that `cell mqtt` reports states, results and faults to.  It takes no commands.

    The password is in the environment variable CELL_MQTT_PASSWORD or in a file, never here.
    """

    broker: Host
    """Name or address of the broker."""
    port: Annotated[int, Field(ge=1, le=65535)] | None = None
    """TCP port.  Null = 8883 with TLS, 1883 without."""
    tls: MqttTls | None = None
    """Null = not encrypted; a password is then sent only within this computer."""
    user: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    """Name by which the broker knows the cell.  Null = no name and no password."""
    password_file: Path | None = None
    """File whose first line is the password; others must not be able to read it.  Null = the
    password is in CELL_MQTT_PASSWORD."""
    client_id: Annotated[str, Field(min_length=1, max_length=100)] | None = None
    """Of the connection; no other client of the broker may have it.  Null = made of the line's
    name."""
    keep_alive_s: Annotated[int, Field(ge=1, le=3600)] = 15
    """After one and a half times as long without a word the broker takes the cell for lost."""
    format: Literal["json", "sparkplug"] = "json"
    """`json`: topics of plain JSON.  `sparkplug`: Sparkplug B 3.0, the cell as an edge node."""
    prefix: Levels = "cable-cell"
    """Of `json`: first levels of all topics, which go on with the line."""
    group: Level = "cable-cell"
    """Of `sparkplug`: the group's id."""
    primary_host: Level | None = None
    """Of `sparkplug`: id of the host application without which nothing is sent, because it would
    be lost.  Null = the broker is enough."""
    line: Level | None = None
    """The line in topics, and the edge node's id.  Null = `ledger.line`, or the computer's name."""
    most_waiting: Annotated[int, Field(ge=1000, le=10_000_000)] = 100_000
    """Messages that wait on the disk for a broker that is away.  Beyond it the oldest that are not
    results are dropped, which is said; results are never dropped."""
    retry_s: Positive = 5.0
    """Longest pause before the broker is tried again."""

    @model_validator(mode="after")
    def _password_is_safe(self) -> Mqtt:
        if self.password_file is not None and self.user is None:
            raise ValueError("has a password_file and no user; give both or neither")
        if self.user is not None and self.tls is None and not is_loopback(self.broker):
            raise ValueError(
                f"would send a password to {self.broker} unencrypted; add `tls: {{}}`, or remove "
                "user"
            )
        return self

    @property
    def broker_port(self) -> int:
        """TCP port of the broker."""
        if self.port is not None:
            return self.port
        return _PLAIN if self.tls is None else _ENCRYPTED
