"""The manual's references are complete, and its pages are linked to what a site has.

The site as a whole, with every link followed, is built by the target `docs-site`.
"""

from __future__ import annotations

import re

import pytest
from typer.main import get_command

import cell
from cell.cli import app
from cell.settings.entries import entries
from tools.site import references
from tools.site.build import DOCS, notebook_page, prepared


def test_every_command_and_option_is_in_the_reference() -> None:
    text = references.commands()
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        assert f"\n### cell {name}\n" in f"\n{text}"
        for sub, inner in getattr(command, "commands", {"": command}).items():
            part = text.split(f"### cell {name} {sub}".strip() + "\n")[1].split("\n### ")[0]
            options = [o for p in inner.params if not p.hidden for o in p.opts if o[0] == "-"]
            assert [o for o in options if f"`{o}`" not in part and o != "--help"] == [], name


def test_every_setting_is_in_the_reference_with_its_limits_and_default() -> None:
    text = references.settings()
    assert [e.name for e in entries({}) if f"- `{e.name}`" not in text] == []
    for wanted in (
        "`arm.host` (required",
        "`camera.serial",
        "`camera.view.origin_row_px`",
        "`plant.opcua.port`",
    ):
        assert wanted in text
    line = next(x for x in text.splitlines() if x.startswith("- `motion.still_s`"))
    assert re.match(r"- `motion.still_s` \(s; > 0, ≤ 30; default `0.2`; e.g. `0.4`\): \w", line)
    assert len({line for line in text.splitlines() if line.startswith("- `")}) > 230


def test_every_check_and_public_name_is_in_the_reference() -> None:
    text = references.checks()
    assert [c.name for c in references.DATA_CHECKS if f"`{c.name}`" not in text] == []
    text = references.api()
    assert [name for name in cell.__all__ if f"### {name}\n" not in text] == []
    assert "gravity_m_per_s2: tuple[float, float] = (0.0, -9.81)" in text
    for wanted in ("Diagnosis", "MissingEffect", "Frame", "DeviceLostError", "PluggedCamera"):
        assert f"### {wanted}\n" in text
    assert "#### Camera.frame_rate_hz\n\nFrame rate" in text
    assert "- `lost_after_s` (default `0.055`): Time" in text
    assert "0x" not in text


def test_every_warning_that_the_lab_gives_is_listed() -> None:
    """A code that no table has would be met by a reader who finds nothing of it."""
    source = (DOCS.parent / "cell/lab/verdict/doubts.py").read_text(encoding="utf-8")
    codes = set(re.findall(r'Doubt\(\s*"(\w+)"', source))
    listed = references.diagnosis_checks()
    assert codes
    assert all(f"`{code}`" in listed for code in codes)


@pytest.mark.parametrize(
    ("link", "kept"),
    [
        ("[a](../index.md)", "[a](../index.md)"),
        ("[a](../index.md#where-to-begin)", "[a](../index.md#where-to-begin)"),
        ("[a](#here)", "[a](#here)"),
        ("[`a`](../../config/fake.yaml)", "`a`"),
        ("![a](../images/cycle.jpg)", "![a](../images/cycle.jpg)"),
        ("[a](../start/notebook.ipynb)", "[a](../start/notebook.md)"),
        ("[a](https://example.org/b.md)", "[a](https://example.org/b.md)"),
    ],
)
def test_links_to_files_that_no_site_has_become_text(link: str, kept: str) -> None:
    assert prepared(DOCS / "howto" / "page.md", f"x {link} y") == f"x {kept} y"


def test_a_reference_takes_the_place_of_its_comment() -> None:
    text = "# A\n\n<!-- generated: checks -->\n\nnot here\n\n<!-- end -->\n\nafter\n"
    made = prepared(DOCS / "a.md", text)
    assert made.startswith("# A\n\n## Of a diagnosis") and made.endswith("\n\nafter\n")
    assert "not here" not in made


def test_the_notebook_is_a_page_with_code_and_results() -> None:
    page = notebook_page(DOCS / "start" / "notebook.ipynb")
    assert page.startswith("# The model lab in a notebook\n")
    assert "```python\nfrom pathlib import Path\n" in page
    assert "```text\n" in page and "```{raw} html\n" in page
