"""Parts of a self-contained HTML page: tables, code, plots, and the page around them."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from pathlib import Path

import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from cell.files.atomic import write_whole
from cell.lab.report.figure_layout import least_px

_STYLE = """
body{font:16px/1.45 system-ui,sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#222}
h1{font-size:1.5em;margin-bottom:.2em}h2{font-size:1.2em;margin-top:2.2em}
.facts,.note{color:#555}.says{font-size:1.3em;padding:.8em 1em;background:#eef4f5;
border-left:6px solid #00798c}.says.bad{background:#fbeff0;border-color:#d1495b}
.warning{border-left:6px solid #edae49;padding-left:1em}
pre,code{background:#f4f4f4;padding:.1em .3em}pre{padding:.7em;overflow-x:auto}
.law{font-size:1.1em;font-family:ui-monospace,monospace;background:#f4f4f4;padding:.6em .8em}
table{border-collapse:collapse;margin:.8em 0}td,th{padding:.25em .9em;text-align:left;
border-bottom:1px solid #ddd}
.number{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
.wide,.plot{width:100%;overflow-x:auto}.plot>div{min-width:var(--least)}
@media(max-width:600px){td,th{white-space:nowrap}}
summary{cursor:pointer;margin:.6em 0}select{font:inherit;padding:.2em .4em}
@media print{select,summary{display:none}}
"""


#: Draws a figure when it is first seen: plotly cannot lay out what is hidden.
_SCRIPT = """
const config = {responsive: true, displaylogo: false,
  modeBarButtons: [['toImage', 'zoom2d', 'pan2d', 'resetScale2d']]};
function draw() {
  for (const place of document.querySelectorAll('.plot')) {
    if (place.offsetParent === null || place.dataset.drawn) continue;
    place.dataset.drawn = 'yes';
    const figure = JSON.parse(place.querySelector('script').textContent);
    const target = place.appendChild(document.createElement('div'));
    Plotly.newPlot(target, figure.data, figure.layout, config)
      .then(() => figure.frames && Plotly.addFrames(target, figure.frames));
  }
}
function choose(name) {
  for (const part of document.querySelectorAll('.trial')) part.hidden = part.dataset.trial !== name;
  draw();
}
const chooser = document.getElementById('chooser');
for (const part of document.querySelectorAll('details')) part.addEventListener('toggle', draw);
if (chooser) {
  chooser.addEventListener('change', () => choose(chooser.value));
  choose(chooser.value);
} else draw();
"""


def write_page(page: str, path: Path) -> None:
    """Write a page, whole or not at all."""
    write_whole(path, page)


def html_table(heads: Sequence[str], rows: Iterable[Sequence[str]], numbers: Iterable[int]) -> str:
    """A table; columns of numbers stand to the right."""
    right = set(numbers)

    def line(tag: str, cells: Sequence[str]) -> str:
        look = [" class='number'" if i in right else "" for i in range(len(cells))]
        return "".join(
            f"<{tag}{kind}>{html.escape(cell)}</{tag}>"
            for cell, kind in zip(cells, look, strict=True)
        )

    body = "".join(f"<tr>{line('td', row)}</tr>" for row in rows)
    return f"<div class='wide'><table><tr>{line('th', heads)}</tr>{body}</table></div>"


def html_code(text: str) -> str:
    """A docstring's text, what stands between backticks as code."""
    plain, *rest = html.escape(text).split("`")
    return plain + "".join(f"<code>{t}</code>" if i % 2 == 0 else t for i, t in enumerate(rest))


def html_plot(figure: go.Figure) -> str:
    """A place for a figure, and the figure as data."""
    data = str(figure.to_json()).replace("</", "<\\/")
    size = f"min-height:{figure.layout.height}px;--least:{least_px(figure)}px"
    return f'<div class="plot" style="{size}"><script type="application/json">{data}</script></div>'


def html_page(title: str, parts: Sequence[str]) -> str:
    """The page around parts."""
    return (
        f'<!doctype html><html lang="en"><head><meta name="generator" '
        f'content="cable-cell"><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width"><title>{html.escape(title)}</title>'
        f"<style>{_STYLE}</style><script>{get_plotlyjs()}</script></head><body>"
        f"<h1>{html.escape(title)}</h1><noscript><p>The figures need JavaScript.</p></noscript>"
        f"{''.join(parts)}<script>{_SCRIPT}</script></body></html>\n"
    )
