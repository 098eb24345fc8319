"""Translations of the pages' texts, from gettext's catalogues; English is the source.

A new text needs an entry in `locales/de/LC_MESSAGES/cell.po`, and that of a new class of errors one
in `tests/cell/web/sentences.py`.  A further language is a file
`locales/LANGUAGE/LC_MESSAGES/cell.po`.  Its messages may have placeholders for values:

    {name}            any text, which is not translated
    {name:number}     a number, with the decimal sign of the language
    {name:sentence}   a sentence or word of the catalogue, unchanged if the catalogue lacks it
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

#: Limits of a translated text: characters, sentences and depth; larger ones stay unchanged.
LONGEST, MOST_SENTENCES, DEEPEST = 2000, 12, 18
#: Number of parts of a text that are looked up.
MOST_LOOKUPS = 300
#: Number of cached translations.
REMEMBERED = 1024

_PLACE = re.compile(r"\{([a-z_]+)(?::(number|sentence))?\}")
_NUMBER = r"[+\-−]?(?:\d{1,18}(?:\.\d{1,18})?(?:e[+\-]?\d{1,3})?|nan|inf)"
#: Between sentences of one text.
_BETWEEN = re.compile(r"; |\. |\n")


@dataclass(frozen=True)
class Placeholder:
    """A placeholder for a value: `kind` is "", "number" or "sentence"."""

    name: str
    kind: str


def parts_of(message: str) -> Iterator[str | Placeholder]:
    """Texts and placeholders of a message, in their order."""
    end = 0
    for matched in _PLACE.finditer(message):
        if matched.start() > end:
            yield message[end : matched.start()]
        yield Placeholder(matched[1], matched[2] or "")
        end = matched.end()
    if end < len(message):
        yield message[end:]


@dataclass(frozen=True)
class Template:
    """A message with placeholders, and its translation."""

    message: str
    translated: str

    @cached_property
    def parts(self) -> tuple[str | Placeholder, ...]:
        """Parts of the message."""
        return tuple(parts_of(self.message))

    @cached_property
    def literal(self) -> int:
        """Number of characters outside placeholders."""
        return sum(len(p) for p in self.parts if isinstance(p, str))

    @cached_property
    def longest(self) -> str:
        """Its longest text between placeholders, which every matching text contains."""
        return max((p for p in self.parts if isinstance(p, str)), key=len, default="")

    @cached_property
    def pattern(self) -> re.Pattern[str]:
        """Regular expression of its sentences.

        A value of any text ends at the first match of the following text, without backtracking:
        an atomic group. So the time of a match is bounded for all values.
        """
        made: list[str] = []
        opened = False
        for part in self.parts:
            if isinstance(part, str):
                made.append(re.escape(part))
            elif part.kind == "number":
                made.append(f"(?P<{part.name}>{_NUMBER})")
            else:
                made.append(f"{')' if opened else ''}(?>(?P<{part.name}>.*?)")
                opened = True
        return re.compile("".join([*made, r"\Z", ")" if opened else ""]), re.DOTALL)

    def values(self, text: str) -> Mapping[str, str] | None:
        """Values of the placeholders in a text; None = it does not match this template."""
        if self.longest not in text:
            return None
        matched = self.pattern.match(text)
        return None if matched is None else matched.groupdict()


@dataclass(frozen=True)
class Translation:
    """A translated text, and the quality of the match.

    literal       number of its characters that belong to the message, not to values
    untranslated  values that are not translated, except numbers
    """

    literal: int
    text: str
    untranslated: tuple[str, ...] = ()


class Sentences:
    """Translates texts by the messages of a catalogue; unknown texts stay as they are.

    decimal  decimal sign of the language
    """

    def __init__(self, known: Mapping[str, str], decimal: str = ".") -> None:
        self._known = {message: text for message, text in known.items() if message and text}
        self._decimal = decimal
        made = [Template(m, text) for m, text in self._known.items() if _PLACE.search(m)]
        self._templates = sorted(made, key=lambda t: -t.literal)
        self._remembered = lru_cache(REMEMBERED)(self.find)

    def __call__(self, text: str) -> str:
        """Translation of a text."""
        if (translated := self._known.get(text)) is not None:
            return translated
        if len(text) > LONGEST:
            return text
        result = self._remembered(text)
        return text if result is None else result.text

    def find(self, text: str) -> Translation | None:
        """Translation of a text; None = one of its sentences is unknown."""
        return _Search(self._known, self._templates, self._decimal).text(text)


class _Search:
    """Search for the translation of one text, with all of its parts."""

    def __init__(self, known: Mapping[str, str], templates: list[Template], decimal: str) -> None:
        self._known, self._templates, self._decimal = known, templates, decimal
        self._single: dict[str, Translation | None] = {}
        self._texts: dict[str, Translation | None] = {}
        self._depth = 0

    def text(self, text: str) -> Translation | None:
        """Translation of one or several sentences with the most literal characters."""
        if text not in self._texts:
            self._texts[text] = None
            if self._depth < DEEPEST:
                self._depth += 1
                self._texts[text] = _most(self._split_text(text), self._sentence(text))
                self._depth -= 1
        return self._texts[text]

    def _sentence(self, text: str) -> Translation | None:
        """Translation of one sentence, not split."""
        if text in self._known:
            return Translation(len(text), self._known[text])
        if text in self._single:
            return self._single[text]
        if len(self._single) >= MOST_LOOKUPS:
            return None
        best: Translation | None = None
        self._single[text] = None
        for template in self._templates:
            if (values := template.values(text)) is not None:
                best = _most(best, self._translate(template, values))
        self._single[text] = best
        return best

    def _translate(self, template: Template, values: Mapping[str, str]) -> Translation:
        literal, texts = template.literal, dict(values)
        untranslated: tuple[str, ...] = ()
        for place in (p for p in template.parts if isinstance(p, Placeholder)):
            value = values[place.name]
            if place.kind == "number":
                texts[place.name] = value.replace(".", self._decimal)
            elif place.kind == "sentence" and (part := self.text(value)) is not None:
                texts[place.name] = part.text
                literal, untranslated = literal + part.literal, untranslated + part.untranslated
            else:
                untranslated += (value,)
        translated = _PLACE.sub(lambda place: texts[place[1]], template.translated)
        return Translation(literal, translated, untranslated)

    def _split_text(self, text: str) -> Translation | None:
        """Translation of the first sentence, and of the rest."""
        best: Translation | None = None
        places = list(_BETWEEN.finditer(text))
        for between in places if len(places) < MOST_SENTENCES else ():
            first = self._sentence(text[: between.start()])
            rest = None if first is None else self.text(text[between.end() :])
            if first is not None and rest is not None:
                joined = f"{first.text}{between[0]}{rest.text}"
                literal = first.literal + len(between[0]) + rest.literal
                best = _most(
                    best, Translation(literal, joined, first.untranslated + rest.untranslated)
                )
        return best


def _most(first: Translation | None, second: Translation | None) -> Translation | None:
    if first is None or second is None:
        return first or second
    return second if second.literal > first.literal else first


#: A message in English → in the language of the page.
Translate = Callable[[str], str]

_LOCALES = Path(__file__).parent / "locales"
_FILE = Path("LC_MESSAGES", "cell.po")
SOURCE = "en"


def languages() -> tuple[str, ...]:
    """Available languages, English first."""
    available = sorted(p.name for p in _LOCALES.iterdir() if (p / _FILE).is_file())
    return (SOURCE, *(name for name in available if name != SOURCE))


def translation(language: str) -> Translate:
    """Function that translates a message or a sentence with values in it.

    A text that the catalogue lacks stays English as a whole.
    """
    if language not in languages() or language == SOURCE:
        return str
    return sentences(language)


@lru_cache
def sentences(language: str) -> Sentences:
    """Messages and sentences of a language.  Raises OSError: there is none."""
    entries = catalogue(language)
    decimal = re.search(r"^X-Decimal: *(\S)", entries.get("", ""), re.MULTILINE)
    return Sentences(entries, decimal[1] if decimal else ".")


def catalogue(language: str) -> dict[str, str]:
    """Messages of a language's file, and its head, whose msgid is empty.  Raises OSError."""
    return read_po((_LOCALES / language / _FILE).read_text(encoding="utf-8"))


def read_po(text: str) -> dict[str, str]:
    """Messages of a catalogue: msgid and msgstr, each of one or more quoted lines."""
    messages: dict[str, str] = {}
    parts = {"msgid": "", "msgstr": ""}
    key = ""
    for line in [*text.splitlines(), 'msgid ""']:
        match = re.fullmatch(r'(msgid|msgstr)?\s*("(?:[^"\\]|\\.)*")\s*', line)
        if match is None:
            continue
        if match[1] == "msgid":
            messages[parts["msgid"]] = parts["msgstr"]
            parts = {"msgid": "", "msgstr": ""}
        key = match[1] or key
        parts[key] += ast.literal_eval(match[2])
    return messages


def preferred(accepted: str) -> str:
    """The first available language of an `Accept-Language` header; else English."""
    known = languages()
    for part in accepted.split(","):
        name = part.split(";")[0].strip().lower().split("-")[0]
        if name in known:
            return name
    return SOURCE
