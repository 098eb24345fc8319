"""Builds the manual as a site that needs no network.

    python -m tools.site.build [-o cell/manual]

Pages are those of docs.  Text between `<!-- generated: commands -->` and `<!-- end -->` is replaced
by that reference (`references.py`); a link to a file outside docs is replaced by its text.  A
notebook becomes a page: its text, code and printed results.
Warnings, dead links among them, are errors.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import tempfile
from pathlib import Path

from sphinx.cmd.build import build_main

from tools.site.references import REFERENCES

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
#: Parts of the manual in the order of its navigation: caption, pages without suffix.
PARTS = {
    "Start": ("start/simulated_cell", "start/own_measurements", "start/*"),
    "How to": (
        *("howto/commission", "howto/calibrate", "howto/shift", "howto/pages"),
        *("howto/recordings", "howto/insertion", "howto/lab", "howto/import", "howto/*"),
    ),
    "Explain": ("explain/model", "explain/cycle", "explain/diagnosis", "explain/*"),
    "Reference": ("reference/*",),
    "Results": ("validation", "decisions/README"),
}
_GENERATED = re.compile(r"<!-- generated: (\w+) -->.*?<!-- end -->", re.DOTALL)
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")


def navigation() -> str:
    """Lists of pages for Sphinx, which `index.md` ends with."""
    lists = (
        "```{toctree}\n:hidden:\n:glob:\n:caption: " + f"{caption}\n\n" + "\n".join(pages) + "\n```"
        for caption, pages in PARTS.items()
    )
    return "\n\n".join(lists)


def prepared(page: Path, text: str) -> str:
    """Text of a page of docs, with its references and without links to files outside the site.

    raises  KeyError: there is no such reference
    """

    def link(match: re.Match[str]) -> str:
        image, shown, target = match.groups()
        if image or re.match(r"[a-z]+:|#", target):
            return match[0]
        path = (page.parent / target.partition("#")[0]).resolve()
        if not path.is_relative_to(DOCS.resolve()) or path.suffix not in (".md", ".ipynb"):
            return shown
        return match[0].replace(".ipynb)", ".md)")

    text = _GENERATED.sub(lambda match: REFERENCES[match[1]](), text)
    return _LINK.sub(link, text)


def notebook_page(notebook: Path) -> str:
    """A notebook as the text of a page: its prose, code and printed results."""
    parts = []
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            kind = "{raw} html" if "text/html" in data else "text"
            shown = data.get("text/html") or output.get("text") or data.get("text/plain", ())
            parts.append(f"```{kind}\n{''.join(shown)}\n```")
    return "\n\n".join(parts) + "\n"


def build(target: Path, folder: Path) -> int:
    """Write the site to a folder, which is replaced; `folder` is for intermediate files.

    returns  code of Sphinx, 0 = built without a warning
    """
    source, html = folder / "docs", folder / "html"
    shutil.copytree(DOCS, source, ignore=shutil.ignore_patterns("*.ipynb", "*.csv"))
    for notebook in DOCS.rglob("*.ipynb"):
        page = (source / notebook.relative_to(DOCS)).with_suffix(".md")
        page.write_text(notebook_page(notebook), encoding="utf-8")
    for page in source.rglob("*.md"):
        original = DOCS / page.relative_to(source)
        text = prepared(original, page.read_text(encoding="utf-8"))
        if page == source / "index.md":
            text += "\n\n" + navigation() + "\n"
        page.write_text(text, encoding="utf-8")
    words = ["-q", "-W", "--keep-going", "-b", "html", "-c", str(Path(__file__).parent)]
    code = build_main([*words, str(source), str(html)])
    if code == 0:
        shutil.rmtree(html / ".doctrees", ignore_errors=True)
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(html, target)
    return code


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "cell" / "manual")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        code = build(arguments.out, Path(scratch))
    if code == 0:
        print(f"{arguments.out / 'index.html'}")
    raise SystemExit(code)
