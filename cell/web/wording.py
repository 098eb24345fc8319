"""Words of the pages in a person's language, from gettext's catalogues; English is the source.

A further language is a file `locales/LANGUAGE/LC_MESSAGES/cell.po`.  Its messages may have places
for values:

    {name}            any text, which is said as it is
    {name:number}     a number, said with the decimal sign of the language
    {name:sentence}   a sentence or word of the catalogue, said as it is if the catalogue lacks it
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

#: A longer text stays as it is, characters; so does one of more sentences or deeper ones.
LONGEST, MOST_SENTENCES, DEEPEST = 2000, 12, 18
#: So many parts of a text are looked up.
MOST_LOOKUPS = 300
#: So many texts are remembered with what they are in the language.
REMEMBERED = 1024

_PLACE = re.compile(r"\{([a-z_]+)(?::(number|sentence))?\}")
_NUMBER = r"[+\-−]?(?:\d{1,18}(?:\.\d{1,18})?(?:e[+\-]?\d{1,3})?|nan|inf)"
#: Between sentences of one text.
_BETWEEN = re.compile(r"; |\. |\n")


@dataclass(frozen=True)
class Placeholder:
    """A place for a value: `kind` is "", "number" or "sentence"."""

    name: str
    kind: str


def parts_of(message: str) -> Iterator[str | Placeholder]:
    """Texts and places of a message, in their order."""
    end = 0
    for found in _PLACE.finditer(message):
        if found.start() > end:
            yield message[end : found.start()]
        yield Placeholder(found[1], found[2] or "")
        end = found.end()
    if end < len(message):
        yield message[end:]


@dataclass(frozen=True)
class Template:
    """A message with placeholders, and its translation."""

    message: str
    translated: str

    @cached_property
    def parts(self) -> tuple[str | Placeholder, ...]:
        """Of the message."""
        return tuple(parts_of(self.message))

    @cached_property
    def translated_parts(self) -> tuple[str | Placeholder, ...]:
        """Of what it is in the language."""
        return tuple(parts_of(self.translated))

    @cached_property
    def literal(self) -> int:
        """How many characters are not those of values."""
        return sum(len(p) for p in self.parts if isinstance(p, str))

    @cached_property
    def longest(self) -> str:
        """Its longest text between values: what lacks it need not be matched."""
        return max((p for p in self.parts if isinstance(p, str)), key=len, default="")

    @cached_property
    def pattern(self) -> re.Pattern[str]:
        """Matches its sentences.

        A value that is any text ends where what follows it is found first, and is never tried
        longer: an atomic group. So no sentence takes long, whatever its values are.
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
        """Values of a text that is a sentence of this template; None = it is none."""
        if self.longest not in text:
            return None
        found = self.pattern.match(text)
        return None if found is None else found.groupdict()


@dataclass(frozen=True)
class Translation:
    """A translated text, and how well its message matched.

    literal       number of its characters that belong to the message, not to values
    untranslated  values that stay as they are, except numbers
    """

    literal: int
    text: str
    untranslated: tuple[str, ...] = ()


class Sentences:
    """Translates texts by the messages of a catalogue; unknown texts stay as they are.

    decimal  decimal sign of the language
    """

    def __init__(self, known: Mapping[str, str], decimal: str = ".") -> None:
        self._known = {message: said for message, said in known.items() if message and said}
        self._decimal = decimal
        made = [Template(m, said) for m, said in self._known.items() if _PLACE.search(m)]
        self._templates = sorted(made, key=lambda t: -t.literal)
        self._remembered = lru_cache(REMEMBERED)(self.find)

    def __call__(self, text: str) -> str:
        """A text in the language."""
        if (said := self._known.get(text)) is not None:
            return said
        if len(text) > LONGEST:
            return text
        found = self._remembered(text)
        return text if found is None else found.text

    def find(self, text: str) -> Translation | None:
        """A text in the language; None = a sentence of it is unknown, and nothing is translated."""
        return _Search(self._known, self._templates, self._decimal).text(text)


class _Search:
    """One text that is looked up, with all of its parts."""

    def __init__(self, known: Mapping[str, str], templates: list[Template], decimal: str) -> None:
        self._known, self._templates, self._decimal = known, templates, decimal
        self._single: dict[str, Translation | None] = {}
        self._texts: dict[str, Translation | None] = {}
        self._depth = 0

    def text(self, text: str) -> Translation | None:
        """One sentence, or some: what has the most characters that are not those of values."""
        if text not in self._texts:
            self._texts[text] = None
            if self._depth < DEEPEST:
                self._depth += 1
                self._texts[text] = _most(self._joined(text), self._sentence(text))
                self._depth -= 1
        return self._texts[text]

    def _sentence(self, text: str) -> Translation | None:
        """One sentence, not taken apart."""
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
                best = _most(best, self._translated(template, values))
        self._single[text] = best
        return best

    def _translated(self, template: Template, values: Mapping[str, str]) -> Translation:
        literal, said = template.literal, dict(values)
        kept: tuple[str, ...] = ()
        for place in (p for p in template.parts if isinstance(p, Placeholder)):
            value = values[place.name]
            if place.kind == "number":
                said[place.name] = value.replace(".", self._decimal)
            elif place.kind == "sentence" and (found := self.text(value)) is not None:
                said[place.name] = found.text
                literal, kept = literal + found.literal, kept + found.untranslated
            else:
                kept += (value,)
        parts = (p if isinstance(p, str) else said[p.name] for p in template.translated_parts)
        return Translation(literal, "".join(parts), kept)

    def _joined(self, text: str) -> Translation | None:
        """The first sentence, and the rest."""
        best: Translation | None = None
        places = list(_BETWEEN.finditer(text))
        for between in places if len(places) < MOST_SENTENCES else ():
            first = self._sentence(text[: between.start()])
            rest = None if first is None else self.text(text[between.end() :])
            if first is not None and rest is not None:
                said = f"{first.text}{between[0]}{rest.text}"
                literal = first.literal + len(between[0]) + rest.literal
                best = _most(
                    best, Translation(literal, said, first.untranslated + rest.untranslated)
                )
        return best


def _most(one: Translation | None, other: Translation | None) -> Translation | None:
    if one is None or other is None:
        return one or other
    return other if other.literal > one.literal else one


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
    entries = catalogue(language)
    decimal = re.search(r"^X-Decimal: *(\S)", entries.get("", ""), re.MULTILINE)
    return Sentences(entries, decimal[1] if decimal else ".")


def catalogue(language: str) -> dict[str, str]:
    """Messages of a language's file, and its head, whose msgid is empty.  Raises OSError."""
    return read_po((_LOCALES / language / _FILE).read_text(encoding="utf-8"))


def read_po(text: str) -> dict[str, str]:
    """Messages of a catalogue: msgid and msgstr, each of one or more quoted lines."""
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
