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

#: Labels of choices that are not values in the file.
_WORDS = {"used": N_("used"), "not used": N_("not used")}


class Draft:
    """Changes of one settings file, not written yet.

    base  text of the file when it was read
    """

    def __init__(self, config: Path, base: str) -> None:
        self.config, self.base, self.text = config, base, base
        self.changes: dict[Names, Any] = {}
        self.unreadable: dict[Names, str] = {}

    def data(self) -> Mapping[str, Any]:
        """The changed file as plain data.  Raises InputError: the file is no YAML."""
        data = self._document(self.text).data
        return data if isinstance(data, Mapping) else {}

    def entries(self) -> tuple[SettingsEntry, ...]:
        """All entries of the changed file.  Raises InputError, as above."""
        return entries(self.data())

    def enter(self, entry: SettingsEntry, typed: str) -> None:
        """Set an entry to a typed or chosen value; empty = the default.

        raises  InputError: the entry cannot be changed alone in this file
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
        """Add changes.  Raises InputError: an entry cannot be changed alone."""
        keys = tuple(changes)
        # drop earlier changes within sections that are replaced
        old = {k: v for k, v in self.changes.items() if not any(k[: len(c)] == c for c in keys)}
        new = {k: v for k, v in changes.items() if v != _in(self._document(self.base).data, k)}
        if len(old) < len(self.changes):
            self.text = edited(self.config, self.base, {**old, **new})
        else:
            self.text = edited(self.config, self.text, new)
        self.changes = {**old, **new}

    def problems(self) -> tuple[tuple[str, str], ...]:
        """Problems of `cell check`: dotted key, "" = the file, and message; () = none."""
        problems = [(dotted(k), message) for k, message in self.unreadable.items()]
        try:
            settings_of(self._document(self.text))
        except InputError as error:
            problems += [(p.key, p.message) for p in error.problems]
        return tuple(problems)

    def oddities(self) -> tuple[str, ...]:
        """Warnings about unusual entries.  Raises InputError: the file is wrong."""
        return oddities(settings_of(self._document(self.text)))

    def differences(self) -> str:
        """Changes of the file, as a unified diff; "" = none."""
        return differences(self.base, self.text, self.config.name)

    def on(self, base: str) -> Draft:
        """The same changes applied to `base`.  Raises InputError: they do not fit it."""
        rebased = Draft(self.config, base)
        rebased.change(self.changes)
        return rebased

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
    """Plain data of a typed value for an entry; `UNSET` = empty.

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
        parsed = document_of(f"value: {typed}", Path("entry")).data
    except InputError as error:
        raise ValueError(error.problems[0].message) from error
    if not isinstance(parsed, Mapping) or list(parsed) != ["value"]:
        raise ValueError("is no value in one line")
    return parsed["value"]


def _in(data: Any, key: Names) -> Any:
    """Value of an entry in the file; `UNSET` = none."""
    for name in key:
        if not isinstance(data, Mapping) or name not in data:
            return UNSET
        data = data[name]
    return data


def value_text(value: str, t: Translate) -> str:
    """Text of a value as in the file; the words `used` and `not used` are translated."""
    return t(_WORDS[value]) if value in _WORDS else value
