"""A plain table of texts: few rows, nothing to be sorted."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from nicegui import ui


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
