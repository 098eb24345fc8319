"""Colours and words of the PackML states; readable on light and dark, at arm's length."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nicegui import ui

from cell.run.machine import CellState
from cell.web.wording import Translate

#: Background colours of buttons and icons with white or black letters: contrast ≥ 4.5 with either.
GREEN, BLUE, AMBER, RED = "#146c2e", "#0b57a4", "#f5b301", "#b3261e"
#: Style classes, after ISA-101: grey unless a person is needed, or nothing is known.
NORMAL, WAITS, ALARM, NO_DATA = "normal", "waits", "alarm", "no-data"


@dataclass(frozen=True)
class StateStyle:
    """Style of a state: its English label, and its style class."""

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
#: Style without a cell.
AWAY = StateStyle(N_("No cell runs"), NO_DATA)
#: Style of a cell that does not answer.
UNKNOWN = StateStyle(N_("No connection"), NO_DATA)

#: Folder of the manual, as built by `make docs-site` and in wheels.
MANUAL = Path(__file__).parents[1] / "manual"


def asset(name: str, **values: str) -> str:
    """A script or style sheet of the pages, with values in place of names in it."""
    text = (Path(__file__).parent / "assets" / name).read_text(encoding="utf-8")
    for key, value in values.items():
        text = text.replace(key, value)
    return text


def manual_page(page: str) -> str:
    """Address of a page of the manual, e.g. `index.html`; empty if no manual is built here."""
    return f"/manual/{page}" if (MANUAL / page).exists() else ""


#: Lets the browser warn before it leaves a page with unsaved text.
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
        """Notify the browser of a change."""
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


def card(title: str) -> ui.card:
    """A card with a heading, to be filled within a `with`."""
    with ui.card().classes("w-full") as made:
        heading(title)
    return made


#: What a button calls.
Act = Callable[..., Any] | None


def filled(text: str, test: str, act: Act = None, icon: str | None = None) -> ui.button:
    """A button of a main action; `test` is its name in tests."""
    button = ui.button(text, icon=icon, color=BLUE, on_click=act)
    return button.props(f"text-color=white data-test={test}")


def outlined(text: str, test: str, act: Act = None, icon: str | None = None) -> ui.button:
    """A button of another action."""
    return ui.button(text, icon=icon, on_click=act).props(f"outline data-test={test}")


def several_of(label: str, test: str, width: str = "w-full") -> ui.select:
    """A choice of several names, which are set later."""
    choice = ui.select([], label=label, multiple=True).classes(width)
    return choice.props(f"use-chips data-test={test}")


#: JavaScript: the number x with the decimal sign of the page's language.
_IN_LANGUAGE = "x.toLocaleString(document.documentElement.lang, {maximumSignificantDigits: 6})"


def chart(option: dict[str, Any], height: str = "h-64") -> ui.echart:
    """A chart whose labels follow the colour of the theme, in contrast to plain canvas text."""
    return ui.echart(localised(option), renderer="svg").classes(f"trend w-full {height}")


def show_option(place: ui.echart, option: dict[str, Any]) -> None:
    """Replace the content of a chart."""
    place.options.clear()
    place.options.update(localised(option))


def localised(option: dict[str, Any]) -> dict[str, Any]:
    """An ECharts option whose numbers the browser formats in the page's language."""
    axes = [option.get(name, {}) for name in ("xAxis", "yAxis")]
    for axis in (each for a in axes for each in (a if isinstance(a, list) else [a])):
        label = axis.get("axisLabel", {})
        if axis.get("type") == "value":
            unit = label.get("formatter", "").removeprefix("{value}")
            axis["axisLabel"] = {**label, ":formatter": f"(x) => {_IN_LANGUAGE} + {unit!r}"}
    if "tooltip" in option:
        option["tooltip"][":valueFormatter"] = f"(x) => typeof x === 'number' ? {_IN_LANGUAGE} : x"
    return option


def notify_refusal(refused: str | None, t: Translate) -> None:
    """Show the reason of a refusal, if any."""
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
    """Whether a person confirms a question; `answer` is the label of the confirming button."""
    with ui.dialog() as dialog, ui.card():
        ui.label(question)
        with ui.row():
            ui.button(t("Close"), on_click=lambda: dialog.submit(False)).props("outline")
            filled(answer, test, lambda: dialog.submit(True))
    sure = bool(await dialog)
    dialog.delete()
    return sure


def table_head(heads: Sequence[str], numbers: Collection[int]) -> None:
    """Headings of a table; `numbers`: right-aligned columns."""
    with ui.element("thead"), ui.element("tr"):
        for number, head in enumerate(heads):
            with ui.element("th").classes("text-right" if number in numbers else ""):
                ui.label(head)


def table(
    title: str, heads: Sequence[str], rows: Sequence[Sequence[str]], numbers: Collection[int]
) -> None:
    """A card with a heading and a table.

    numbers  right-aligned columns
    """
    with ui.card().classes("w-full overflow-x-auto"):
        heading(title)
        with ui.element("table").classes("plain-table"):
            table_head(heads, numbers)
            with ui.element("tbody"):
                for row in rows:
                    with ui.element("tr"):
                        for number, cell in enumerate(row):
                            place = ui.element("td")
                            with place.classes("text-right" if number in numbers else ""):
                                ui.label(cell).classes("whitespace-pre-line")
