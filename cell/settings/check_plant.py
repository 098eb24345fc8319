"""What the settings say of the plant, checked against the rest of the cell."""

from __future__ import annotations

from cell.files.input_error import Problem
from cell.files.yaml_document import Document
from cell.settings.devices import UrArmSettings
from cell.settings.model import Settings
from cell.settings.plant import Handshake


def plant_problems(document: Document, settings: Settings) -> list[Problem]:
    """Entries of the section `plant` that contradict others."""
    handshake = _handshake(settings)
    if handshake is None or handshake.carrier != "controller" or controller_of(settings):
        return []
    message = (
        f"is missing: arm.kind is {settings.arm.kind!r}, so say which UR controller has the inputs "
        "and outputs"
    )
    return [document.problem(("plant", "handshake", "host"), message)]


def controller_of(settings: Settings) -> str | None:
    """Address of the controller with the signals of the handshake; None = there is none."""
    handshake = _handshake(settings)
    if handshake is not None and handshake.host is not None:
        return handshake.host
    return settings.arm.host if isinstance(settings.arm, UrArmSettings) else None


def _handshake(settings: Settings) -> Handshake | None:
    return None if settings.plant is None else settings.plant.handshake
