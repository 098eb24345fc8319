"""The manual stays short, tells no history, and uses the field's terms."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
MOST_WORDS, MOST_OF_CHANGELOG = 33_000, 1_500
_COMMIT = re.compile(r"\b(?=[0-9a-f]*[a-f])(?=[0-9a-f]*[0-9])(?<![.\d])[0-9a-f]{7,40}\b")
#: Words of before, and the terms that took their place.
_REPLACED = {"mouth": "opening", "beside": "next to, with", "foretold": "predicted"}


def test_the_manual_is_short() -> None:
    changes = len((ROOT / "CHANGELOG.md").read_text(encoding="utf-8").split())
    words = sum(len(page.read_text(encoding="utf-8").split()) for page in PAGES)
    assert changes <= MOST_OF_CHANGELOG
    assert words + changes <= MOST_WORDS


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_a_page_names_no_commit_and_no_word_of_before(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    prose = re.sub(r"```.*?```|`[^`]*`|^ {4,}.*$|\]\([^)]*\)", "", text, flags=re.DOTALL | re.M)
    assert _COMMIT.findall(prose) == []
    found = [w for w in _REPLACED if re.search(rf"\b{w}s?\b", prose, re.IGNORECASE)]
    assert found == [], {w: _REPLACED[w] for w in found}
