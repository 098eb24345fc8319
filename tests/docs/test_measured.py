"""Measured results: each file of them is complete, and the page and the plots agree with it."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib as mpl
import pytest

from tests.docs.test_tables import DOCS, MEASURED, read
from tools.figures.measured_plots import FOLDER, PLOTS, draw

PAGE = (DOCS / "validation.md").read_text(encoding="utf-8")
#: How and when each row was measured.
ORIGIN = {"measured_on", "machine", "load", "command"}
#: Computed by a tool, the same on every computer.
COMPUTED = {"effect_confusions"}
#: A figure, and after it file:condition:column (_ a space, @ a colon; `a/b`: percent of b).
FIGURE = re.compile(r"([\d.,]+)(?: [^\s<]+)?<!--([a-z_]+):([^:>]+):([A-Za-z_0-9/]+)-->")


@pytest.mark.parametrize("path", MEASURED, ids=lambda p: p.name)
def test_every_measured_row_says_when_where_and_by_which_command(path: Path) -> None:
    if path.stem in COMPUTED:
        return
    head, *rows = read(path)
    assert set(head) >= ORIGIN
    for name in ORIGIN:
        assert all(row[head.index(name)] for row in rows), name


def test_what_repeats_a_row_is_there() -> None:
    """A study that is removed leaves rows that nobody can measure again: they must say so."""
    makefile = (DOCS.parent / "Makefile").read_text(encoding="utf-8")
    absent = []
    for path in MEASURED:
        head, *rows = read(path)
        commands = {row[head.index("command")] for row in rows if "command" in head}
        for command in commands:
            for module in re.findall(r"python -m (\S+)", command):
                if not (DOCS.parent / f"{module.replace('.', '/')}.py").exists():
                    absent.append(f"{path.name}: {command}")
            for target in re.findall(r"make ([\w-]+)", command):
                if not re.search(rf"^{target}:", makefile, re.MULTILINE):
                    absent.append(f"{path.name}: {command}")
    assert absent == []


def figures() -> list[tuple[str, ...]]:
    return FIGURE.findall(PAGE)


@pytest.mark.parametrize("figure", figures(), ids=lambda f: ":".join(f[1:]))
def test_a_figure_in_a_sentence_is_that_of_its_file(figure: tuple[str, ...]) -> None:
    shown, file, condition, column = figure
    head, *rows = read(DOCS / "measured" / f"{file}.csv")
    wanted = condition.replace("_", " ").replace("@", ":").split("|")
    (row,) = (r for r in rows if r[: len(wanted)] == wanted)
    top, *bottom = (float(row[head.index(name)]) for name in column.split("/"))
    value = 100.0 * top / bottom[0] if bottom else top
    shown = shown.replace(",", "")
    assert f"{value:.{len(shown.partition('.')[2])}f}" == shown


def test_every_figure_of_the_page_is_recognised_and_appears_once() -> None:
    assert len(figures()) == PAGE.count("<!--") - PAGE.count("<!-- ")
    places = [figure[1:] for figure in figures()]
    assert len(set(places)) == len(places)


def test_the_page_shows_every_plot() -> None:
    shown = set(re.findall(r"images/measured/(\w+)\.svg", PAGE))
    assert shown == set(PLOTS) == {path.stem for path in FOLDER.glob("*.svg")}


def test_the_plots_are_drawn_from_the_files_as_they_are(tmp_path: Path) -> None:
    draw(tmp_path)
    for path in sorted(FOLDER.glob("*.svg")):
        assert path.stat().st_size <= 40 * 1024
        before, now = (p.read_text(encoding="utf-8") for p in (path, tmp_path / path.name))
        assert labels(now) == labels(before), path.name
        if f"Matplotlib v{mpl.__version__}" in before:
            assert numbered(now) == numbered(before), path.name


def numbered(svg: str) -> str:
    """The drawing with its names of clip paths, hashes of unrounded numbers, as 0, 1, 2 …"""
    names = list(dict.fromkeys(re.findall(r"\bp[0-9a-f]{10}\b", svg)))
    return re.sub(r"\bp[0-9a-f]{10}\b", lambda found: str(names.index(found[0])), svg)


def labels(svg: str) -> list[str]:
    """All text of a picture."""
    return re.findall(r"<text[^>]*>([^<]*)</text>", svg)
