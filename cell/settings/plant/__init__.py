"""What the settings say of the plant that a cell stands in."""

from __future__ import annotations

from typing import Literal

from pydantic import model_validator

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
    start: tuple[Literal["opcua", "mqtt", "handshake"], ...] = ()
    """Programs that `cell run --cycles forever` starts beside itself, and starts again."""

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
