"""The files in `docs/decisions`: short, of one form, and each in the index."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "docs" / "decisions"
FILES = sorted(p for p in FOLDER.glob("*.md") if p.name != "README.md")
MOST_FILES, MOST_WORDS = 45, 110
_ENTRY = re.compile(r"^- \[(\d+\. [^\]]+)\]\(([^)]+)\)$", re.MULTILINE)


def index() -> list[tuple[str, str]]:
    """Title and file of every line of the index."""
    return _ENTRY.findall((FOLDER / "README.md").read_text(encoding="utf-8"))


def test_there_are_few_each_with_a_number_of_its_own() -> None:
    assert 0 < len(FILES) <= MOST_FILES
    numbers = [path.name[:3] for path in FILES]
    assert len(numbers) == len(set(numbers))


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_a_decision_is_short_and_has_three_sections(path: Path) -> None:
    assert re.fullmatch(r"\d{3}(-[a-z0-9]+)+\.md", path.name)
    text = path.read_text(encoding="utf-8")
    assert len(text.split()) <= MOST_WORDS
    title, *sections = re.split(r"^## ", text, flags=re.MULTILINE)
    assert re.fullmatch(rf"# {int(path.name[:3])}\. \S.*\n+", title)
    assert [s.partition("\n")[0] for s in sections] == ["Context", "Decision", "Consequences"]
    assert all(s.partition("\n")[2].strip() for s in sections)


def test_the_index_has_every_decision_once_under_its_title() -> None:
    titles = {p.name: p.read_text(encoding="utf-8").partition("\n")[0] for p in FILES}
    assert sorted(file for _, file in index()) == sorted(titles)
    assert {file: f"# {title}" for title, file in index()} == titles
