"""Colours and words of the PackML states; readable on light and dark, at arm's length."""

from __future__ import annotations

from dataclasses import dataclass

from cell.run.machine import CellState

#: Background of a state with white or black letters on it: contrast ≥ 4.5 with either.
_GREEN, _BLUE, _AMBER, _RED, _GREY = "#146c2e", "#0b57a4", "#f5b301", "#b3261e", "#4a5563"


@dataclass(frozen=True)
class Look:
    """How a state is shown: its word in English, colours of ground and letters."""

    word: str
    ground: str
    letters: str


def N_(message: str) -> str:  # noqa: N802 - the name that gettext's tools look for
    """Marks a message for the catalogues; it is translated where it is shown."""
    return message


_S = CellState
LOOKS: dict[CellState, Look] = {
    _S.IDLE: Look(N_("Idle"), _BLUE, "#ffffff"),
    _S.STARTING: Look(N_("Starting"), _GREEN, "#ffffff"),
    _S.EXECUTE: Look(N_("Execute"), _GREEN, "#ffffff"),
    _S.COMPLETING: Look(N_("Completing"), _GREEN, "#ffffff"),
    _S.COMPLETE: Look(N_("Complete"), _GREEN, "#ffffff"),
    _S.RESETTING: Look(N_("Resetting"), _BLUE, "#ffffff"),
    _S.HOLDING: Look(N_("Holding"), _AMBER, "#000000"),
    _S.HELD: Look(N_("Held"), _AMBER, "#000000"),
    _S.UNHOLDING: Look(N_("Unholding"), _AMBER, "#000000"),
    _S.SUSPENDING: Look(N_("Suspending"), _AMBER, "#000000"),
    _S.SUSPENDED: Look(N_("Suspended"), _AMBER, "#000000"),
    _S.UNSUSPENDING: Look(N_("Unsuspending"), _AMBER, "#000000"),
    _S.STOPPING: Look(N_("Stopping"), _RED, "#ffffff"),
    _S.STOPPED: Look(N_("Stopped"), _RED, "#ffffff"),
    _S.ABORTING: Look(N_("Aborting"), _RED, "#ffffff"),
    _S.ABORTED: Look(N_("Aborted"), _RED, "#ffffff"),
    _S.CLEARING: Look(N_("Clearing"), _RED, "#ffffff"),
}
#: No cell is there.
AWAY = Look(N_("No cell runs"), _GREY, "#ffffff")

CSS = """
.q-btn { text-transform: none; }
.big-button { min-height: 4.5rem; min-width: 7rem; font-size: 1.35rem; font-weight: 600; }
.state-plate { font-size: clamp(2rem, 7vw, 4rem); font-weight: 700; line-height: 1.1; }
.figure { font-size: 1.6rem; font-weight: 600; font-variant-numeric: tabular-nums; }
.q-btn:focus-visible, a:focus-visible { outline: 3px solid #f5b301; outline-offset: 2px; }
"""
