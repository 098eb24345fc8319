"""Colours and words of the PackML states; readable on light and dark, at arm's length."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from nicegui import ui

from cell.run.machine import CellState

#: Background of a state with white or black letters on it: contrast ≥ 4.5 with either.
GREEN, BLUE, AMBER, RED, _GREY = "#146c2e", "#0b57a4", "#f5b301", "#b3261e", "#4a5563"


@dataclass(frozen=True)
class StateStyle:
    """How a state is shown: its word in English, colours of ground and letters."""

    word: str
    ground: str
    letters: str


def N_(message: str) -> str:  # noqa: N802 - the name that gettext's tools look for
    """Marks a message for the catalogues; it is translated where it is shown."""
    return message


_S = CellState
LOOKS: dict[CellState, StateStyle] = {
    _S.IDLE: StateStyle(N_("Idle"), BLUE, "#ffffff"),
    _S.STARTING: StateStyle(N_("Starting"), GREEN, "#ffffff"),
    _S.EXECUTE: StateStyle(N_("Execute"), GREEN, "#ffffff"),
    _S.COMPLETING: StateStyle(N_("Completing"), GREEN, "#ffffff"),
    _S.COMPLETE: StateStyle(N_("Complete"), GREEN, "#ffffff"),
    _S.RESETTING: StateStyle(N_("Resetting"), BLUE, "#ffffff"),
    _S.HOLDING: StateStyle(N_("Holding"), AMBER, "#000000"),
    _S.HELD: StateStyle(N_("Held"), AMBER, "#000000"),
    _S.UNHOLDING: StateStyle(N_("Unholding"), AMBER, "#000000"),
    _S.SUSPENDING: StateStyle(N_("Suspending"), AMBER, "#000000"),
    _S.SUSPENDED: StateStyle(N_("Suspended"), AMBER, "#000000"),
    _S.UNSUSPENDING: StateStyle(N_("Unsuspending"), AMBER, "#000000"),
    _S.STOPPING: StateStyle(N_("Stopping"), RED, "#ffffff"),
    _S.STOPPED: StateStyle(N_("Stopped"), RED, "#ffffff"),
    _S.ABORTING: StateStyle(N_("Aborting"), RED, "#ffffff"),
    _S.ABORTED: StateStyle(N_("Aborted"), RED, "#ffffff"),
    _S.CLEARING: StateStyle(N_("Clearing"), RED, "#ffffff"),
}
#: No cell is there.
AWAY = StateStyle(N_("No cell runs"), _GREY, "#ffffff")
#: A cell may be there, and says nothing.
UNKNOWN = StateStyle(N_("No connection"), _GREY, "#ffffff")

#: Where `make docs-site` and wheels have the manual.
MANUAL = Path(__file__).parents[1] / "manual"

CSS = """
.q-btn { text-transform: none; }
.big-button { min-height: 4.5rem; min-width: 7rem; font-size: 1.35rem; font-weight: 600; }
.q-btn.disabled, .q-btn:disabled { filter: grayscale(1); opacity: 0.45 !important; }
.body--dark .q-btn:disabled { filter: grayscale(1) brightness(0.55); }
.no-connection-plate { display: none; width: calc(100% - 1rem); max-width: 79rem; margin: 0 auto;
  padding: 1rem; border-radius: 4px; background-color: #4a5563; color: #ffffff;
  position: sticky; top: 3.5rem; z-index: 20; }
.no-answer-said { display: none; }
body.no-connection .no-connection-plate, body.no-answer .no-answer-said { display: block; }
body.no-connection #state-card { display: none; }
.state-plate { font-size: clamp(2rem, 7vw, 4rem); font-weight: 700; line-height: 1.1; }
.figure { font-size: 1.6rem; font-weight: 600; font-variant-numeric: tabular-nums; }
.unseen { position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); }
.body--light { --q-primary: #0b57a4 !important; }
.body--dark { --q-primary: #8ab8f0 !important; }
.nicegui-link { color: var(--q-primary); }
header .nicegui-link { color: #ffffff; }
.quiet { color: #4a5563; }
.body--dark .quiet { color: #b4bcc8; }
.wrong { color: #b3261e; white-space: pre-line; }
.body--dark .wrong { color: #ff9b94; }
.plain-table { border-collapse: collapse; width: 100%; }
.plain-table th, .plain-table td { padding: 0.15rem 0.5rem; border-bottom: 1px solid #8a94a355; }
.plain-table th { text-align: left; font-weight: 600; }
.plain-table .text-right { text-align: right; }
.film-slider { min-height: 2.5rem; }
.guide:not(:empty) { border-left: 0.5rem solid #f5b301; padding-left: 0.75rem; }
.sticky-card { position: sticky; top: 3.5rem; z-index: 10; }
@media (max-width: 640px) { .sticky-card, .no-connection-plate { top: 6.5rem; } }
.entry { border-top: 1px solid #8a94a355; padding-top: 0.5rem; }
.diff { font-family: monospace; white-space: pre; border: 1px solid #8a94a3; padding: 0.5rem; }
.diff .added { background: #146c2e22; color: #0f5323; }
.diff .removed { background: #b3261e22; color: #8c1d18; }
.body--dark .diff .added { background: #146c2e66; color: #d5f5dd; }
.body--dark .diff .removed { background: #b3261e66; color: #ffdad6; }
.q-btn:focus-visible, a:focus-visible { outline: 3px solid #f5b301; outline-offset: 2px; }
"""


def manual_page(page: str) -> str:
    """Address of a page of the manual, e.g. `index.html`; empty if no manual is built here."""
    return f"/manual/{page}" if (MANUAL / page).exists() else ""


def table(
    title: str, heads: Sequence[str], rows: Sequence[Sequence[str]], numbers: Collection[int]
) -> None:
    """A card with a heading and a table.

    numbers  columns that stand to the right
    """
    with ui.card().classes("w-full overflow-x-auto"):
        ui.label(title).classes("text-xl font-bold").props("role=heading aria-level=2")
        with ui.element("table").classes("plain-table"):
            with ui.element("thead"), ui.element("tr"):
                for number, head in enumerate(heads):
                    with ui.element("th").classes("text-right" if number in numbers else ""):
                        ui.label(head)
            with ui.element("tbody"):
                for row in rows:
                    with ui.element("tr"):
                        for number, cell in enumerate(row):
                            place = ui.element("td")
                            with place.classes("text-right" if number in numbers else ""):
                                ui.label(cell).classes("whitespace-pre-line")
