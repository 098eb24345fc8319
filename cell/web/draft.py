"""Edits of a settings file before they are written: entries, the resulting text, problems."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cell.files.input_error import InputError
from cell.files.yaml_document import Document, document_of, dotted
from cell.files.yaml_edit import UNSET, Names, edited, flow
from cell.settings.check import oddities
from cell.settings.entries import SettingsEntry, SettingsForm, change_for, entries
from cell.settings.loading import settings_of
from cell.web.theme import N_
from cell.web.wording import Translate

#: Words of choices that are no words of the file.
_WORDS = {"used": N_("used"), "not used": N_("not used")}


class Draft:
    """Changes of one settings file, not written yet.

    base  the file's text as it was read
    """

    def __init__(self, config: Path, base: str) -> None:
        self.config, self.base, self.text = config, base, base
        self.changes: dict[Names, Any] = {}
        self.unreadable: dict[Names, str] = {}

    def data(self) -> Mapping[str, Any]:
        """The changed file as plain data.  Raises InputError: the file is no YAML."""
        found = self._document(self.text).data
        return found if isinstance(found, Mapping) else {}

    def entries(self) -> tuple[SettingsEntry, ...]:
        """All entries of the changed file.  Raises InputError, as above."""
        return entries(self.data())

    def enter(self, entry: SettingsEntry, typed: str) -> None:
        """What a person has typed or chosen; nothing = the default.

        raises  InputError: the entry cannot be changed by itself, as the file is written
        """
        self.unreadable.pop(entry.key, None)
        try:
            value = value_of(entry, typed)
        except ValueError as error:
            self.unreadable[entry.key] = str(error)
            return
        changed = entry.key in self.changes
        if value is UNSET:
            if entry.given or changed:
                self.change({entry.key: UNSET})
        elif changed or value != entry.value:
            self.change(change_for(self.data(), entry.key, value))

    def change(self, changes: Mapping[Names, Any]) -> None:
        """Take up changes.  Raises InputError: an entry cannot be changed by itself."""
        keys = tuple(changes)
        # what was entered in a section that is another now has no place any more
        kept = {k: v for k, v in self.changes.items() if not any(k[: len(c)] == c for c in keys)}
        new = {k: v for k, v in changes.items() if v != _in(self._document(self.base).data, k)}
        if len(kept) < len(self.changes):
            self.text = edited(self.config, self.base, {**kept, **new})
        else:
            self.text = edited(self.config, self.text, new)
        self.changes = {**kept, **new}

    def problems(self) -> tuple[tuple[str, str], ...]:
        """Dotted key, "" = the file, and what `cell check` says of it; () = it is right."""
        found = [(dotted(k), said) for k, said in self.unreadable.items()]
        try:
            settings_of(self._document(self.text))
        except InputError as error:
            found += [(p.key, p.message) for p in error.problems]
        return tuple(found)

    def oddities(self) -> tuple[str, ...]:
        """What is possible and rarely meant.  Raises InputError: the file is wrong."""
        return oddities(settings_of(self._document(self.text)))

    def differences(self) -> str:
        """What would be written, as a unified diff; "" = nothing."""
        return differences(self.base, self.text, self.config.name)

    def on(self, base: str) -> Draft:
        """The same changes on another text.  Raises InputError: they do not fit it."""
        other = Draft(self.config, base)
        other.change(self.changes)
        return other

    def summary(self) -> str:
        """The changes in one line, for the audit log."""
        before = self._document(self.base).data
        shown = {k: (_in(before, k), v) for k, v in self.changes.items()}
        return "; ".join(
            f"{dotted(k)}: {' → '.join('default' if v is UNSET else flow(v) for v in pair)}"
            for k, pair in shown.items()
        )

    def _document(self, text: str) -> Document:
        return document_of(text.removeprefix("\ufeff"), self.config)


def differences(before: str, after: str, name: str) -> str:
    """A unified diff of two texts; "" = they are the same."""
    lines = difflib.unified_diff(
        before.splitlines(), after.splitlines(), name, name, lineterm="", n=2
    )
    return "\n".join(lines)


def value_of(entry: SettingsEntry, typed: str) -> Any:
    """Plain data that a person has typed for an entry; `UNSET` = nothing.

    raises  ValueError: it is no value in one line of YAML
    """
    typed = typed.strip()
    if not typed:
        return UNSET
    if entry.form is SettingsForm.CHOSEN:
        return entry.choices.get(typed, typed)
    if entry.form is SettingsForm.TEXT and typed != "null":
        return typed
    try:
        found = document_of(f"value: {typed}", Path("entry")).data
    except InputError as error:
        raise ValueError(error.problems[0].message) from error
    if not isinstance(found, Mapping) or list(found) != ["value"]:
        raise ValueError("is no value in one line")
    return found["value"]


def _in(data: Any, key: Names) -> Any:
    """What the file has for an entry; `UNSET` = nothing."""
    for name in key:
        if not isinstance(data, Mapping) or name not in data:
            return UNSET
        data = data[name]
    return data


def value_text(value: str, t: Translate) -> str:
    """Text of a value as in the file; the words `used` and `not used` are translated."""
    return t(_WORDS[value]) if value in _WORDS else value
