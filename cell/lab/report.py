"""The lab's report: one self-contained HTML page with plotly, readable without a network."""

from __future__ import annotations

import html
import inspect
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots

from cell.lab.compare import Comparison
from cell.lab.diagnose import Examination
from cell.lab.tables import sentence

FloatArray = NDArray[np.float64]

#: Frames that the time slider of an overlay offers.
SLIDER_FRAMES = 60
SEEN, PREDICTED, NOISE = "#d1495b", "#00798c", "#8d99ae"
_STYLE = (
    "body{font-family:system-ui,sans-serif;max-width:1100px;margin:2em auto;color:#222}"
    "h1{font-size:1.4em}h2{font-size:1.1em;margin-top:2em}.says{font-size:1.25em;padding:.8em 1em;"
    "background:#eef4f5;border-left:5px solid #00798c}pre{background:#f6f6f6;padding:.8em;"
    "overflow-x:auto}table{border-collapse:collapse}td,th{padding:.25em .8em;text-align:right;"
    "border-bottom:1px solid #ddd}td:first-child,th:first-child{text-align:left}"
)


def write_page(page: str, path: Path) -> None:
    """Write a page, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.write_text(page, encoding="utf-8")
    part.replace(path)


def diagnosis_page(name: str, examination: Examination, comparisons: Sequence[Comparison]) -> str:
    """Report of a diagnosis.

    comparisons  of the baseline, then with each effect added, as in `examination.steps`
    """
    diagnosis = examination.diagnosis
    first, last = comparisons[0], comparisons[-1]
    parts = [
        f'<p class="says">{html.escape(sentence(diagnosis, first))}</p>',
        "<h2>Error as effects are added</h2>",
        _div(waterfall(examination)),
        "<h2>Which effect</h2>",
        "<p>χ² that each effect explains on the fit trials, alone beside the baseline; "
        "whiskers: two standard deviations.</p>",
        _div(ranking(examination)),
    ]
    if diagnosis.missing:
        parts += ["<h2>Effects accepted</h2>", _parameters(examination), _equations(examination)]
    parts += ["<h2>Overlay</h2>", *_overlays(last)]
    parts.append("<h2>Where the baseline fails</h2>")
    parts += _where(first)
    if last is not first:
        parts.append("<h2>What is left with the effects added</h2>")
        parts += _where(last)
    return _page(f"Diagnosis of {name}", parts)


def comparison_page(comparison: Comparison) -> str:
    """Report of a comparison."""
    says = (
        f"The model misses {comparison.fit_rms_m * 1e3:.2f} mm where it was fitted and "
        f"{comparison.heldout_rms_m * 1e3:.2f} mm where it was not; camera noise is "
        f"{comparison.noise_m * 1e3:.2f} mm."
    )
    parts = [f'<p class="says">{says}</p>', "<h2>Overlay</h2>", *_overlays(comparison)]
    parts += ["<h2>Where it fails</h2>", *_where(comparison)]
    return _page(f"Comparison with {comparison.study.name}", parts)


def waterfall(examination: Examination) -> go.Figure:
    """Held-out (or fitted) error of baseline and each step, and the noise."""
    diagnosis = examination.diagnosis
    names = ["baseline", *(f"+ {f.effect}" for f in diagnosis.missing)]
    errors = [diagnosis.baseline, *(f.errors for f in diagnosis.missing)]
    figure = go.Figure()
    for label, values, colour in (
        ("held-out trials", [e.heldout_rms_m for e in errors], PREDICTED),
        ("fitted trials", [e.fit_rms_m for e in errors], NOISE),
    ):
        shown = [v * 1e3 for v in values]
        text = [f"{v:.3f}" for v in shown]
        figure.add_bar(x=names, y=shown, name=label, marker_color=colour, text=text)
    figure.add_hline(
        y=diagnosis.noise_m * 1e3, line_dash="dash", line_color=SEEN, annotation_text="noise"
    )
    figure.update_layout(yaxis_title="mm rms per coordinate", height=340, barmode="group")
    return figure


def ranking(examination: Examination) -> go.Figure:
    """χ² explained by each effect, with two standard deviations."""
    rows = list(reversed(examination.diagnosis.ranking))
    score = np.array([max(r.score, 0.1) for r in rows])
    reach = 2.0 * np.sqrt(2.0 + 4.0 * score)
    colour = {"present": PREDICTED, "inspect": "#edae49", "absent": NOISE, "cannot_tell": "#c9c9d9"}
    figure = go.Figure(
        go.Bar(
            x=score,
            y=[r.effect for r in rows],
            orientation="h",
            marker_color=[colour[r.status] for r in rows],
            error_x={"type": "data", "array": reach, "arrayminus": np.minimum(reach, 0.9 * score)},
            customdata=[[r.p_value, r.status] for r in rows],
            hovertemplate="%{y}: χ² %{x:.1f}, p %{customdata[0]:.2g}, %{customdata[1]}",
        )
    )
    figure.update_layout(xaxis={"type": "log", "title": "χ² explained"}, height=90 + 24 * len(rows))
    return figure


def overlay(comparison: Comparison, number: int) -> go.Figure:
    """Markers seen and predicted of one trial, with a time slider, and the tip against time."""
    trial = comparison.study.trials[number]
    t_s, seen = trial.markers.t_s, trial.markers.xy_m * 1e3
    model = comparison.predicted_m[trial.name] * 1e3
    figure = make_subplots(1, 2, subplot_titles=("cable, mm", "tip height, mm"))
    shown = np.unique(np.linspace(0, len(t_s) - 1, SLIDER_FRAMES).astype(int))
    for points, name, colour in ((seen, "seen", SEEN), (model, "predicted", PREDICTED)):
        style = {"color": colour}
        figure.add_scatter(
            x=points[0, :, 0],
            y=points[0, :, 1],
            mode="markers" if name == "seen" else "lines+markers",
            name=name,
            marker={"size": 8 if name == "seen" else 4, **style},
            row=1,
            col=1,
        )
        figure.add_scatter(
            x=t_s, y=points[:, 0, 1], mode="lines", line=style, showlegend=False, row=1, col=2
        )
    both = np.concatenate([seen.reshape(-1, 2), model.reshape(-1, 2)])
    low, high = np.nanmin(both, axis=0) - 5.0, np.nanmax(both, axis=0) + 5.0
    figure.update_xaxes(range=[low[0], high[0]], row=1, col=1)
    figure.update_yaxes(range=[low[1], high[1]], scaleanchor="x", row=1, col=1)
    figure.update_xaxes(title="s", row=1, col=2)
    figure.frames = [
        go.Frame(
            name=str(k),
            traces=[0, 2],
            data=[go.Scatter(x=p[k, :, 0], y=p[k, :, 1]) for p in (seen, model)],
        )
        for k in shown
    ]
    still = {"mode": "immediate", "frame": {"duration": 0, "redraw": False}}
    figure.update_layout(
        height=430,
        title=f"{trial.name} ({trial.role})",
        sliders=[
            {
                "currentvalue": {"prefix": "t = ", "suffix": " s"},
                "steps": [
                    {"label": f"{t_s[k]:.3f}", "method": "animate", "args": [[str(k)], still]}
                    for k in shown
                ],
            }
        ],
    )
    return figure


def residual_map(comparison: Comparison, number: int) -> go.Figure:
    """Residual distance of one trial against time and arc length."""
    trial = comparison.study.trials[number]
    left = trial.markers.xy_m - comparison.predicted_m[trial.name]
    figure = go.Figure(
        go.Heatmap(
            x=trial.markers.t_s,
            y=comparison.study.arc_length_m * 1e3,
            z=np.linalg.norm(left, axis=2).T * 1e3,
            colorscale="Viridis",
            zmin=0.0,
            zmax=max(6e3 * comparison.noise_m, float(np.nanpercentile(np.abs(left), 99)) * 1e3),
            colorbar={"title": "mm"},
        )
    )
    figure.update_layout(
        height=260, title=trial.name, xaxis_title="s", yaxis_title="arc length, mm"
    )
    return figure


def profiles(comparison: Comparison) -> go.Figure:
    """Residual by arc length, by phase and by frequency of all trials, against the noise."""
    figure = make_subplots(
        1, 3, subplot_titles=("by arc length, mm", "by phase, mm", "by frequency, m²/Hz")
    )
    palette = ["#00798c", "#d1495b", "#edae49", "#66a182", "#2e4057", "#8d6a9f", "#bb9457"]
    for i, w in enumerate(comparison.where):
        style = {"color": palette[i % len(palette)]}
        shared = {"name": w.trial, "legendgroup": w.trial}
        figure.add_scatter(
            x=w.by_arc_length.centre * 1e3,
            y=w.by_arc_length.rms_m * 1e3,
            mode="lines+markers",
            line=style,
            **shared,
            row=1,
            col=1,
        )
        figure.add_bar(
            x=list(w.by_phase),
            y=[v * 1e3 for v in w.by_phase.values()],
            marker_color=style["color"],
            showlegend=False,
            **shared,
            row=1,
            col=2,
        )
        figure.add_scatter(
            x=w.spectrum.frequency_hz,
            y=w.spectrum.residual,
            line=style,
            showlegend=False,
            **shared,
            row=1,
            col=3,
        )
    spectrum = comparison.where[0].spectrum
    dashed = {"color": "black", "dash": "dash"}
    figure.add_scatter(
        x=spectrum.frequency_hz, y=spectrum.noise, line=dashed, name="noise", row=1, col=3
    )
    for column in (1, 2):
        figure.add_hline(y=comparison.noise_m * 1e3, line_dash="dash", row=1, col=column)
    figure.update_xaxes(type="log", title="Hz", row=1, col=3)
    figure.update_yaxes(type="log", row=1, col=3)
    figure.update_xaxes(title="mm", row=1, col=1)
    figure.update_layout(height=380)
    return figure


def _overlays(comparison: Comparison) -> list[str]:
    worst = int(np.argmax([w.rms_m for w in comparison.where]))
    count = len(comparison.study.trials)
    order = [worst, *(i for i in range(count) if i != worst)]
    first, *others = [_div(overlay(comparison, i)) for i in order]
    return [first, f"<details><summary>other trials</summary>{''.join(others)}</details>"]


def _where(comparison: Comparison) -> list[str]:
    rows = "".join(
        f"<tr><td>{html.escape(w.trial)}</td><td>{w.rms_m * 1e3:.3f}</td>"
        f"<td>{w.whiteness_p_value:.1g}</td><td>"
        + ", ".join(f"{f.signal} {f.correlation:+.2f}" for f in w.follows[:3])
        + "</td></tr>"
        for w in comparison.where
    )
    maps = "".join(_div(residual_map(comparison, i)) for i in range(len(comparison.where)))
    return [
        _div(profiles(comparison)),
        "<table><tr><th>trial</th><th>mm rms</th><th>p (white)</th><th>tip residual goes with</th>"
        f"</tr>{rows}</table>",
        f"<details><summary>residual maps</summary>{maps}</details>",
    ]


def _parameters(examination: Examination) -> str:
    rows = "".join(
        f"<tr><td>{f.effect}</td><td>{name}</td><td>{p.value:.4g}</td>"
        f"<td>{p.low:.4g} … {p.high:.4g}</td><td>{p.unit}</td></tr>"
        for f in examination.diagnosis.missing
        for name, p in f.parameters.items()
    )
    head = "<tr><th>effect</th><th>parameter</th><th>value</th><th>95 %</th><th>unit</th></tr>"
    return f"<table>{head}{rows}</table>"


def _equations(examination: Examination) -> str:
    accepted = {f.effect for f in examination.diagnosis.missing}
    return "".join(
        f"<h3>{e.name}</h3><pre>{html.escape(inspect.cleandoc(e.__doc__ or ''))}</pre>"
        for e in examination.steps[-1].effects
        if e.name in accepted
    )


def _div(figure: go.Figure) -> str:
    figure.update_layout(
        template="plotly_white", margin={"l": 60, "r": 20, "t": 50, "b": 50}, font={"size": 12}
    )
    return str(figure.to_html(full_html=False, include_plotlyjs=False, auto_play=False))


def _page(title: str, parts: Sequence[str]) -> str:
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}'
        f"</title><style>{_STYLE}</style><script>{get_plotlyjs()}</script></head><body>"
        f"<h1>{html.escape(title)}</h1>{''.join(parts)}</body></html>\n"
    )
