"""Entries of the settings as rows: explained, searched, and what is wrong with each beside it."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

from nicegui import ui

from cell.settings.entries import SettingsEntry, SettingsForm
from cell.web.draft import Draft, value_said
from cell.web.wording import Translate

_IN_FILE, _ALL = "", "*"


@dataclass
class _EntryRow:
    """An entry on the page: where what is wrong with it is said."""

    entry: SettingsEntry
    box: ui.element
    said: ui.label
    field: ui.input | ui.select


class EntryRows:
    """The rows of one open page, and the fields that choose which are shown.

    entered  is told what was typed into an entry
    chosen   is told when others are shown while something is wrong
    """

    def __init__(
        self,
        t: Translate,
        entered: Callable[[SettingsEntry, str], Awaitable[None]],
        chosen: Callable[[], None],
    ) -> None:
        self._t, self._entered, self._chosen = t, entered, chosen
        self._rows: dict[str, _EntryRow] = {}
        self._headings: dict[str, ui.label] = {}
        self._asked_for: set[str] = set()
        self._wrong: Sequence[tuple[str, str]] = ()
        self._choices = {_IN_FILE: t("What the file has"), _ALL: t("All entries")}

    def build_fields(self) -> None:
        """Make the fields that choose."""
        t = self._t
        with ui.element("div").classes("w-full grid grid-cols-1 md:grid-cols-2 gap-4"):
            self._section = ui.select(self._choices, value=_IN_FILE, label=t("Section"))
            self._search = ui.input(t("Search")).props("clearable debounce=40 maxlength=60")
            self._search.props("data-test=search")
            for field in (self._section, self._search):
                field.classes("w-full").on_value_change(self._choose)

    def build_rows(self) -> None:
        """Make the place of the rows."""
        self.place = ui.column().classes("w-full gap-2")

    def fill(self, draft: Draft) -> None:
        """Make the rows anew, for the draft has other entries; show those that are asked for."""
        self._draft = draft
        self.place.clear()
        self._rows.clear()
        self._headings.clear()
        with self.place:
            for entry in draft.entries():
                section = entry.key[0]
                if section not in self._headings:
                    heading = ui.label(section).classes("text-xl mt-4")
                    self._headings[section] = heading.props("role=heading aria-level=2")
                self._rows[entry.name] = self._row(entry)
            self._none = ui.label(self._t("No entry is called so."))
            names = {name: name for name in self._headings}
            self._section.set_options({**self._choices, **names}, value=self._section.value)
            self._rule = ui.html(self._hiding(), sanitize=False)  # ids of elements, nobody's text

    def _choose(self) -> None:
        """Show the entries that are asked for; what is typed in the others stays.

        One rule of style hides the others, and the browser is told nothing else: for every change
        of an element it goes through all of them, which takes some tenths of a second.
        """
        text = json.dumps(self._hiding())
        ui.run_javascript(f"document.getElementById('{self._rule.html_id}').innerHTML = {text}")
        if self._wrong:
            self._chosen()

    def _hiding(self) -> str:
        """Find what is asked for: the rule that hides the rest."""
        self._asked_for = {n for n, row in self._rows.items() if self._wanted(row.entry)}
        headed = {self._rows[name].entry.key[0] for name in self._asked_for}
        away = [row.box for name, row in self._rows.items() if name not in self._asked_for]
        away += [h for section, h in self._headings.items() if section not in headed]
        away += [self._none] if headed else []
        return f"<style>{', '.join(f'#{e.html_id}' for e in away)} {{display: none}}</style>"

    def _wanted(self, entry: SettingsEntry) -> bool:
        """Whether an entry is of the section, or, if something is searched, has all its words."""
        words = (self._search.value or "").lower().split()
        if words:
            said = f"{entry.name} {entry.explained} {entry.unit}".lower()
            return all(w in said for w in words)
        there = entry.given or entry.key in self._draft.changes or entry.key[-1] == "kind"
        section = self._section.value
        return section in (_ALL, entry.key[0]) or (section == _IN_FILE and there)

    def _row(self, entry: SettingsEntry) -> _EntryRow:
        t = self._t
        given = entry.given or entry.key in self._draft.changes
        box = ui.element("div").classes("w-full grid grid-cols-1 md:grid-cols-2 gap-x-6 entry")
        with box:
            if entry.form is SettingsForm.CHOSEN:
                choices = {w: value_said(w, t) for w in entry.choices}
                shown = entry.shown(entry.value)
                value = shown if shown in choices else None
                field: ui.input | ui.select = ui.select(choices, label=entry.name, value=value)
                field.props("stack-label")
            else:
                field = ui.input(entry.name, value=entry.shown(entry.value) if given else "")
                field.props("stack-label debounce=300 maxlength=20000 autocomplete=off")
                field.props["placeholder"] = entry.shown(entry.default)
                field.props["suffix"] = entry.unit
            field.classes("w-full").props(f'data-test="{entry.name}" hide-bottom-space')
            with ui.element("div").classes("flex flex-col"):
                ui.label(entry.explained)
                ui.label(self._limits(entry)).classes("text-sm quiet")
                said = ui.label().classes("break-words wrong").props("aria-live=polite")
                said.props(f'data-test="{entry.name}:said"')
        field.on_value_change(lambda e: self._entered(entry, str(e.value or "")))
        return _EntryRow(entry, box, said, field)

    def _limits(self, entry: SettingsEntry) -> str:
        t = self._t
        usual = value_said(entry.shown(entry.default), t)
        default = f"{t('default')} {usual}" if usual else t("must be given")
        return "; ".join(filter(None, (entry.limits, default)))

    def tell(self, found: Sequence[tuple[str, str]]) -> list[str]:
        """Say what is wrong beside the entries that are shown.

        found    dotted key, "" = the file, and what is wrong
        returns  what is wrong elsewhere, a sentence each
        """
        self._wrong, elsewhere = found, []
        shown = [name for name in self._rows if name in self._asked_for]
        beside: dict[str, list[str]] = {}
        for key, said in found:
            place = next((n for n in shown if n == key), "")
            place = place or next((n for n in shown if key.startswith(f"{n}[")), "")
            if place:
                beside.setdefault(place, []).append(said)
            else:
                elsewhere.append(f"{key}: {said}" if key else said)
        for name, row in self._rows.items():
            row.said.text = "\n".join(beside.get(name, ()))
            wrong = name in beside
            if wrong != ("error" in row.field.props):  # the others need not be told
                row.field.props("error") if wrong else row.field.props(remove="error")
        return elsewhere
