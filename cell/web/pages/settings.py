"""The settings' form: entries explained, checked as they are typed; differences, then writing."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from nicegui import run, ui

from cell.files.input_error import InputError
from cell.plant.users import Role
from cell.settings.entries import SettingsEntry, SettingsForm
from cell.settings.promotion import ChangedMeanwhileError, read_exactly, replace_settings, versions
from cell.web.draft import Draft, differences, value_text
from cell.web.theme import Unsaved, card, filled, heading, notify_refusal, outlined
from cell.web.visit import Visit
from cell.web.wording import Translate

_IN_FILE, _ALL = "", "*"


@dataclass
class _EntryRow:
    """An entry on the page, with the label of its error message."""

    entry: SettingsEntry
    box: ui.element
    message: ui.label
    field: ui.input | ui.select


class EntryRows:
    """The rows of one open page, and the fields that filter them.

    entered  callback for a typed value
    chosen   callback when the filter changes while there are errors
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
        self._matching: set[str] = set()
        self._wrong: Sequence[tuple[str, str]] = ()
        self._choices = {_IN_FILE: t("What the file has"), _ALL: t("All entries")}

    def build_fields(self) -> None:
        """Make the fields of the filter."""
        t = self._t
        with ui.element("div").classes("w-full grid grid-cols-1 md:grid-cols-2 gap-4"):
            self._section = ui.select(self._choices, value=_IN_FILE, label=t("Section"))
            self._search = ui.input(t("Search")).props("clearable debounce=40 maxlength=60")
            self._search.props("data-test=search")
            for field in (self._section, self._search):
                field.classes("w-full").on_value_change(self._choose)

    def build_rows(self) -> None:
        """Make the container of the rows."""
        self.place = ui.column().classes("w-full gap-2")

    def fill(self, draft: Draft) -> None:
        """Rebuild the rows for changed entries of the draft; show those that match the filter."""
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
        """Show the entries that match the filter; typed values in the others stay.

        One style rule hides the others: changes of single elements would each make the browser
        process all of them, which takes some tenths of a second.
        """
        text = json.dumps(self._hiding())
        ui.run_javascript(f"document.getElementById('{self._rule.html_id}').innerHTML = {text}")
        if self._wrong:
            self._chosen()

    def _hiding(self) -> str:
        """Apply the filter: the style rule that hides the rest."""
        self._matching = {n for n, row in self._rows.items() if self._matches_search(row.entry)}
        headed = {self._rows[name].entry.key[0] for name in self._matching}
        away = [row.box for name, row in self._rows.items() if name not in self._matching]
        away += [h for section, h in self._headings.items() if section not in headed]
        away += [self._none] if headed else []
        return f"<style>{', '.join(f'#{e.html_id}' for e in away)} {{display: none}}</style>"

    def _matches_search(self, entry: SettingsEntry) -> bool:
        """Whether an entry has all words of the search, or without one is of the section."""
        words = (self._search.value or "").lower().split()
        if words:
            text = f"{entry.name} {self._t(entry.explained)} {entry.unit}".lower()
            return all(w in text for w in words)
        there = entry.given or entry.key in self._draft.changes or entry.key[-1] == "kind"
        section = self._section.value
        return section in (_ALL, entry.key[0]) or (section == _IN_FILE and there)

    def _row(self, entry: SettingsEntry) -> _EntryRow:
        t = self._t
        present = entry.given or entry.key in self._draft.changes
        box = ui.element("div").classes("w-full grid grid-cols-1 md:grid-cols-2 gap-x-6 entry")
        with box:
            if entry.form is SettingsForm.CHOSEN:
                choices = {w: value_text(w, t) for w in entry.choices}
                shown = entry.shown(entry.value)
                value = shown if shown in choices else None
                field: ui.input | ui.select = ui.select(choices, label=entry.name, value=value)
                field.props("stack-label")
            else:
                field = ui.input(entry.name, value=entry.shown(entry.value) if present else "")
                field.props("stack-label debounce=300 maxlength=20000 autocomplete=off")
                field.props["placeholder"] = entry.shown(entry.default)
                field.props["suffix"] = entry.unit
            field.classes("w-full").props(f'data-test="{entry.name}" hide-bottom-space')
            with ui.element("div").classes("flex flex-col"):
                ui.label(t(entry.explained))
                ui.label(self._limits(entry)).classes("text-sm quiet")
                message = ui.label().classes("break-words wrong").props("aria-live=polite")
                message.props(f'data-test="{entry.name}:said"')
        field.on_value_change(lambda e: self._entered(entry, str(e.value or "")))
        return _EntryRow(entry, box, message, field)

    def _limits(self, entry: SettingsEntry) -> str:
        t = self._t
        usual = value_text(entry.shown(entry.default), t)
        default = f"{t('default')} {usual}" if usual else t("must be given")
        return "; ".join(filter(None, (entry.limits, default)))

    def show_problems(self, problems: Sequence[tuple[str, str]]) -> list[str]:
        """Show problems next to the entries that match the filter.

        problems  dotted key, "" = the file, and message
        returns   sentences on problems elsewhere
        """
        self._wrong, elsewhere = problems, []
        shown = [name for name in self._rows if name in self._matching]
        messages: dict[str, list[str]] = {}
        for key, message in problems:
            place = next((n for n in shown if n == key), "")
            place = place or next((n for n in shown if key.startswith(f"{n}[")), "")
            if place:
                messages.setdefault(place, []).append(message)
            else:
                elsewhere.append(f"{key}: {message}" if key else message)
        for name, row in self._rows.items():
            row.message.text = "\n".join(messages.get(name, ()))
            wrong = name in messages
            if wrong != ("error" in row.field.props):  # the others are unchanged
                row.field.props("error") if wrong else row.field.props(remove="error")
        return elsewhere


#: Number of earlier versions that are offered.
_VERSIONS = 50


def build(visit: Visit) -> None:
    """Fill the page."""
    t, config = visit.t, visit.room.config
    ui.label(t("Settings")).classes("text-2xl").props("role=heading aria-level=1")
    ui.label(str(config.resolve())).classes("break-all")
    ui.label(t("A running cell takes changes up at its next start."))
    try:
        text = read_exactly(config)
        Draft(config, text).entries()
    except (OSError, ValueError) as error:
        ui.label(str(error)).classes("whitespace-pre-wrap break-words wrong")
        ui.label(t("Edit the file by hand, then load this page again."))
        return
    _SettingsPage(visit, Draft(config, text))


class _SettingsPage:
    """The elements of one open page, and the changes that it holds."""

    def __init__(self, visit: Visit, draft: Draft) -> None:
        self._visit, self._t, self._draft = visit, visit.t, draft
        self._rows = EntryRows(visit.t, self._entered, self._show_problems)
        self._unsaved = Unsaved("settings")
        self._shown = 0
        self._problems: Sequence[tuple[str, str]] = ()
        t = self._t
        self._rows.build_fields()
        with ui.card().classes("w-full sticky-card"):
            self._state = ui.label().classes("text-lg").props("role=status data-test=checked")
            self._general = ui.label().classes("whitespace-pre-line break-words wrong")
            with ui.row():
                filled(t("Show differences"), "differences", self._differences)
                self._discard = ui.button(
                    t("Discard"), on_click=lambda: self._load(self._draft.base)
                ).props("outline")
        self._rows.build_rows()
        self._earlier()
        self._fill()

    def _fill(self) -> None:
        self._rows.fill(self._draft)
        ui.timer(0.01, self._check, once=True)

    async def _entered(self, entry: SettingsEntry, text: str) -> None:
        if not self._visit.stays(Role.engineer):
            return
        present = next((e for e in self._draft.entries() if e.key == entry.key), entry)
        try:
            self._draft.enter(present, text)
        except InputError as error:
            self._draft.unreadable[entry.key] = error.problems[0].message
        if entry.section or entry.key[-1] == "kind":
            self._fill()
        else:
            await self._check()

    async def _check(self) -> None:
        """Show the problems of `cell check` next to the entries; outdated results are dropped."""
        self._shown += 1
        number = self._shown
        problems = await run.io_bound(self._draft.problems)
        if problems is None or number != self._shown:
            return
        self._problems = problems
        self._show_problems()
        if not problems:
            self._general.text = "\n".join(await run.io_bound(self._draft.oddities) or ())

    def _show_problems(self) -> None:
        """Show the problems next to the visible entries, or above all."""
        t, changed = self._t, len(self._draft.changes)
        self._general.text = "\n".join(self._rows.show_problems(self._problems))
        self._state.text = f"{t('Changes')}: {changed}. " + (
            t("The settings are wrong.") if self._problems else t("The settings are right.")
        )
        is_typed = bool(changed or self._draft.unreadable)
        self._discard.set_enabled(is_typed)
        self._unsaved.set(is_typed)

    def _load(self, text: str) -> None:
        self._draft = Draft(self._draft.config, text)
        self._fill()

    async def _differences(self) -> None:
        problems = await run.io_bound(self._draft.problems)
        draft = self._draft
        if problems or not draft.differences():
            words = self._t("The settings are wrong.") if problems else self._t("Nothing changed.")
            ui.notify(words, type="warning")
            return
        self._confirm(draft.base, draft.text, draft.summary())

    def _confirm(self, before: str, after: str, summary: str) -> None:
        """Show differences, and write after a person's confirmation."""
        t = self._t
        with ui.dialog() as dialog, ui.card().classes("w-full max-w-4xl"):
            heading(t("Differences"))
            _diff(differences(before, after, self._draft.config.name))
            ui.label(t("A running cell takes changes up at its next start."))
            with ui.row():
                write = filled(t("Write"), "write")
                ui.button(t("Close"), on_click=dialog.close).props("outline")

        async def written() -> None:
            write.disable()
            dialog.close()
            with self._rows.place:  # the dialog and all in it will be gone
                await self._write(before, after, summary)

        write.on_click(written)
        dialog.on("hide", dialog.delete)
        dialog.open()

    async def _write(self, before: str, after: str, summary: str) -> None:
        visit, config = self._visit, self._draft.config
        meanwhile: list[str] = []

        def act() -> str:
            try:
                replace_settings(config, before, after)
            except ChangedMeanwhileError as error:
                meanwhile.append(error.text)
                return str(error)
            except OSError as error:
                return f"{error.filename or config}: {error.strerror}"
            return ""

        refused = await run.io_bound(visit.do, "write settings", Role.engineer, act, summary)
        if meanwhile:
            self._changed_meanwhile(meanwhile[0])
        elif refused:
            notify_refusal(refused, self._t)
        elif refused is not None:
            ui.notify(self._t("The settings are written."), type="positive")
            self._load(after)
            self._earlier.refresh()

    def _changed_meanwhile(self, present: str) -> None:
        t, draft = self._t, self._draft
        with ui.dialog() as dialog, ui.card().classes("w-full max-w-4xl"):
            ui.label(t("The file was changed meanwhile; nothing is written.")).classes("text-xl")
            ui.label(t("Changed in the file meanwhile"))
            _diff(differences(draft.base, present, draft.config.name))
            ui.label(t("Your changes"))
            _diff(draft.differences())

            def take_over() -> None:
                dialog.close()
                try:
                    self._draft = draft.on(present)
                except InputError as error:
                    notify_refusal(str(error), t)
                    return
                with self._rows.place:
                    self._fill()

            def load() -> None:
                dialog.close()
                with self._rows.place:
                    self._load(present)

            with ui.row():
                take = ui.button(t("Make my changes to the new file"), on_click=take_over)
                take.props("data-test=take-over")
                ui.button(t("Give my changes up"), on_click=load).props("outline")
        dialog.on("hide", dialog.delete)
        dialog.open()

    @ui.refreshable_method
    def _earlier(self) -> None:
        """Earlier versions of the file, each of which can be written again."""
        t, config = self._t, self._draft.config
        saved = versions(config)[:_VERSIONS]
        if not saved:
            return
        with card(t("Earlier versions")):
            names = {str(p): _version(p) for p in saved}
            chosen = ui.select(names, value=str(saved[0]), label=t("Replaced at"))
            chosen.classes("w-full")

            def back() -> None:
                file = Path(str(chosen.value))
                if file not in saved or not self._visit.stays(Role.engineer):
                    return
                try:
                    present, former = read_exactly(config), read_exactly(file)
                except (OSError, ValueError) as error:
                    notify_refusal(str(error), t)
                    return
                self._confirm(present, former, f"as in {file.name}")

            outlined(t("Go back to this version"), "back", back)


def _version(file: Path) -> str:
    try:
        at = datetime.fromtimestamp(file.stat().st_mtime).astimezone()
    except OSError:
        return file.name
    return f"{at:%Y-%m-%d %H:%M:%S} ({file.name})"


def _diff(text: str) -> None:
    """A unified diff, coloured, as text that can be selected."""
    with ui.element("div").classes("w-full overflow-x-auto diff").props("tabindex=0"):
        for line in text.splitlines()[2:]:
            ui.label(line or " ").classes(_DIFF.get(line[:1], ""))


_DIFF: Mapping[str, str] = {"+": "added", "-": "removed", "@": "quiet"}
