"""The figures of the lab's report, with plotly; numbers as plain lists, for any reader."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots
from scipy.special import ndtri as normal_quantile

from cell.cable.arrays import FloatArray
from cell.files.figure_style import (
    ADDED,
    BETWEEN,
    FEW_MARKERS,
    MODEL,
    NOISE,
    QUIET,
    in_mm,
    laid_out,
    listed,
    logarithmic,
    noise_line,
    play_button,
    thirds,
)
from cell.lab.data.results import Diagnosis
from cell.lab.fit.series import rms_over
from cell.lab.report.wording import by_evidence, chance, noise_label, places
from cell.lab.strength.compare import PHASES, Comparison, distance, largest, phase_of
from cell.lab.strength.profiles import ParameterProfile


@dataclass(frozen=True)
class Series:
    """A model compared with the measurements; its name and colour are those of all figures.

    of     the name after "error"
    above  number of models drawn over it: larger lines and markers keep it visible below them
    """

    name: str
    of: str
    colour: str
    comparison: Comparison
    above: int = 0

    @property
    def width(self) -> float:
        """Width of its lines, px."""
        return 1.5 + 2.0 * self.above

    @property
    def size(self) -> float:
        """Size of its markers, px."""
        return 8.0 + 5.0 * self.above


#: Standard deviations to the end of a 95 % interval.
Z_95 = float(normal_quantile(0.975))


def profile_curves(profiles: Sequence[ParameterProfile]) -> go.Figure:
    """Profile likelihoods: rise of −2 ln L against each parameter, with Wald's parabola."""
    columns = 3
    rows = -(-len(profiles) // columns)
    titles = [f"{p.name}, {p.unit}" for p in profiles]
    figure = make_subplots(rows, columns, subplot_titles=titles, vertical_spacing=0.35 / rows)
    for number, p in enumerate(profiles):
        where = {"row": number // columns + 1, "col": number % columns + 1}
        first = number == 0
        bounded = [bool(names) for names in p.at_bound]
        texts = [f"at a bound: {', '.join(n)}" if n else "" for n in p.at_bound]
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
            showlegend=first, text=texts, **where)  # fmt: skip
        figure.add_scatter(
            x=listed_exactly(np.where(bounded, p.values, np.nan)), y=listed(p.rise, 4),
            mode="markers", marker={"color": MODEL, "symbol": "diamond", "size": 11},
            name="another parameter at its bound", legendgroup="bound", showlegend=first,
            text=texts, **where)  # fmt: skip
        figure.add_hline(y=Z_95**2, line_dash="dash", line_color=NOISE, **where)
        figure.update_yaxes(range=[min(-0.3, 1.1 * p.rise.min()), 1.6 * Z_95**2], **where)
        if where["col"] == 1:
            figure.update_yaxes(title="rise of −2 ln L", **where)
        if p.logarithmic:
            figure.update_xaxes(type="log", nticks=4, **where)
    figure.update_annotations(font_size=11)
    return laid_out(figure, 90 + 210 * rows).update_layout(legend_y=-0.25 / rows)


def listed_exactly(values: FloatArray) -> list[float | None]:
    """The values as plain numbers, unrounded; None for nan and infinity."""
    return [float(v) if np.isfinite(v) else None for v in values]


#: Most model names that fit below an axis.
MOST_NAMED = 24
#: Family-wise significance level, as in a diagnosis.
CHANCE = 0.01

_STATUS = {
    "present": (ADDED, "missing in the model"),
    "inspect": ("#edae49", "examine"),
    "cannot_tell": (QUIET, "cannot tell"),
    "absent": (NOISE, "excluded"),
}


def waterfall(diagnosis: Diagnosis) -> go.Figure:
    """Error of the baseline, error after each added effect, and the noise."""
    added = diagnosis.missing or diagnosis.partial
    names = ["model", *(f"+ {'<br>or '.join((f.effect, *f.tied_with))}" for f in added)]
    label = noise_label(diagnosis.noise_is_stated)
    base, errors = diagnosis.baseline, [f.errors for f in added]
    held, fitted = [base.heldout_rms_m], [base.fit_rms_m]
    if diagnosis.missing or not added:
        held += [e.heldout_rms_m for e in errors]
        fitted += [e.fit_rms_m for e in errors]
        return _falling(names, held, fitted, diagnosis.noise_m, label)
    missing = [float("nan")] * len(added)
    before_m = float("nan") if diagnosis.left is None else diagnosis.left.before_rms_m
    to_all = [before_m, *(e.fit_rms_m for e in errors)]
    return _falling(names, [*held, *missing], [*fitted, *missing], diagnosis.noise_m, label, to_all)


def history(comparisons: Sequence[Comparison]) -> go.Figure:
    """Errors of models in sequence, labelled with the effects that each adds, and the noise."""
    names, before = [], comparisons[0]
    for c in comparisons:
        changes = [f"+ {e}" for e in c.effects if c is before or e not in before.effects]
        changes += [f"− {e}" for e in before.effects if e not in c.effects]
        names.append("<br>".join([f"<b>{html.escape(c.model)}</b>", *changes]))
        before = c
    return _falling(
        names,
        [c.heldout_rms_m for c in comparisons],
        [c.fit_rms_m for c in comparisons],
        comparisons[0].noise_m,
        noise_label(comparisons[0].noise_is_stated),
    )


def fit_history(diagnosis: Diagnosis) -> go.Figure:
    """Error of every model that was fitted, one after another, and the least so far; playable.

    Models stand in the order of their number of effects, the largest error first.
    """
    fits = diagnosis.fit_errors
    named = {f.effect for f in diagnosis.missing or diagnosis.partial}
    errors_mm = np.array([f.rms_m for f in fits]) * 1e3
    least_mm = np.minimum.accumulate(errors_mm)
    names = [" + ".join(f.effects) or "baseline" for f in fits]
    colours = [ADDED if f.effects and named >= set(f.effects) else QUIET for f in fits]
    x = list(range(len(fits)))
    each, least = listed(errors_mm, 4), listed(least_mm, 4)
    figure = go.Figure()
    figure.add_scatter(x=x, y=each, mode="markers", name="each model", text=names,
        marker={"color": colours, "size": 9},
        hovertemplate="%{text}: %{y} mm<extra></extra>")  # fmt: skip
    figure.add_scatter(x=x, y=least, mode="lines", name="least so far",
        line={"color": ADDED, "shape": "hv"}, hoverinfo="skip")  # fmt: skip
    noise_mm = fits[-1].noise_m * 1e3
    noise_line(figure, noise_mm, noise_label(diagnosis.noise_is_stated))
    logarithmic(figure, [errors_mm, np.array([noise_mm])])
    figure.frames = [
        go.Frame(name=str(n), data=[{"x": x[:n], "y": each[:n]}, {"x": x[:n], "y": least[:n]}])
        for n in range(1, len(fits) + 1)
    ]
    labels = [name.replace(" + ", "<br>+ ") for name in names] if len(fits) <= MOST_NAMED else []
    ends = [-0.5, len(fits) - 0.5]
    figure.update_xaxes(range=ends, tickvals=x[: len(labels)], ticktext=labels, tickangle=-40)
    button = play_button(150, x=-0.05, y=-0.1)
    figure.update_layout(yaxis_title="error, mm rms", updatemenus=[button])
    return laid_out(figure, 460).update_layout(
        margin_b=150, legend={"y": 1.02, "yanchor": "bottom"}
    )


def _falling(
    names: Sequence[str],
    heldout_m: Sequence[float],
    fit_m: Sequence[float],
    noise_m: float,
    noise: str,
    to_all_m: Sequence[float] = (),
) -> go.Figure:
    """Errors of models one after another, on a logarithmic axis.

    to_all_m  errors on all motions of models fitted to all of them
    """
    figure = go.Figure()
    lines = [
        ("on motions it was not fitted to", heldout_m, ADDED, "solid"),
        ("on motions it was fitted to", fit_m, NOISE, "dot"),
        ("on all motions, fitted to all", to_all_m, BETWEEN[1], "dash"),
    ]
    lines = [line for line in lines if np.isfinite(line[1]).any()]
    sides = _sides([in_mm(np.array(values)) for _, values, _, _ in lines])
    for (label, values, colour, dash), places_of in zip(lines, sides, strict=True):
        shown = in_mm(np.array(values))
        figure.add_scatter(
            x=names,
            y=shown,
            name=label,
            mode="lines+markers+text",
            line={"color": colour, "dash": dash},
            marker={"size": 11},
            text=["" if v is None else f"{v:.3g}" for v in shown],
            textposition=places_of,
            cliponaxis=False,
        )
    noise_line(figure, noise_m * 1e3, noise)
    errors = [np.array(values) * 1e3 for _, values, _, _ in lines]
    logarithmic(figure, [*errors, np.array([noise_m * 1e3])])
    figure.update_xaxes(range=[-0.5, len(names) - 0.5], type="category")
    figure.update_layout(yaxis_title="error, mm rms")
    return laid_out(figure, 360 + 18 * max(n.count("<br>") for n in names))


def _sides(lines: Sequence[Sequence[float | None]]) -> list[list[str]]:
    """Position of each number at its marker: the largest above, the smallest below.

    Those between them to the right.
    """
    positions = []
    for line in lines:
        sides = []
        for i, value in enumerate(line):
            others = [o for other in lines if other is not line and (o := other[i]) is not None]
            own = 0.0 if value is None else value
            first = next(other for other in lines if other[i] is not None or other is line) is line
            if all(own > o or (own == o and first) for o in others):
                sides.append("top center")
            elif all(own <= o for o in others):
                sides.append("bottom center")
            else:
                sides.append("middle right")
        positions.append(sides)
    return positions


def by_trial(series: Sequence[Series]) -> go.Figure:
    """Error of every model on every trial, side by side on a logarithmic axis."""
    first = series[0].comparison
    roles = {"fit": "fitted", "validate": "held out"}
    names = [f"{t.name}<br>{roles[t.role]}" for t in first.study.trials]
    figure = go.Figure()
    for s in series:
        figure.add_scatter(
            x=names,
            y=in_mm(np.array([w.rms_m for w in s.comparison.where])),
            mode="markers",
            name=s.name,
            marker={"color": s.colour, "size": s.size},
        )
    noise_line(figure, first.noise_m * 1e3, noise_label(first.noise_is_stated))
    errors = [np.array([w.rms_m * 1e3 for w in s.comparison.where]) for s in series]
    logarithmic(figure, [*errors, np.array([first.noise_m * 1e3])])
    figure.update_xaxes(type="category")
    figure.update_layout(yaxis_title="error, mm rms")
    return laid_out(figure, 380)


def ranking(diagnosis: Diagnosis) -> go.Figure:
    """Evidence for each effect: √χ² explained, whose standard deviation is 1 whatever its size."""
    rows = list(reversed(by_evidence(diagnosis)))
    evidence = np.sqrt([max(r.score, 0.0) for r in rows])
    figure = go.Figure()
    for status, (colour, label) in _STATUS.items():
        chosen = [i for i, r in enumerate(rows) if r.status == status]
        if not chosen:
            continue
        figure.add_scatter(
            x=listed(evidence[chosen], 2),
            y=[rows[i].effect for i in chosen],
            mode="markers",
            name=label,
            marker={"color": colour, "size": 11},
            error_x={
                "type": "data",
                "array": [2.0] * len(chosen),
                "arrayminus": listed(np.minimum(2.0, evidence[chosen]), 2),
                "thickness": 1.5,
            },
            customdata=[[places(rows[i].score, 1), chance(rows[i].p_value)] for i in chosen],
            hovertemplate="%{y}: χ² %{customdata[0]}, p %{customdata[1]}<extra></extra>",
        )
    limit = -float(normal_quantile(0.5 * CHANCE / max(len(rows), 1)))
    figure.add_vline(x=limit, line_dash="dot", line_color=NOISE)
    figure.add_annotation(
        x=limit, y=1.0, yref="paper", yanchor="bottom", text="chance", showarrow=False
    )
    names = [r.effect for r in rows]
    figure.update_yaxes(categoryorder="array", categoryarray=names, ticklabelstandoff=8)
    figure.update_xaxes(title="evidence, standard deviations", rangemode="tozero")
    figure = laid_out(figure, 130 + 22 * len(rows))
    return figure.update_layout(margin_l=150)


def residual_maps(series: Sequence[Series], number: int) -> go.Figure:
    """Maps of one trial's residual over time and arc length, one for each model.

    Colours are logarithmic, from the noise, which is white.
    """
    comparison = series[0].comparison
    trial = comparison.study.trials[number]
    t_s = trial.markers.t_s
    errors_mm = [
        distance(trial.markers.xy_m, s.comparison.predicted_m[trial.name]) * 1e3 for s in series
    ]
    noise_mm = comparison.noise_m * 1e3
    highest = max(4.0 * noise_mm, *(largest(v) for v in errors_mm))
    figure = make_subplots(
        1, len(series), shared_yaxes=True, subplot_titles=[f"error {s.of}, mm" for s in series],
        horizontal_spacing=0.04,
    )  # fmt: skip
    for column, values in enumerate(errors_mm, 1):
        figure.add_heatmap(
            x=listed(t_s, 4),
            y=listed(comparison.study.arc_length_m * 1e3, 2),
            z=[listed(row, 4) for row in np.log10(np.maximum(values.T, 1e-6))],
            text=[listed(row, 4) for row in values.T],
            coloraxis="coloraxis",
            hovertemplate="%{x:.3f} s, %{y:.0f} mm: %{text:.3g} mm<extra></extra>",
            row=1,
            col=column,
        )
    moving = t_s[phase_of(trial) == "moving"]
    for edge in () if not moving.size else (float(moving[0]), float(moving[-1])):
        figure.add_vline(x=edge, line_dash="dot", line_color="#222")
    figure.update_xaxes(title="s")
    figure.update_yaxes(title="from the grip, mm", row=1, col=1)
    if len(comparison.study.arc_length_m) < FEW_MARKERS:
        figure.update_yaxes(tickvals=listed(comparison.study.arc_length_m * 1e3, 2))
    figure.update_layout(
        coloraxis={
            "colorscale": [[0.0, "#ffffff"], [0.25, "#fde0c5"], [0.6, "#eb7a52"], [1.0, "#7a0025"]],
            "cmin": float(np.log10(noise_mm)),
            "cmax": float(np.log10(highest)),
            "colorbar": {
                "title": "mm",
                "tickvals": [float(np.log10(v)) for v in thirds()],
                "ticktext": [f"{v:g}" for v in thirds()],
            },
        }
    )
    return laid_out(figure, 300)


def profiles(series: Sequence[Series]) -> go.Figure:
    """Error by arc length, by phase and by frequency over all trials, with the noise."""
    figure = make_subplots(
        1,
        3,
        subplot_titles=(
            "by place on the cable, mm rms",
            "by phase of the motion, mm rms",
            "by frequency, mm/√Hz",
        ),
    )
    comparison = series[0].comparison
    phases = [p for p in PHASES if any(np.isfinite(w.by_phase[p]) for w in comparison.where)]
    for s in series:
        _profile_traces(figure, s, phases)
    spectrum = comparison.where[0].spectrum
    figure.add_scatter(
        x=listed(spectrum.frequency_hz, 2),
        y=listed(1e3 * np.sqrt(spectrum.noise_m2_per_hz), 6),
        mode="lines",
        line={"color": NOISE, "dash": "dash"},
        name=noise_label(comparison.noise_is_stated),
        row=1,
        col=3,
    )
    for column in (1, 2):
        figure.add_hline(
            y=comparison.noise_m * 1e3, line_dash="dash", line_color=NOISE, row=1, col=column
        )
        shown = [np.array(t.y, dtype=float) for t in figure.select_traces(row=1, col=column)]
        logarithmic(figure, [*shown, np.array([comparison.noise_m * 1e3])], row=1, col=column)
    length = comparison.study.cable.length_m * 1e3
    reach = [-0.05 * length, 1.05 * length]
    figure.update_xaxes(title="from the grip, mm", range=reach, row=1, col=1)
    figure.update_xaxes(type="log", title="Hz", tickvals=[0.1, 1, 10, 100, 1000], row=1, col=3)
    figure.update_yaxes(type="log", tickvals=thirds(), tickformat="~g", row=1, col=3)
    return laid_out(figure, 380)


def _profile_traces(figure: go.Figure, s: Series, phases: Sequence[str]) -> None:
    """Errors of one model by place, phase and frequency."""
    wheres = s.comparison.where
    style = {"color": s.colour, "width": s.width}
    shared = {"name": s.name, "legendgroup": s.name}
    figure.add_scatter(
        x=listed(wheres[0].by_arc_length.centre * 1e3, 2),
        y=in_mm(rms_over([w.by_arc_length.rms_m for w in wheres])),
        mode="lines+markers",
        line=style,
        marker={"size": s.size - 2.0},
        **shared,
        row=1,
        col=1,
    )
    figure.add_scatter(
        x=phases,
        y=in_mm(rms_over([[w.by_phase[p] for p in phases] for w in wheres])),
        mode="markers",
        marker={"color": s.colour, "size": s.size},
        showlegend=False,
        **shared,
        row=1,
        col=2,
    )
    grid, spectra = wheres[0].spectrum.frequency_hz, [w.spectrum for w in wheres]
    power = [np.interp(grid, p.frequency_hz, p.residual_m2_per_hz) for p in spectra]
    density = 1e3 * np.sqrt(np.mean(power, axis=0))
    figure.add_scatter(
        x=listed(grid, 2),
        y=listed(density, 6),
        line=style,
        mode="lines",
        showlegend=False,
        **shared,
        row=1,
        col=3,
    )
