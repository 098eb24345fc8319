"""Sentences that the program makes, with values in them, in the language of a catalogue.

A message of a catalogue may have places for values:

    {name}            any text, which is said as it is
    {name:number}     a number, said with the decimal sign of the language
    {name:sentence}   a sentence or word of the catalogue, said as it is if the catalogue lacks it
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache

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
    """A message with places, and what it is in the language."""

    message: str
    said: str

    @cached_property
    def parts(self) -> tuple[str | Placeholder, ...]:
        """Of the message."""
        return tuple(parts_of(self.message))

    @cached_property
    def said_parts(self) -> tuple[str | Placeholder, ...]:
        """Of what it is in the language."""
        return tuple(parts_of(self.said))

    @cached_property
    def kinds(self) -> Mapping[str, str]:
        """Kind of each place by its name."""
        return {p.name: p.kind for p in self.parts if isinstance(p, Placeholder)}

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
class Found:
    """How a text is said.

    literal  so many of its characters are not those of values
    kept     values that are said as they are, numbers apart
    """

    literal: int
    said: str
    kept: tuple[str, ...] = ()


class Sentences:
    """Messages of a catalogue; a call translates a text, and says it as it is if it is unknown.

    decimal  sign of the language
    """

    def __init__(self, known: Mapping[str, str], decimal: str = ".") -> None:
        self._known = {message: said for message, said in known.items() if said}
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
        return text if found is None else found.said

    def find(self, text: str) -> Found | None:
        """A text in the language; None = a sentence of it is unknown, and nothing is translated."""
        return _Search(self._known, self._templates, self._decimal).text(text)


class _Search:
    """One text that is looked up, with all of its parts."""

    def __init__(self, known: Mapping[str, str], templates: list[Template], decimal: str) -> None:
        self._known, self._templates, self._decimal = known, templates, decimal
        self._single: dict[str, Found | None] = {}
        self._texts: dict[str, Found | None] = {}
        self._depth = 0

    def text(self, text: str) -> Found | None:
        """One sentence, or some: what has the most characters that are not those of values."""
        if text not in self._texts:
            self._texts[text] = None
            if self._depth < DEEPEST:
                self._depth += 1
                self._texts[text] = _most(self._joined(text), self._sentence(text))
                self._depth -= 1
        return self._texts[text]

    def _sentence(self, text: str) -> Found | None:
        """One sentence, not taken apart."""
        if text in self._known:
            return Found(len(text), self._known[text])
        if text in self._single:
            return self._single[text]
        if len(self._single) >= MOST_LOOKUPS:
            return None
        best: Found | None = None
        self._single[text] = None
        for template in self._templates:
            if (values := template.values(text)) is not None:
                best = _most(best, self._said(template, values))
        self._single[text] = best
        return best

    def _said(self, template: Template, values: Mapping[str, str]) -> Found:
        literal, said = template.literal, dict(values)
        kept: tuple[str, ...] = ()
        for name, kind in template.kinds.items():
            if kind == "number":
                said[name] = values[name].replace(".", self._decimal)
            elif kind == "sentence" and (found := self.text(values[name])) is not None:
                said[name], literal, kept = found.said, literal + found.literal, kept + found.kept
            else:
                kept += (values[name],)
        parts = (p if isinstance(p, str) else said[p.name] for p in template.said_parts)
        return Found(literal, "".join(parts), kept)

    def _joined(self, text: str) -> Found | None:
        """The first sentence, and the rest."""
        best: Found | None = None
        places = list(_BETWEEN.finditer(text))
        for between in places if len(places) < MOST_SENTENCES else ():
            first = self._sentence(text[: between.start()])
            rest = None if first is None else self.text(text[between.end() :])
            if first is not None and rest is not None:
                said = f"{first.said}{between[0]}{rest.said}"
                literal = first.literal + len(between[0]) + rest.literal
                best = _most(best, Found(literal, said, first.kept + rest.kept))
        return best


def _most(one: Found | None, other: Found | None) -> Found | None:
    if one is None or other is None:
        return one or other
    return other if other.literal > one.literal else one
