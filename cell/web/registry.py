"""The pages that there are, in the order of the menu; a further page is one more line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from cell.web.pages import calibration, history, lab, live, settings
from cell.web.theme import N_
from cell.web.users import Role
from cell.web.visit import Visit


@dataclass(frozen=True)
class Page:
    """A page of the menu.

    title  in English, marked for the catalogues
    role   the least that may open it
    build  fills the page
    """

    path: str
    title: str
    icon: str
    role: Role
    build: Callable[[Visit], None]


PAGES: tuple[Page, ...] = (
    Page("/", N_("Live"), "precision_manufacturing", Role.watch, live.build),
    Page("/history", N_("History"), "history", Role.watch, history.build),
    Page("/lab", N_("Lab"), "science", Role.engineer, lab.build),
    Page("/calibration", N_("Calibration"), "straighten", Role.engineer, calibration.build),
    Page("/settings", N_("Settings"), "tune", Role.engineer, settings.build),
)
