"""Settings of Sphinx for the manual; `build.py` runs it on a copy of docs."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from latex2mathml.converter import convert

project = "Cable cell"
html_title = "Cable cell"
extensions = ["myst_parser"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
html_theme = "furo"
html_copy_source = False
html_show_copyright = False
html_show_sphinx = False
pygments_style = "friendly"
# Quotation marks and ellipses only: a dash in place of `--` makes options that no shell takes.
smartquotes_action = "qe"
# Blocks of shells and of what they print are of no language that a lexer knows.
highlight_language = "text"
# GitHub's anchors are used in all links; a page that is on no list is reached by search.
suppress_warnings = ["myst.header", "toc.excluded", "toc.not_included"]


def _write_formula(display: str) -> Any:
    """Browsers draw MathML themselves: no script, no network."""

    def visit(translator: Any, node: nodes.Element) -> None:
        formula = convert(node.astext(), display=display)
        translator.body.append(
            f'<div style="overflow: auto hidden; padding: 0.4em 0">{formula}</div>'
            if display == "block"
            else formula
        )
        raise nodes.SkipNode

    return visit


def setup(app: Any) -> None:
    """Register the writers of formulas; Sphinx calls this."""
    app.add_node(nodes.math, override=True, html=(_write_formula("inline"), None))
    app.add_node(nodes.math_block, override=True, html=(_write_formula("block"), None))
