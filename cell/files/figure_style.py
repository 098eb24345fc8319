"""Style of all figures: colours, panels, the noise line, numbers as lists."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


SEEN, MODEL, ADDED, NOISE, QUIET = "#222222", "#d1495b", "#00798c", "#5c677d", "#c9ced6"
#: Colours of the models between the first and the last.
BETWEEN = ("#edae49", "#7768ae", "#8f5d2b", "#3d8b37", "#c06c9b")
#: With fewer markers, each is a tick of an axis.
FEW_MARKERS = 5
#: Largest number of drawn points of a line: more are not visible.
MOST_POINTS = 1500
#: Least width of a panel, and of a name below an axis, to be legible, px.
PANEL_PX, NAME_PX = 310, 90


def logarithmic(figure: go.Figure, values: Sequence[FloatArray], **where: int) -> None:
    """Makes the y axis logarithmic, with room around positive values and plain numbers on it."""
    some = np.concatenate([v[np.isfinite(v) & (v > 0.0)] for v in values])
    low, high = np.log10(some.min()), np.log10(some.max())
    room = max(0.15, 0.15 * (high - low))  # for the numbers of the lowest and highest
    low, high = low - room, high + room
    ticks = thirds() if high - low < 2.0 else [10.0**n for n in range(-6, 4)]
    if high - low < 0.8:
        ticks = [m * 10.0**n for n in range(-6, 4) for m in (1, 1.2, 1.5, 2, 3, 4, 5, 6, 8)]
    figure.update_yaxes(
        type="log", range=[float(low), float(high)], tickvals=ticks, tickformat="~g", **where
    )


def thirds() -> list[float]:
    """Axis ticks: 1, 2 and 5 of every power of ten."""
    return [m * 10.0**n for n in range(-6, 4) for m in (1, 2, 5)]


def noise_line(figure: go.Figure, noise_mm: float, name: str) -> None:
    """Add a horizontal line at the noise, labelled in the legend."""
    figure.add_hline(
        y=noise_mm,
        line_dash="dash",
        line_color=NOISE,
        name=f"{name} {noise_mm:.3g} mm",
        showlegend=True,
    )


def least_px(figure: go.Figure) -> int:
    """Least width at which the figure's labels do not overlap; narrower pages scroll it, px."""
    columns = {round(float(axis.domain[0]), 3) for axis in figure.select_xaxes() if axis.domain}
    names = [len(set(t.x)) for t in figure.data if figure.layout.xaxis.type == "category"]
    return max(PANEL_PX * len(columns), NAME_PX * (1 + max(names, default=0)))


def laid_out(figure: go.Figure, height: int) -> go.Figure:
    """The figure in the style and size of all figures."""
    return figure.update_layout(
        template="plotly_white",
        height=height,
        margin={"l": 65, "t": 45, "b": 60, "r": 20},
        font={"size": 13, "color": "#222", "family": "system-ui, sans-serif"},
        legend={"orientation": "h", "y": -0.2, "yanchor": "top"},
        hovermode="closest",
    )


def play_button(frame_ms: int, **place: Any) -> dict[str, Any]:
    """A button that plays the frames of a figure, as an entry of its `updatemenus`."""
    play = {"mode": "immediate", "transition": {"duration": 0}, "fromcurrent": True}
    play |= {"frame": {"duration": frame_ms, "redraw": False}}
    return {
        "type": "buttons",
        "showactive": False,
        "xanchor": "left",
        "yanchor": "top",
        "buttons": [{"label": "▶", "method": "animate", "args": [None, play]}],
        **place,
    }


def in_mm(values_m: FloatArray) -> list[float | None]:
    """Values in millimetres, as a list."""
    return listed(values_m * 1e3, 4)


def listed(values: FloatArray, digits: int) -> list[float | None]:
    """Plain numbers, rounded; None where there is none."""
    return [round(float(v), digits) if np.isfinite(v) else None for v in values]


def thinned(rows: FloatArray) -> FloatArray:
    """Rows (n, …) of a line, thinned to the visible number."""
    return np.asarray(rows[:: max(1, len(rows) // MOST_POINTS)])
