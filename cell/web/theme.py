"""Colours and words of the PackML states; readable on light and dark, at arm's length."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nicegui import ui

from cell.run.machine import CellState
from cell.web.wording import Translate

#: Grounds of buttons and icons with white or black letters on them: contrast ≥ 4.5 with either.
GREEN, BLUE, AMBER, RED = "#146c2e", "#0b57a4", "#f5b301", "#b3261e"
#: Classes of style, after ISA-101: grey unless a person is needed, or nothing is known.
NORMAL, WAITS, ALARM, NO_DATA = "normal", "waits", "alarm", "no-data"


@dataclass(frozen=True)
class StateStyle:
    """How a state is shown: its word in English, and its class of style."""

    word: str
    level: str = NORMAL


def N_(message: str) -> str:  # noqa: N802 - the name that gettext's tools look for
    """Marks a message for the catalogues; it is translated where it is shown."""
    return message


_S = CellState
_WAITING = frozenset({_S.HOLDING, _S.HELD, _S.UNHOLDING})
_STOPPED = frozenset({_S.STOPPING, _S.STOPPED, _S.ABORTING, _S.ABORTED, _S.CLEARING})
LOOKS: dict[CellState, StateStyle] = {
    s: StateStyle(
        s.value.capitalize(), ALARM if s in _STOPPED else WAITS if s in _WAITING else NORMAL
    )
    for s in CellState
}
#: No cell is there.
AWAY = StateStyle(N_("No cell runs"), NO_DATA)
#: A cell may be there, and says nothing.
UNKNOWN = StateStyle(N_("No connection"), NO_DATA)

#: Where `make docs-site` and wheels have the manual.
MANUAL = Path(__file__).parents[1] / "manual"

CSS = """
.q-btn { text-transform: none; }
.big-button { min-height: 4.5rem; min-width: 7rem; font-size: 1.35rem; font-weight: 600; }
.q-btn.disabled, .q-btn:disabled { filter: grayscale(1); opacity: 0.45 !important; }
.body--dark .q-btn:disabled { filter: grayscale(1) brightness(0.55); }
.normal { background: #e4e7eb; color: #1d232b; }
.body--dark .normal { background: #2b323b; color: #eef1f5; }
.waits { background: #f5b301; color: #000000; }
.alarm { background: #b3261e; color: #ffffff; }
.no-data { background: #4a5563; color: #ffffff; }
.no-connection-plate { display: none; width: calc(100% - 1rem); max-width: 79rem; margin: 0 auto;
  padding: 1rem; border-radius: 4px; position: sticky; top: 3.5rem; z-index: 20; }
.no-answer-said { display: none; }
body.no-connection .no-connection-plate, body.no-answer .no-answer-said { display: block; }
body.no-connection .live-state { display: none; }
body.unheard main button { pointer-events: none; opacity: 0.45; }
.state-plate { font-size: clamp(2.5rem, 4.5vw, 4.5rem); font-weight: 700; line-height: 1.2; }
.unseen { position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); }
.body--light { --q-primary: #0b57a4 !important; }
.body--dark { --q-primary: #8ab8f0 !important; }
.nicegui-link { color: var(--q-primary); }
header .nicegui-link { color: #ffffff; }
.quiet { color: #4a5563; }
.body--dark .quiet { color: #b4bcc8; }
.wrong { color: #b3261e; white-space: pre-line; }
.body--dark .wrong { color: #ff9b94; }
.trend text { fill: #4a5563; }
.body--dark .trend text { fill: #b4bcc8; }
.plain-table { border-collapse: collapse; width: 100%; }
.plain-table th, .plain-table td { padding: 0.15rem 0.5rem; border-bottom: 1px solid #8a94a355; }
.plain-table th { text-align: left; font-weight: 600; }
.plain-table .text-right { text-align: right; }
.loss-bar { height: 1rem; background: #6b7684; }
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


#: The browser asks before it leaves a page on which something is typed and not kept.
UNSAVED = """
<script>
window.unsaved = new Set();
window.addEventListener('beforeunload', (e) => { if (unsaved.size) e.preventDefault(); });
</script>
"""


class Unsaved:
    """Tells the browser whether an input has unsaved text that would be lost with the page."""

    def __init__(self, name: str) -> None:
        self._name, self._is_typed = name, False

    def set(self, is_typed: bool) -> None:
        """Tell the browser, if that has changed."""
        if is_typed != self._is_typed:
            self._is_typed = is_typed
            change = "add" if is_typed else "delete"
            ui.run_javascript(f"unsaved.{change}({json.dumps(self._name)})")


def heading(text: str) -> None:
    """Heading of a part of a page."""
    ui.label(text).classes("text-xl font-bold").props("role=heading aria-level=2")


def columns(*named: tuple[str, str]) -> list[dict[str, Any]]:
    """Columns of a `ui.table`: keys of its rows, with headings."""
    return [{"name": k, "label": title, "field": k, "align": "left"} for k, title in named]


def chart(option: dict[str, Any], height: str = "h-64") -> ui.echart:
    """A chart whose words have the colour of the theme, which letters on a canvas would not."""
    return ui.echart(option, renderer="svg").classes(f"trend w-full {height}")


def show_option(place: ui.echart, option: dict[str, Any]) -> None:
    """Show something else in a chart."""
    place.options.clear()
    place.options.update(option)


def notify_refusal(refused: str | None, t: Translate) -> None:
    """Say why something was not done, if there is a reason."""
    if refused:
        ui.notify(
            t(refused),
            type="negative",
            position="top",
            multi_line=True,
            close_button=t("Close"),
            classes="whitespace-pre-line",
            attrs={"data-test": "refused"},
        )


async def confirmed(question: str, answer: str, t: Translate, test: str) -> bool:
    """Whether a person says yes to a question; `answer` is on the button that does."""
    with ui.dialog() as asked, ui.card():
        ui.label(question)
        with ui.row():
            ui.button(t("Close"), on_click=lambda: asked.submit(False)).props("outline")
            yes = ui.button(answer, color=BLUE, on_click=lambda: asked.submit(True))
            yes.props(f"text-color=white data-test={test}")
    sure = bool(await asked)
    asked.delete()
    return sure


def table(
    title: str, heads: Sequence[str], rows: Sequence[Sequence[str]], numbers: Collection[int]
) -> None:
    """A card with a heading and a table.

    numbers  columns that stand to the right
    """
    with ui.card().classes("w-full overflow-x-auto"):
        heading(title)
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
