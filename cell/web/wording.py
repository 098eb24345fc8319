"""Words of the pages in a person's language, from gettext's catalogues; English is the source.

A further language is a file `locales/LANGUAGE/LC_MESSAGES/cell.po`.  Its messages may have places
for values, see `sentences`.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path

from cell.web.sentences import Sentences

#: A message in English → in the language of whoever looks.
Translate = Callable[[str], str]

_LOCALES = Path(__file__).parent / "locales"
_FILE = Path("LC_MESSAGES", "cell.po")
SOURCE = "en"


def languages() -> tuple[str, ...]:
    """Languages that there are, English first."""
    found = sorted(p.name for p in _LOCALES.iterdir() if (p / _FILE).is_file())
    return (SOURCE, *(name for name in found if name != SOURCE))


def translation(language: str) -> Translate:
    """Function that translates a message or a sentence with values in it.

    What the catalogue lacks stays English, whole.
    """
    if language not in languages() or language == SOURCE:
        return str
    return sentences(language)


@lru_cache
def sentences(language: str) -> Sentences:
    """Messages and sentences of a language.  Raises OSError: there is none."""
    entries = _entries((_LOCALES / language / _FILE).read_text(encoding="utf-8"))
    decimal = re.search(r"^X-Decimal: *(\S)", entries.pop("", ""), re.MULTILINE)
    return Sentences(entries, decimal[1] if decimal else ".")


@lru_cache
def catalogue(language: str) -> Mapping[str, str]:
    """Messages of a language's file.  Raises OSError: there is none."""
    return read_po((_LOCALES / language / _FILE).read_text(encoding="utf-8"))


def read_po(text: str) -> dict[str, str]:
    """Messages of a catalogue: msgid and msgstr, each of one or more quoted lines."""
    found = _entries(text)
    found.pop("", None)
    return found


def _entries(text: str) -> dict[str, str]:
    """Messages of a catalogue, and its head, whose msgid is empty."""
    found: dict[str, str] = {}
    parts = {"msgid": "", "msgstr": ""}
    key = ""
    for line in [*text.splitlines(), 'msgid ""']:
        match = re.fullmatch(r'(msgid|msgstr)?\s*("(?:[^"\\]|\\.)*")\s*', line)
        if match is None:
            continue
        if match[1] == "msgid":
            found[parts["msgid"]] = parts["msgstr"]
            parts = {"msgid": "", "msgstr": ""}
        key = match[1] or key
        parts[key] += ast.literal_eval(match[2])
    return found


def preferred(accepted: str) -> str:
    """The first language of an `Accept-Language` header that there is; else English."""
    known = languages()
    for part in accepted.split(","):
        name = part.split(";")[0].strip().lower().split("-")[0]
        if name in known:
            return name
    return SOURCE
