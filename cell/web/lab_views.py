"""Rows and charts of the lab's page, as plain data, from the files that commands wrote."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cell.files.input_error import InputError
from cell.files.words import with_prefix
from cell.files.yaml_document import read_yaml
from cell.web.theme import N_
from cell.web.wording import Translate

Data = Mapping[str, Any]
Option = dict[str, Any]

#: Largest result that is shown, bytes: a comparison has some 30 kB a trial.
_MOST_BYTES = 20 << 20
#: Colours of models, in their order; readable on light and dark.
_COLOURS = ("#8a94a3", "#0b7fab", "#e08a00", "#7a5cc0", "#2c9e4b", "#c2410c")
_FITTED, _HELD_OUT = "#8fb8d9", "#0b57a4"

VERDICTS = {
    "complete": N_("Complete: what the model leaves is noise."),
    "missing": N_("Missing: the effects named are confirmed on motions not fitted to."),
    "unexplained": N_("Unexplained: something is missing, and no effect explains it."),
    "cannot_tell": N_("Cannot tell: these trials cannot decide."),
}
#: Views of a model's errors: their headings; x, y, factor of x, label of x.
PLACES = {
    "by_time": (N_("By time"), "t_s", "rms_m", 1.0, N_("Time, s")),
    "by_arc_length": (
        *(N_("By arc length"), "arc_length_m", "rms_m", 1e3),
        N_("Arc length, mm"),
    ),
    "by_frequency": (
        *(N_("By frequency"), "frequency_hz", "residual_m2_per_hz", 1.0),
        N_("Frequency, Hz"),
    ),
}


_STATED = N_("Not tested: the study states its noise, and is tested against that.")
_SLOW = N_("Not tested: the noise is stated, or the frames do not show slow errors apart from it.")
_NO_EFFECT = N_("Not tested: no effect was added to the baseline.")
_OTHER = N_("Not tested: it does not apply to this study and this model.")
#: Why a check has no result, by its name.
NOT_APPLICABLE = {
    "stated_error": N_("Not tested: the study does not state its noise."),
    "fitted_error": _STATED,
    "heldout_smooth": _SLOW,
    "parameter_constancy": _SLOW,
    "wider_law": N_("Not tested: no effect in the model has a wider law that these trials show."),
    "residual_level": _STATED,
    "earlier_model": N_("Not tested: no earlier cable's model is the reference."),
    "confirmation": _NO_EFFECT,
    "heldout_insensitive": N_("Not tested: no effect was added, or no trial is held out."),
    "ties": _NO_EFFECT,
    "weakly_identified": _NO_EFFECT,
    "prior_driven": N_("Not tested: no effect was added, or no prior was used."),
    "possibly_omitted": N_("Not tested: the noise was not measured, or the error is below it."),
    "noise_unknown": N_("Not tested: an effect was added, or the noise is stated."),
}


def read_result(path: Path) -> Data | None:
    """A result that a command wrote as JSON; None = there is none, or it cannot be shown."""
    try:
        if path.stat().st_size > _MOST_BYTES:
            return None
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return data if isinstance(data, dict) else None


def error_steps(diagnosis: Data, t: Translate) -> Option:
    """Error after each added effect, as bars: fitted and held out, mm."""
    steps = [(t("Baseline"), diagnosis["baseline"])]
    steps += [(f"+ {m['effect']}", m) for m in diagnosis["missing"]]
    return error_bars(steps, diagnosis["noise_m"], t)


def model_errors(comparison: Data, t: Translate) -> Option:
    """Errors of the compared models, as bars."""
    models = [(_model_name(m), m) for m in comparison["models"]]
    return error_bars(models, comparison["noise_m"], t)


def _model_name(model: Data) -> str:
    effects = " + ".join(model["effects"])
    return f"{model['name']}\n{effects}" if effects and effects != model["name"] else model["name"]


def error_bars(steps: Sequence[tuple[str, Data]], noise_m: float | None, t: Translate) -> Option:
    """Bars of fit_rms_m and heldout_rms_m, with a line at the noise; the axis is logarithmic."""
    series: list[Option] = [
        {
            "name": name,
            "type": "bar",
            "barMaxWidth": 60,
            "data": [_mm(model.get(key)) for _, model in steps],
            "itemStyle": {"color": colour},
            "label": {"show": True, "position": "top"},
        }
        for name, key, colour in (
            (t("Fitted"), "fit_rms_m", _FITTED),
            (t("Held out"), "heldout_rms_m", _HELD_OUT),
        )
    ]
    shown = [v for s in series for v in s["data"] if v] + [_mm(noise_m) or 1e-3]
    if noise_m:
        series[0]["markLine"] = _noise_mark(_mm(noise_m), t)
    low = 10 ** _floor_log(min(shown) * 0.7)
    return {
        **_frame(t("Error, mm rms per coordinate")),
        "xAxis": {
            "type": "category",
            "data": [name for name, _ in steps],
            "axisLabel": {"interval": 0},
        },
        "yAxis": {**_AXIS, "type": "log", "min": low, "startValue": low},
        "series": series,
    }


def falling_errors(errors: Sequence[Data], t: Translate) -> Option:
    """Errors of models in the order of their fits, and the running minimum, mm."""
    names = [" + ".join(e["effects"]) or t("Baseline") for e in errors]
    errors_mm = [1e3 * float(e["rms_m"]) for e in errors]
    shown = [
        {"name": name, "value": [n, round(e, 4)]}
        for n, (name, e) in enumerate(zip(names, errors_mm, strict=True))
    ]
    least = [[n, round(mm, 4)] for n, mm in enumerate(itertools.accumulate(errors_mm, min))]
    steps = {**_line(t("Least so far"), least, _FITTED), "step": "end"}
    noise_mm = round(1e3 * float(errors[-1]["noise_m"]), 4)
    steps["markLine"] = _noise_mark(noise_mm, t)
    low, high = min(*errors_mm, noise_mm), max(errors_mm)
    scale: Option = {"type": "value", "min": round(0.8 * low, 4), "max": round(1.2 * high, 4)}
    if high > 10.0 * low:
        scale = {"type": "log", "min": 10 ** _floor_log(0.7 * low)}
    return {
        **_frame(t("Error, mm rms per coordinate")),
        "xAxis": {"type": "value", "show": False, "min": 0, "max": max(10, len(errors))},
        "yAxis": {**_AXIS, **scale},
        "series": [
            {
                "type": "scatter",
                "name": t("Each model"),
                "symbolSize": 7,
                "data": shown,
                "itemStyle": {"color": _HELD_OUT},
                "label": {"show": True, "position": "top", "formatter": "{b}", "fontSize": 10},
            },
            steps,
        ],
    }


def failing_places(comparison: Data, place: str, trial: str, t: Translate) -> Option:
    """Errors of models in a trial over time, arc length or frequency."""
    _, x, y, scale, label = PLACES[place]
    lines: list[Option] = []
    spectrum = place == "by_frequency"
    for number, model in enumerate(comparison["models"]):
        trial_data = _trial(model, trial)
        if trial_data is not None:
            points = _points(trial_data[place], x, y, scale, spectrum)
            lines.append(_line(model["name"], points, _COLOURS[number % len(_COLOURS)]))
    first = _trial(comparison["models"][0], trial) if comparison["models"] else None
    if spectrum and first is not None:
        points = _points(first[place], x, "noise_m2_per_hz", scale, True)
        lines.append(_line(t("Noise"), points, "#c2410c", dashed=True))
    unit = t("Error, mm²/Hz") if spectrum else t("Error, mm rms")
    return {
        **_frame(unit),
        "xAxis": {"type": "value", "name": t(label), "nameLocation": "middle", "nameGap": 26},
        "yAxis": {**_AXIS, "type": "log" if spectrum else "value"},
        "series": lines,
    }


def trials_of(comparison: Data) -> list[str]:
    """Names of the trials, held-out ones first: there a model's errors show."""
    trials = sorted(comparison["trials"], key=lambda model: model["role"] == "fit")
    return [str(model["name"]) for model in trials]


def check_rows(diagnosis: Data, t: Translate) -> list[dict[str, str]]:
    """Row of each check: question, statistic, limit, result."""
    signs = {">=": "≥", "<=": "≤"}
    results = {True: t("passed"), False: t("not passed"), None: "–"}
    return [
        {
            "name": c["name"],
            "question": c["question"],
            "statistic": _number(c["statistic"], is_p=c["unit"] == "p"),
            "limit": f"{c['unit']} {signs.get(c['passes'], c['passes'])} {c['limit']:g}",
            "result": results[c["passed"]],
            "passed": str(c["passed"]),
            "said": c["failed"] if c["passed"] is False else _why_none(c, t),
        }
        for c in diagnosis["checks"]
    ]


def _why_none(check: Data, t: Translate) -> str:
    """Why a check has no result; "" = it has one."""
    return t(NOT_APPLICABLE.get(check["name"], _OTHER)) if check["passed"] is None else ""


def ranking_rows(diagnosis: Data) -> list[dict[str, str]]:
    """Row of each effect of the library added to the baseline: χ² explained, p, status."""
    return [
        {
            "effect": r["effect"],
            "score": f"{r['score']:.1f}",
            "p": _number(r["p_value"], is_p=True),
            "status": r["status"],
        }
        for r in diagnosis["ranking"]
    ]


def parameter_lines(diagnosis: Data) -> list[str]:
    """Parameters of the detected effects, with their 95 % intervals."""
    return [
        f"{m['effect']}: {_with_interval(name, p)}"
        for m in diagnosis["missing"]
        for name, p in m["parameters"].items()
    ]


def fitted_lines(model: Data, effect: str) -> list[str]:
    """Parameters of an effect of a fitted model, with their 95 % intervals."""
    return [
        f"{effect}: {_with_interval(p['name'].removeprefix(f'{effect}.'), p)}"
        for p in model["parameters"]
        if p["name"].startswith(f"{effect}.")
    ]


def _with_interval(name: str, parameter: Data) -> str:
    values = [parameter["value"], parameter["low"], parameter["high"]]
    (value, low, high), unit = with_prefix(values, parameter["unit"])
    return f"{name} {value} ({low} … {high}) {unit}"


def candidate_table(
    candidates: Mapping[str, Path], t: Translate
) -> tuple[list[dict[str, Any]], list[dict[str, str]]]:
    """Table of candidates with their gates side by side; unreadable files are marked."""
    columns = [{"name": "gate", "field": "gate", "label": t("Gate"), "align": "left"}]
    rows: dict[str, dict[str, str]] = {"model": {"gate": t("Effects")}}
    rows["verdict"] = {"gate": t("Verdict")}
    for name, path in candidates.items():
        columns.append({"name": name, "field": name, "label": name, "align": "left"})
        try:
            data = read_yaml(path).data
            effects = [e["effect"] for e in data["model"]["effects"]]
            gates = [(str(g["gate"]), bool(g["passed"]), str(g["found"])) for g in data["gates"]]
        except (InputError, LookupError, TypeError) as error:
            rows["model"][name] = f"✗ {error}"
            continue
        rows["model"][name] = ", ".join(Path(e).stem for e in effects)
        rows["verdict"][name] = str(data.get("verdict", "–"))
        for gate, passed, result in gates:
            row = rows.setdefault(f"gate {gate}", {"gate": gate})
            row[name] = f"{'✓' if passed else '✗'} {result}"
    return columns, list(rows.values())


def _trial(model: Data, name: str) -> Data | None:
    return next((trial for trial in model["trials"] if trial["name"] == name), None)


def _points(columns: Data, x: str, y: str, scale: float, spectrum: bool) -> list[list[float]]:
    """Points of a line; a spectrum in mm²/Hz, else mm."""
    factor = 1e6 if spectrum else 1e3
    pairs = zip(columns[x], columns[y], strict=True)
    return [
        [round(at * scale, 5), float(f"{value * factor:.4g}")]
        for at, value in pairs
        if at is not None and value is not None and (value > 0.0 or not spectrum)
    ]


def _line(name: str, points: list[list[float]], colour: str, *, dashed: bool = False) -> Option:
    style = {"color": colour, "width": 2, **({"type": "dashed"} if dashed else {})}
    return {
        "name": name,
        "type": "line",
        "showSymbol": False,
        "data": points,
        "lineStyle": style,
        "itemStyle": {"color": colour},
    }


def _noise_mark(noise_mm: float | None, t: Translate) -> Option:
    label = {"formatter": f"{t('Noise')} {noise_mm}", "position": "insideEndTop"}
    look = {"lineStyle": {"color": "#c2410c", "type": "dashed"}, "label": label}
    return {"silent": True, "symbol": "none", "data": [{"yAxis": noise_mm, **look}]}


def _frame(title: str) -> Option:
    return {
        "animation": False,
        "title": {"text": title, "left": 0, "textStyle": {"fontSize": 13}},
        "grid": {"left": 65, "right": 20, "top": 45, "bottom": 48},
        "legend": {"top": 0, "right": 0},
        "tooltip": {"trigger": "axis"},
    }


_AXIS: Option = {"splitLine": {"lineStyle": {"color": "#8a94a355"}}}


def _mm(value: float | None) -> float | None:
    return None if value is None else float(f"{value * 1e3:.3g}")


def _floor_log(value: float) -> int:
    return math.floor(math.log10(max(value, 1e-9)))


def _number(value: float | None, *, is_p: bool) -> str:
    if value is None:
        return "–"
    return "< 1e-300" if is_p and value == 0.0 else f"{value:.3g}"
