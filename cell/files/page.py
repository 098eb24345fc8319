"""Self-contained HTML pages from templates, which escape their content.

A template extends `page.html`.  It shows tables, figures and pictures by the macros of
`parts.html`.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import plotly.graph_objects as go
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape
from numpy.typing import NDArray
from plotly.offline import get_plotlyjs

from cell.files.atomic import write_atomic
from cell.files.figure_style import least_px
from cell.files.table import TableData

_SHARED = Path(__file__).parent / "templates"


@dataclass(frozen=True)
class Plot:
    """A figure as data, and the size of its place on the page."""

    data: str
    height_px: int
    least_px: int

    @staticmethod
    def of(figure: go.Figure) -> Plot:
        """Of a plotly figure, whose JSON has no angle brackets that could end a script."""
        return Plot(str(figure.to_json()), int(figure.layout.height), least_px(figure))


@dataclass(frozen=True)
class PagePicture:
    """A picture within a page, as JPEG."""

    name: str
    base64: str

    @staticmethod
    def of(image: NDArray[Any], width_px: int, name: str) -> PagePicture:
        """Of an image, scaled to a width."""
        height = round(image.shape[0] * width_px / image.shape[1])
        small = cv2.resize(image, (width_px, height), interpolation=cv2.INTER_AREA)
        done, data = cv2.imencode(".jpg", small)
        assert done
        text = base64.b64encode(data.tobytes()).decode()
        return PagePicture(name.replace("_", " "), text)


def code(text: str) -> Markup:
    """A docstring's text as HTML, with text between backticks as code."""
    parts = text.split("`")
    marked = [Markup("<code>{}</code>").format(p) if i % 2 else escape(p)
              for i, p in enumerate(parts)]  # fmt: skip
    return Markup("").join(marked)


def page(templates: Path, name: str, title: str, **content: object) -> str:
    """The page that a template makes of its content.

    templates  folder of the template
    """
    template = _environment(templates).get_template(name)
    return template.render(title=title, plotly=get_plotlyjs(), **content) + "\n"


def fragment(parts: Sequence[str | TableData]) -> str:
    """Sentences and tables as HTML, to be embedded in another page."""
    return _environment().get_template("fragment.html").render(parts=parts)


def _environment(*templates: Path) -> Environment:
    environment = Environment(
        loader=FileSystemLoader([*templates, _SHARED]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["code"] = code
    return environment


def write_page(text: str, path: Path) -> None:
    """Write a page atomically."""
    write_atomic(path, text)
