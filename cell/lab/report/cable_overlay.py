"""The report's overlay: a cable observed and predicted, with a time slider, and its tip."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from cell.cable.arrays import FloatArray
from cell.files.figure_style import NOISE, SEEN, laid_out, listed, play_button
from cell.lab.report.figures import Series
from cell.lab.strength.compare import across_tip, displacement, distance, largest

#: Number of frames of an overlay's time slider.
SLIDER_FRAMES = 60
#: Magnifications of the errors drawn over the cable.
LARGER = (1, 2, 5, 10, 20, 50, 100, 200, 500)
#: Pixels: of the figure, below its axes, and from the axes to below the slider's labels.
HEIGHT, BELOW, SLIDER = 680, 210, 150
#: Share of the picture that the largest errors should fill when drawn larger.
ERROR_SHARE = 0.12


def overlay(series: Sequence[Series], number: int) -> go.Figure:
    """One trial with a time slider: cable observed and predicted, tip and its error by time."""
    comparison = series[0].comparison
    trial = comparison.study.trials[number]
    t_s, observed = trial.markers.t_s, trial.markers.xy_m * 1e3
    models = [s.comparison.predicted_m[trial.name] * 1e3 for s in series]
    cables = [s.comparison.cable_m[trial.name] * 1e3 for s in series]
    length = comparison.study.cable.free_length_m * 1e3
    wanted = ERROR_SHARE * length / max(largest(distance(observed, models[0])), 1e-6 * length)
    larger = max((k for k in LARGER if k <= wanted), default=1)
    figure = make_subplots(
        2,
        2,
        specs=[[{"rowspan": 2}, {}], [None, {}]],
        column_widths=[0.55, 0.45],
        horizontal_spacing=0.1,
        vertical_spacing=0.17,
        subplot_titles=("cable, mm", "height of the tip, mm", "error of the tip, mm"),
    )
    shown = np.unique(np.linspace(0, len(t_s) - 1, SLIDER_FRAMES).astype(int))
    across = across_tip(trial, comparison.predicted_m[trial.name])
    errors = [np.sum(displacement(observed, m)[:, 0] * across, axis=1) for m in models]
    _tip_panels(figure, series, t_s, observed, models, errors)

    def at(k: int) -> list[dict[str, Any]]:
        """Traces that the slider moves: the cable, its errors drawn larger, and two cursors."""
        drawn = models[0] + displacement(observed, models[0])
        shapes = [_points(drawn[k]), *(_points(c[k]) for c in cables)]
        whiskers = [_whiskers(observed[k], m[k], larger) for m in models]
        x = [round(float(t_s[k]), 4)] * 2
        return [*shapes, *whiskers, *({"x": x, "y": y} for y in cursors)]

    cursors = [_reach(observed[:, 0, 1]), _reach(np.concatenate(errors))]
    first = len(figure.data)
    styles = _styles(series, larger)
    places = [(1, 1)] * (1 + 2 * len(series)) + [(1, 2), (2, 2)]
    farthest = np.nan_to_num(distance(observed, models[0])[shown]).max(axis=1)
    worst = int(shown[np.argmax(farthest)])
    for data, style, (row, column) in zip(at(worst), styles, places, strict=True):
        figure.add_scatter(**data, **style, row=row, col=column)
    moved = list(range(first, len(figure.data)))
    figure.frames = [
        go.Frame(name=str(k), traces=moved, data=[go.Scatter(**d) for d in at(int(k))])
        for k in shown
    ]
    _axes(figure, (observed, *cables), t_s)
    _slider(figure, [(str(k), float(t_s[k])) for k in shown], list(shown).index(worst))
    figure = laid_out(figure, HEIGHT).update_layout(margin_b=BELOW)
    drawn = HEIGHT - BELOW - figure.layout.margin.t
    return figure.update_layout(legend={"y": -SLIDER / drawn, "yanchor": "top"})


def _styles(series: Sequence[Series], larger: int) -> list[dict[str, Any]]:
    """Style of each trace that the slider moves, in the same order."""
    return [
        {"mode": "markers", "name": "seen", "marker": {"size": 8, "color": SEEN}},
        *(
            {"mode": "lines", "name": s.name, "line": {"color": s.colour, "width": s.width}}
            for s in series
        ),
        *(
            {
                "mode": "lines",
                "name": f"error {s.of} × {larger}",
                "line": {"color": s.colour, "width": 4 + 4 * s.above},
                "opacity": 0.55,
                "showlegend": True,
            }
            for s in series
        ),
        *({"mode": "lines", "line": {"color": "#999", "width": 1}, "showlegend": False},) * 2,
    ]


def _axes(figure: go.Figure, shapes_mm: Sequence[FloatArray], t_s: FloatArray) -> None:
    """Set ranges that show all of the cable and of the time."""
    points = np.concatenate([p.reshape(-1, 2) for p in shapes_mm])
    low, high = np.nanmin(points, axis=0) - 8.0, np.nanmax(points, axis=0) + 8.0
    figure.update_xaxes(range=listed(np.array([low[0], high[0]]), 1), row=1, col=1)
    figure.update_yaxes(range=listed(np.array([low[1], high[1]]), 1), scaleanchor="x", row=1, col=1)
    span = listed(np.array([t_s[0], t_s[-1]]), 4)
    figure.update_xaxes(range=span, col=2)
    figure.update_xaxes(title="s", row=2, col=2)


def _tip_panels(
    figure: go.Figure,
    series: Sequence[Series],
    t_s: FloatArray,
    observed: FloatArray,
    models: Sequence[FloatArray],
    errors: Sequence[FloatArray],
) -> None:
    """Height of the tip and its error across the cable, against time; nothing here moves."""
    noise = 2e3 * series[0].comparison.noise_m
    times = listed(t_s, 4)
    dots = {"size": 3, "color": SEEN}
    figure.add_scatter(
        x=times, y=listed(observed[:, 0, 1], 4), mode="markers", marker=dots, showlegend=False,
        row=1, col=2,
    )  # fmt: skip
    for s, model, error in zip(series, models, errors, strict=True):
        style = {"color": s.colour, "width": s.width}
        for y, row in ((model[:, 0, 1], 1), (error, 2)):
            figure.add_scatter(
                x=times, y=listed(y, 4), mode="lines", line=style, showlegend=False,
                row=row, col=2,
            )  # fmt: skip
    figure.add_hrect(
        y0=-noise, y1=noise, fillcolor=NOISE, opacity=0.2, layer="below", line_width=0, row=2, col=2
    )


def _slider(figure: go.Figure, frames: Sequence[tuple[str, float]], active: int) -> None:
    """A slider over frames, and a button that plays them."""
    still = {"mode": "immediate", "frame": {"duration": 0, "redraw": False}}
    still |= {"transition": {"duration": 0}}
    figure.update_layout(
        sliders=[
            {
                "active": active,
                "currentvalue": {"prefix": "t = ", "suffix": " s"},
                "x": 0.08,
                "len": 0.92,
                "pad": {"t": 45},
                "ticklen": 4,
                "steps": [
                    {"label": f"{t:.2f}", "method": "animate", "args": [[name], still]}
                    for name, t in frames
                ],
            }
        ],
        updatemenus=[play_button(60, x=0.0, y=0.0, pad={"t": 70})],
    )


def _whiskers(observed: FloatArray, model: FloatArray, larger: int) -> dict[str, Any]:
    """Lines from every marker towards its predicted place, `larger` times as long as the error."""
    error = displacement(observed, model)
    observed = model + error
    ends = observed - larger * error
    gaps = np.full_like(observed, np.nan)
    return _points(np.stack([observed, ends, gaps], axis=1).reshape(-1, 2))


def _points(xy: FloatArray) -> dict[str, Any]:
    return {"x": listed(xy[:, 0], 3), "y": listed(xy[:, 1], 3)}


def _reach(values: FloatArray) -> list[float | None]:
    """Lowest and highest value; None where there are none."""
    finite = values[np.isfinite(values)]
    return listed(np.array([finite.min(), finite.max()]), 4) if finite.size else [None, None]
