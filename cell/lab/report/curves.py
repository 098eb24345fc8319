"""Curves of profile likelihoods, with plotly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots
from scipy.special import ndtri as normal_quantile

from cell.cable.arrays import FloatArray
from cell.files.figure_style import ADDED, MODEL, NOISE, QUIET, laid_out, listed
from cell.lab.strength.profiles import ParameterProfile

#: Standard deviations to the end of a 95 % interval.
Z_95 = float(normal_quantile(0.975))


def profile_curves(found: Sequence[ParameterProfile]) -> go.Figure:
    """Rise of −2 ln likelihood with each parameter held elsewhere, and the parabola of Wald."""
    columns = 3
    rows = -(-len(found) // columns)
    titles = [f"{p.name}, {p.unit}" for p in found]
    figure = make_subplots(rows, columns, subplot_titles=titles, vertical_spacing=0.35 / rows)
    for number, p in enumerate(found):
        where = {"row": number // columns + 1, "col": number % columns + 1}
        first = number == 0
        bounded = [bool(names) for names in p.at_bound]
        words = [f"at a bound: {', '.join(n)}" if n else "" for n in p.at_bound]
        ends = np.array(p.wald)
        spread = (np.log(ends) if p.logarithmic else ends) @ [-0.5, 0.5] / Z_95
        middle = float(np.log(p.fitted)) if p.logarithmic else p.fitted
        q = middle + spread * np.linspace(-2.4, 2.4, 41)
        parabola = ((q - middle) / max(spread, 1e-300)) ** 2
        shown = np.exp(q) if p.logarithmic else q
        figure.add_scatter(x=listed_exactly(shown), y=listed(parabola, 4), mode="lines",
            line={"color": QUIET, "dash": "dot"}, name="by the curvature at the minimum",
            legendgroup="wald", showlegend=first, **where)  # fmt: skip
        figure.add_scatter(x=listed_exactly(p.values), y=listed(p.rise, 4), mode="lines+markers",
            line={"color": ADDED}, name="refitted with the parameter held", legendgroup="profile",
            showlegend=first, text=words, **where)  # fmt: skip
        figure.add_scatter(
            x=listed_exactly(np.where(bounded, p.values, np.nan)), y=listed(p.rise, 4),
            mode="markers", marker={"color": MODEL, "symbol": "diamond", "size": 11},
            name="another parameter at its bound", legendgroup="bound", showlegend=first,
            text=words, **where)  # fmt: skip
        figure.add_hline(y=Z_95**2, line_dash="dash", line_color=NOISE, **where)
        figure.update_yaxes(range=[min(-0.3, 1.1 * p.rise.min()), 1.6 * Z_95**2], **where)
        if where["col"] == 1:
            figure.update_yaxes(title="rise of −2 ln L", **where)
        if p.logarithmic:
            figure.update_xaxes(type="log", nticks=4, **where)
    figure.update_annotations(font_size=11)
    return laid_out(figure, 90 + 210 * rows).update_layout(legend_y=-0.25 / rows)


def listed_exactly(values: FloatArray) -> list[float | None]:
    """Plain numbers as they are; None where there is none."""
    return [float(v) if np.isfinite(v) else None for v in values]
