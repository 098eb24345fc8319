"""What the settings say of the plant that a cell stands in."""

from __future__ import annotations

from cell.settings.plant.handshake import Handshake
from cell.settings.plant.mqtt import Mqtt
from cell.settings.plant.opcua import OpcUa
from cell.settings.section import Section

__all__ = ["Handshake", "Mqtt", "OpcUa", "Plant"]


class Plant(Section):
    """Programs beside the cell by which other machines and a plant's systems talk to it."""

    opcua: OpcUa | None = None
    """Null = no OPC UA server."""
    mqtt: Mqtt | None = None
    """Null = nothing is reported to an MQTT broker."""
    handshake: Handshake | None = None
    """Null = no PLC starts the cell with digital signals."""
