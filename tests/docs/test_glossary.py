"""The glossary is alphabetical, each term once, in one short line."""

from __future__ import annotations

import re

from tests.docs.test_tables import DOCS

TERMS = re.findall(
    r"^- \*\*(.+)\*\*: (.+)$", (DOCS / "reference" / "glossary.md").read_text("utf-8"), re.MULTILINE
)


def test_terms_are_in_alphabetical_order() -> None:
    names = [re.sub(r"[^a-z]", "", name.lower()) for name, _ in TERMS]
    assert names
    assert names == sorted(set(names))


def test_a_definition_has_at_most_fifteen_words() -> None:
    assert [name for name, text in TERMS if len(text.split()) > 15] == []
