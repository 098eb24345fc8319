"""`cell help`: the documentation, also where only the wheel is installed."""

from __future__ import annotations

import sys
import sysconfig
from pathlib import Path
from typing import Annotated

import typer

from cell.cli.shared import group, refuse

app = group()
_INSTALLED = Path("share", "doc", "cable-cell")
#: Where `make docs-site` and wheels have the manual for browsers.
_SITE = Path(__file__).resolve().parents[1] / "manual"
#: Folders of the documentation, in the order in which they are read.
_PARTS = ("start", "howto", "explain", "reference")


@app.command("help")
def help_(
    topic: Annotated[
        str | None, typer.Argument(help="A topic; without one all are listed.", show_default=False)
    ] = None,
    browser: Annotated[
        bool, typer.Option("--browser", help="Open the manual in a browser, at the topic.")
    ] = False,
) -> None:
    """Show what the manual says of a topic, or list the topics.

    Exit codes: 0; 2 if there is no such topic, or no manual for a browser.
    """
    from difflib import get_close_matches

    from rich.console import Console
    from rich.markdown import Markdown

    pages = topics()
    if topic is None and browser:
        _open(_SITE / "index.html")
        return
    if topic is None:
        width = max(map(len, pages), default=0)
        for name, path in pages.items():
            print(f"cell help {name:{width}s}  {_title(path)}")
        return
    page = pages.get(topic.lower())
    if page is None:
        near = get_close_matches(topic.lower(), pages, 1)
        meant = f"did you mean {near[0]!r}? " if near else ""
        refuse(ValueError(f"{topic}: no topic; {meant}`cell help` lists them"))
    if browser:
        _open(_SITE / page.relative_to(_folder()).with_suffix(".html"))
        return
    text = page.read_text(encoding="utf-8")
    if not sys.stdout.isatty():
        print(text)
        return
    console = Console()
    with console.pager(styles=True):
        console.print(Markdown(text))


def _open(page: Path) -> None:
    """A page of the manual in the user's browser; its address is printed as well."""
    import webbrowser

    if not page.exists():
        refuse(ValueError(f"{page}: the manual is not built here; `make docs-site` builds it"))
    print(page.as_uri())
    webbrowser.open(page.as_uri())


def topics() -> dict[str, Path]:
    """Pages of the documentation by their names, in the order of reading."""
    folder = _folder()
    pages = (page for part in ("", *_PARTS) for page in sorted((folder / part).glob("*.md")))
    return {page.stem: page for page in pages}


def _folder() -> Path:
    """Where the pages are: in a clone, or where a wheel put them."""
    clone = Path(__file__).resolve().parents[2] / "docs"
    return clone if clone.is_dir() else Path(sysconfig.get_path("data")) / _INSTALLED


def _title(page: Path) -> str:
    """The heading of a page."""
    with page.open(encoding="utf-8") as file:
        return file.readline().lstrip("# ").strip()
