"""Tables and figures of a wrench: as measured, and as models predict it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from cell.cable.arrays import FloatArray
from cell.files.figure_style import NOISE, SEEN, laid_out, listed, thinned
from cell.files.table import TableData
from cell.lab.report.figures import Series
from cell.lab.report.wording import chance
from cell.lab.strength.compare import Comparison, WrenchResidual
from cell.study.data import Wrench
from cell.study.wrench import WrenchFacts

#: In the order of the columns of `wrench.csv`.
NAMES = ("force x", "force y", "moment")
UNITS = ("mN", "mN", "mN·m")
_MILLI = 1e3
#: Height of a panel and of the figure's margins, px.
_PANEL_PX, _AROUND_PX = 190, 90


def wrench_facts_table(facts: Sequence[WrenchFacts]) -> TableData:
    """Table of the wrench's facts, one row per trial and axis."""
    rows = [
        [
            f.trial,
            f"{name}, {unit}",
            f"{f.rate_hz:.4g}",
            str(f.still),
            f"{_MILLI * f.varies[i]:.3g}",
            f"{_MILLI * f.noise[i]:.2g}" if np.isfinite(f.noise[i]) else "–",
        ]
        for f in facts
        for i, (name, unit) in enumerate(zip(NAMES, UNITS, strict=True))
        if np.isfinite(f.varies[i])
    ]
    heads = ("trial", "at the clamp", "per s", "still", "varies by", "noise")
    return TableData("Wrench at the clamp", heads, rows, range(2, len(heads)))


def wrench_figure(wrench: Wrench) -> go.Figure:
    """The measured wrench by time."""
    measured = np.flatnonzero(np.isfinite(wrench.values).any(axis=0))
    titles = [f"{NAMES[i]}, {UNITS[i]}" for i in measured]
    figure = make_subplots(len(measured), 1, shared_xaxes=True, subplot_titles=titles)
    for row, i in enumerate(measured, 1):
        values = thinned(wrench.values)[:, i]
        _line(figure, thinned(wrench.t_s), values, ("measured", SEEN), (row, 1))
    figure.update_xaxes(title="s", row=len(measured), col=1)
    return laid_out(figure, _AROUND_PX + _PANEL_PX * len(measured))


def wrenches_table(comparisons: Sequence[Comparison]) -> TableData | None:
    """Errors of models' wrenches by trial; None where none was measured.

    Excess over noise and whiteness are the last model's.
    """
    last = comparisons[-1]
    rows = []
    for w in last.wrenches:
        wrenches = [_of(c, w.trial) for c in comparisons]
        for i in np.flatnonzero(np.isfinite(w.rms)):
            errors = ["–" if e is None else _shown(e.rms[i]) for e in wrenches]
            beyond = _shown(w.beyond_noise[i]), chance(w.p_values[i])
            rows.append([w.trial, f"{NAMES[i]}, {UNITS[i]}", _shown(w.noise[i]), *errors, *beyond])
    names = ["error"] if len(comparisons) == 1 else [c.model for c in comparisons]
    heads = ["trial", "at the clamp", "noise", *names, "beyond noise", "p (white)"]
    title = "Error of the wrench, rms, less its tare"
    return TableData(title, heads, rows, range(2, len(heads))) if rows else None


def wrench_overlay(series: Sequence[Series], trial: str) -> go.Figure | None:
    """Wrench measured and predicted, and its error, against time; None if there is none."""
    predictions = [(s, w) for s in series if (w := _of(s.comparison, trial)) is not None]
    if not predictions:
        return None
    first = predictions[0][1]
    axes = np.flatnonzero(np.isfinite(first.rms))
    titles = [f"{NAMES[i]}{of}, {UNITS[i]}" for i in axes for of in ("", ": error")]
    figure = make_subplots(len(axes), 2, shared_xaxes=True, subplot_titles=titles)
    t_s = thinned(first.t_s)
    for row, i in enumerate(axes, 1):
        measured = thinned(first.measured)[:, i]
        _line(figure, t_s, measured, ("measured", SEEN), (row, 1), dots=True, named=row == 1)
        for s, w in predictions:
            predicted, place = thinned(w.predicted)[:, i], (row, 1)
            _line(figure, t_s, predicted, (s.name, s.colour), place, width=s.width, named=row == 1)
            error = thinned(w.measured - w.predicted)[:, i]
            _line(figure, t_s, error, (s.name, s.colour), (row, 2), width=1.0)
        band = 2.0 * _MILLI * float(first.noise[i])
        figure.add_hrect(
            y0=-band, y1=band, fillcolor=NOISE, opacity=0.2, layer="below", line_width=0,
            row=row, col=2,
        )  # fmt: skip
    figure.update_xaxes(title="s", row=len(axes))
    return laid_out(figure, _AROUND_PX + _PANEL_PX * len(axes))


def _of(comparison: Comparison, trial: str) -> WrenchResidual | None:
    return next((w for w in comparison.wrenches if w.trial == trial), None)


def _shown(value: float) -> str:
    """A force or moment in a table, in thousandths."""
    return f"{_MILLI * value:.3g}"


def _line(
    figure: go.Figure,
    t_s: FloatArray,
    values: FloatArray,
    of: tuple[str, str],
    place: tuple[int, int],
    *,
    width: float = 1.0,
    dots: bool = False,
    named: bool = False,
) -> None:
    """A line, or dots, in a panel.

    of     its name and colour
    place  row and column
    """
    name, colour = of
    look = {"marker": {"size": 3, "color": colour}}
    if not dots:
        look = {"line": {"width": width, "color": colour}}
    figure.add_scatter(
        x=listed(t_s, 4), y=listed(_MILLI * values, 3), mode="markers" if dots else "lines",
        name=name, legendgroup=name, showlegend=named, **look, row=place[0], col=place[1],
    )  # fmt: skip
