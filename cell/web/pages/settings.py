"""Settings as the file says them, and what `cell check` says of them; nothing is written."""

from __future__ import annotations

from nicegui import ui

from cell.files.input_error import InputError
from cell.settings import load_settings
from cell.settings.calibrated import calibrated
from cell.settings.check import oddities
from cell.web.visit import Visit


def build(visit: Visit) -> None:
    """Fill the page."""
    t, config = visit.t, visit.room.config
    ui.label(t("Settings")).classes("text-2xl").props("role=heading aria-level=1")
    ui.label(str(config.name)).classes("text-lg")
    good, said = checked(visit)
    with ui.card().classes("w-full"):
        ui.label(t("The settings are right.") if good else t("The settings are wrong."))
        for line in said:
            ui.label(line).classes("whitespace-pre-wrap break-words")
    good, said = calibration(visit)
    with ui.card().classes("w-full"):
        ui.label(t("The calibration is valid.") if good else t("There is no valid calibration."))
        for line in said:
            ui.label(line).classes("whitespace-pre-wrap break-words")
    ui.label(t("As in the file; to change it, edit the file and run cell check."))
    ui.code(text_of(visit), language="yaml").classes("w-full")


def checked(visit: Visit) -> tuple[bool, tuple[str, ...]]:
    """Whether the file is right, and what is said of it."""
    try:
        return True, tuple(oddities(load_settings(visit.room.config)))
    except InputError as error:
        return False, tuple(str(error).splitlines())


def calibration(visit: Visit) -> tuple[bool, tuple[str, ...]]:
    """Whether the calibration may be used now, and how old and how good it is."""
    try:
        settings = load_settings(visit.room.config)
        known = calibrated(settings, visit.room.config)
    except InputError as error:
        return False, tuple(str(error).splitlines())
    return settings.calibration is not None, tuple(known.notes)


def text_of(visit: Visit) -> str:
    """The file's text; what cannot be read is said."""
    try:
        return visit.room.config.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        return f"# {error}"
