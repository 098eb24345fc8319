"""What the settings say of the plant that a cell stands in."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from cell.settings.section import Host, Positive, Section, is_loopback


class HandshakeSignal(Section):
    """Address and polarity of one signal."""

    number: Annotated[int, Field(ge=0, le=1023)]
    """Address of the coil or discrete input, or number at the controller; from 0."""
    inverted: bool = False
    """Whether the signal is on when the bit is 0."""


class InputSignals(Section):
    """Bits from the PLC. Null = not wired: a condition counts as met, a command is never given."""

    start: HandshakeSignal | None = HandshakeSignal(number=0)
    """Its rising edge starts a cycle while `ready` is on."""
    part_present: HandshakeSignal | None = HandshakeSignal(number=1)
    """A cable is at the gripping position; without this bit no cycle begins."""
    upstream_ready: HandshakeSignal | None = HandshakeSignal(number=2)
    """The machine before the cell allows the cell to work; while this bit is off, a cycle is
    suspended."""
    downstream_ready: HandshakeSignal | None = HandshakeSignal(number=3)
    """The machine after the cell allows the cell to work; while this bit is off, a cycle is
    suspended."""
    acknowledge: HandshakeSignal | None = HandshakeSignal(number=4)
    """Its rising edge clears Aborted and resets Stopped, after a person has looked."""
    stop: HandshakeSignal | None = HandshakeSignal(number=5)
    """Its rising edge stops the cycle.  It is not safety-rated."""
    product_0: HandshakeSignal | None = None
    """Lowest bit of the product's number. Products count from 1 in the order of `products`; 0 = no
    product is named."""
    product_1: HandshakeSignal | None = None
    """Next bit of the product's number."""
    product_2: HandshakeSignal | None = None
    """Next bit of the product's number."""
    product_3: HandshakeSignal | None = None
    """Highest bit of the product's number."""


class OutputSignals(Section):
    """Bits to the PLC. Null = not wired."""

    ready: HandshakeSignal | None = HandshakeSignal(number=0)
    """The cell accepts a rising edge of `start`."""
    busy: HandshakeSignal | None = HandshakeSignal(number=1)
    """A cycle is running."""
    done: HandshakeSignal | None = HandshakeSignal(number=2)
    """The last cycle ended successfully; on until `start` changes."""
    rejected: HandshakeSignal | None = HandshakeSignal(number=3)
    """The last cycle ended without an insertion; on until `start` changes."""
    fault: HandshakeSignal | None = HandshakeSignal(number=4)
    """The cell waits for a person, or cannot be reached."""


#: Entries that one carrier alone has.
_OWN = {"modbus": ("listen", "port"), "controller": ("host",)}
#: Highest number of a controller's inputs and outputs.
_LAST = 17


class Handshake(Section):
    """Digital handshake (`cell handshake`): a PLC starts the cell with bits.

    Modbus knows neither users nor encryption: whoever reaches the port can start the cell.
    """

    carrier: Literal["modbus", "controller"] = "modbus"
    """What carries the bits: a Modbus/TCP server, or digital inputs and outputs of a UR controller:
    0 to 7 standard, 8 to 15 configurable, 16 and 17 at the tool."""
    listen: Host = "127.0.0.1"
    """Address at which the Modbus server listens; 0.0.0.0 = all addresses of this computer."""
    port: Annotated[int, Field(ge=1, le=65535)] = 502
    """TCP port.  502 is that of Modbus; below 1024 a program needs CAP_NET_BIND_SERVICE."""
    host: Host | None = None
    """Address of the controller that has the inputs and outputs.  Null = that of the arm."""
    silence_s: Annotated[float, Field(ge=0.1, le=60.0)] = 1.0
    """Longest allowed time between two writes of the PLC, or two reports of the controller. After
    it the PLC counts as lost and can start nothing."""
    by: Annotated[str, Field(min_length=1, max_length=100)] = "plc"
    """Name of the PLC in the ledger, for starts and acknowledgements."""
    inputs: InputSignals = InputSignals()
    """What the PLC says."""
    outputs: OutputSignals = OutputSignals()
    """What the cell says."""

    @model_validator(mode="after")
    def _each_bit_once(self) -> Handshake:
        for group in (self.inputs, self.outputs):
            named: dict[int, str] = {}
            for name, signal in signals_of(group):
                if signal.number in named:
                    raise ValueError(
                        f"has {name} and {named[signal.number]} at number {signal.number}; "
                        "give each a number of its own"
                    )
                named[signal.number] = name
        return self

    @model_validator(mode="after")
    def _fits_carrier(self) -> Handshake:
        for carrier, names in _OWN.items():
            for name in names:
                default = type(self).model_fields[name].default
                if carrier != self.carrier and getattr(self, name) != default:
                    raise ValueError(
                        f"has {name}, which only the carrier {carrier} has; remove it, or set "
                        f"carrier: {carrier}"
                    )
        if self.carrier == "controller":
            for group in (self.inputs, self.outputs):
                for name, signal in signals_of(group):
                    if signal.number > _LAST:
                        raise ValueError(
                            f"has {name} at number {signal.number}; a controller has 0 to 7 "
                            "standard, 8 to 15 configurable, 16 and 17 at the tool"
                        )
        return self


def signals_of(group: InputSignals | OutputSignals) -> Iterator[tuple[str, HandshakeSignal]]:
    """Name and place of every signal that is wired."""
    for name, signal in group:
        if signal is not None:
            yield name, signal


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
    """File of the cell's own certificate, PEM.  Null = the broker requires no certificate."""
    key: Path | None = None
    """File of the key of the cell's certificate, PEM.  Null = it is in the certificate's file."""

    @model_validator(mode="after")
    def _key_of_something(self) -> MqttTls:
        if self.key is not None and self.certificate is None:
            raise ValueError("has a key and no certificate; give both or neither")
        return self


class Mqtt(Section):
    """MQTT broker to which `cell mqtt` reports states, results and faults. `cell mqtt` takes no
    commands.

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
    """Client id of the connection, unique at the broker. Null = made from the line's name."""
    keep_alive_s: Annotated[int, Field(ge=1, le=3600)] = 15
    """Keep-alive interval. After 1.5 intervals without a message the broker reports the cell as
    lost."""
    format: Literal["json", "sparkplug"] = "json"
    """`json`: topics of plain JSON.  `sparkplug`: Sparkplug B 3.0, the cell as an edge node."""
    prefix: Levels = "cable-cell"
    """For `json`: first levels of all topics, before the line."""
    group: Level = "cable-cell"
    """For `sparkplug`: group id."""
    primary_host: Level | None = None
    """For `sparkplug`: id of the primary host application; messages wait while it is offline.
    Null = messages are sent whenever the broker is connected."""
    line: Level | None = None
    """Name of the line in topics, and id of the edge node. Null = `ledger.line`, or the computer's
    name."""
    most_waiting: Annotated[int, Field(ge=1000, le=10_000_000)] = 100_000
    """Number of messages kept on disk while the broker is unreachable. Beyond it the oldest are
    dropped and counted, except results, which are never dropped."""
    retry_s: Positive = 5.0
    """Longest pause between attempts to connect."""

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


class OpcUa(Section):
    """OPC UA server (`cell opcua`): the cell's states, counters and commands after PackML.

    Beyond this computer it demands encryption and a user's name; `cell user add` adds users.
    """

    listen: Host = "127.0.0.1"
    """Address at which the server listens; 0.0.0.0 = all addresses of this computer. At a loopback
    address clients may also connect without encryption and without a name."""
    port: Annotated[int, Field(ge=1, le=65535)] = 4840
    """TCP port; 4840 is that of OPC UA."""
    folder: Path = Path("opcua")
    """Folder of the server's key and certificate, and of the clients' certificates that it
    trusts."""
    name: Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[^/:]+$")] = "CableCell"
    """Name of the server's object for this cell."""

    @property
    def is_loopback(self) -> bool:
        """Whether nobody beyond this computer can reach it."""
        return is_loopback(self.listen)


class Plant(Section):
    """Programs by which other machines and a plant's systems communicate with the cell."""

    opcua: OpcUa | None = None
    """Null = no OPC UA server."""
    mqtt: Mqtt | None = None
    """Null = nothing is reported to an MQTT broker."""
    handshake: Handshake | None = None
    """Null = no PLC starts the cell with digital signals."""
    start: tuple[Literal["opcua", "mqtt", "handshake"], ...] = ()
    """Programs that `cell run --cycles forever` starts, and restarts if they end."""

    @model_validator(mode="after")
    def _each_once_with_its_section(self) -> Plant:
        for name in self.start:
            if self.start.count(name) > 1:
                raise ValueError(f"start names {name} twice; once is enough")
            if getattr(self, name) is None:
                raise ValueError(
                    f"start names {name}, which has no section; add {name}: to plant, or take it "
                    "out of start"
                )
        return self
