"""Words of the pages: every message of the source is in every catalogue."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import cell.web
from cell.web.wording import catalogue, languages, preferred, read_po, translation

FOLDER = Path(cell.web.__file__).parent


def messages() -> set[str]:
    """Constants that are given to a function that translates or marks."""
    found = set()
    for file in FOLDER.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            name = node.func.attr if isinstance(node.func, ast.Attribute) else ""
            name = node.func.id if isinstance(node.func, ast.Name) else name
            if name in ("t", "_t", "N_") and isinstance(node.args[0], ast.Constant):
                found.add(node.args[0].value)
    return found


@pytest.mark.parametrize("language", languages()[1:])
def test_a_catalogue_has_every_message_of_the_source(language: str) -> None:
    known = catalogue(language)
    assert messages() - {m for m, said in known.items() if said} == set()


def test_a_catalogue_is_read_with_long_and_quoted_messages() -> None:
    text = 'msgid ""\nmsgstr "head\\n"\n# said\nmsgid "a \\"b\\""\nmsgstr ""\n"c"\n" d"\n'
    assert read_po(text) == {'a "b"': "c d"}


def test_the_language_is_the_first_that_there_is() -> None:
    assert preferred("fr, de-CH;q=0.9, en;q=0.8") == "de"
    assert preferred("") == "en"
    assert translation("de")("Stop") == "Stopp"
    assert translation("xx/../de")("Stop") == "Stop"
