"""The lab's reports, each one HTML page that is readable without a network."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cell.files.figure_style import ADDED, BETWEEN, MODEL
from cell.files.page import Plot, page
from cell.files.table import TableData
from cell.files.words import counted
from cell.identify.identified import Identified
from cell.lab.data.results import Diagnosis
from cell.lab.next.advice import NextStep, meaning
from cell.lab.report.cable_overlay import overlay
from cell.lab.report.figures import (
    Series,
    by_trial,
    fit_history,
    history,
    profile_curves,
    profiles,
    ranking,
    residual_maps,
    waterfall,
)
from cell.lab.report.model_tables import comparison_sentence, model_table
from cell.lab.report.tables import (
    agreement_table,
    checks_table,
    knots_lines,
    limits_table,
    nearest_table,
    ranking_table,
    sentence,
    warning_lines,
)
from cell.lab.report.wording import (
    agreement_sentence,
    catalogue_entry,
    correlation,
    digits,
    noise_in_words,
    noise_label,
    plain,
    residual_in_words,
)
from cell.lab.report.wrench_report import wrench_overlay, wrenches_table
from cell.lab.strength.compare import NOTICEABLE, Comparison, TrialResidual
from cell.lab.strength.profiles import ParameterProfile, profile_sentences
from cell.study.facts import sensors_in_words

#: Smallest correlation of a residual with a listed signal.
LEAST_CORRELATION = 0.2
#: Most models drawn over another that enlarge it.
MOST_ABOVE = 3

_TEMPLATES = Path(__file__).parent / "templates"


def diagnosis_page(
    diagnosis: Diagnosis,
    comparisons: Sequence[Comparison],
    model: Identified,
    steps: Sequence[NextStep],
) -> str:
    """Report of a diagnosis.

    comparisons  of the baseline, then with each effect added
    model        the last of these
    steps        what to do next
    """
    first, last = comparisons[0], comparisons[-1]
    series = [Series("model", "of the model", MODEL, first)]
    if last is not first:
        name = f"with {' and '.join(plain(f.effect) for f in diagnosis.missing)}"
        series = [replace(series[0], above=1), Series(name, name, ADDED, last)]
    return page(
        _TEMPLATES,
        "diagnosis.html",
        f"Diagnosis of {first.study.name}",
        says=sentence(diagnosis, first, last),
        told=diagnosis.verdict in ("complete", "missing"),
        facts=" ".join([_facts(first), *knots_lines(diagnosis.knots)]),
        verdict=diagnosis.verdict,
        meaning=meaning(diagnosis),
        warnings=warning_lines(diagnosis.warnings),
        steps=steps,
        waterfall=Plot.of(waterfall(diagnosis)),
        fitted=Plot.of(fit_history(diagnosis)) if len(diagnosis.fit_errors) > 1 else None,
        nearest=nearest_table(diagnosis) if diagnosis.nearest else None,
        laws=_laws(diagnosis, model),
        parameters=_parameters(diagnosis),
        ranking=Plot.of(ranking(diagnosis)) if diagnosis.ranking else None,
        effects=ranking_table(diagnosis),
        agreement=agreement_sentence(diagnosis.agreement),
        tables=[
            checks_table(diagnosis.checks) if diagnosis.checks else None,
            limits_table(diagnosis) if diagnosis.limits else None,
            agreement_table(diagnosis.agreement) if diagnosis.agreement else None,
        ],
        left=_where(series),
        shown=_trials(series),
        cable=model_table(model, "the fit trials"),
    )


def comparison_page(comparisons: Sequence[Comparison]) -> str:
    """Report of models side by side, in the order in which they were made."""
    first, last = comparisons[0], comparisons[-1]
    series = series_of(comparisons)
    ends = series if len(series) < 3 else [series[0], series[-1]]
    several = last is not first
    return page(
        _TEMPLATES,
        "comparison.html",
        f"Comparison with {first.study.name}",
        says=comparison_sentence(comparisons),
        facts=_facts(first),
        several=several,
        history=Plot.of(history(comparisons)) if several else None,
        models=_models(comparisons),
        by_trial=Plot.of(by_trial(series)) if several else None,
        left=_where(series),
        wrenches=wrenches_table(comparisons),
        entries=catalogue_entry([e for c in comparisons for e in c.effects]),
        shown=_trials(ends),
    )


def profile_page(study: str, profiles: Sequence[ParameterProfile]) -> str:
    """Page of a model's profile likelihoods: curves, and intervals next to those of the fit."""
    rows = [
        [
            p.name,
            digits(p.fitted, 4),
            _range(*p.wald),
            digits(p.value, 4),
            _range(p.low, p.high),
            p.unit,
        ]
        for p in profiles
    ]
    heads = ("parameter", "fitted", "95 % by curvature", "likeliest", "95 % by profile", "unit")
    return page(
        _TEMPLATES,
        "profiles.html",
        f"Profiles of {study}",
        remarks=profile_sentences(profiles),
        curves=Plot.of(profile_curves(profiles)),
        profiles=TableData("", heads, rows, (1, 2, 3, 4)),
    )


def _range(low: float, high: float) -> str:
    shown = [digits(v, 4) if np.isfinite(v) else "open" for v in (low, high)]
    return " … ".join(shown)


def series_of(comparisons: Sequence[Comparison]) -> list[Series]:
    """Models with the names and colours of all figures; the last one is the result."""
    if len(comparisons) == 1:
        return [Series("model", "of the model", MODEL, comparisons[0])]
    colours = [MODEL, *(BETWEEN[i % len(BETWEEN)] for i in range(len(comparisons) - 2)), ADDED]
    last = len(comparisons) - 1
    return [
        Series(c.model, f"of {c.model}", colour, c, above=min(last - i, MOST_ABOVE))
        for i, (c, colour) in enumerate(zip(comparisons, colours, strict=True))
    ]


def _models(comparisons: Sequence[Comparison]) -> TableData:
    """Errors of models as numbers."""
    first = comparisons[0]
    over = f"over {noise_label(first.noise_is_stated)}"
    heads = ["model", "effects", "fitted, mm", "held out, mm", over, "beyond it, mm"]
    rows = [
        [
            c.model,
            ", ".join(c.effects) or "none",
            f"{c.fit_rms_m * 1e3:.4f}",
            "–" if np.isnan(c.heldout_rms_m) else f"{c.heldout_rms_m * 1e3:.4f}",
            f"{c.error_m / c.noise_m:.2f}",
            f"{np.sqrt(max(c.error_m**2 - c.noise_m**2, 0.0)) * 1e3:.4f}",
        ]
        for c in comparisons
    ]
    return TableData("", heads, rows, (2, 3, 4, 5))


def _facts(comparison: Comparison) -> str:
    study = comparison.study
    markers = len(study.arc_length_m)
    sensors = sensors_in_words(study.trials)
    counts = f"{len(study.role('fit'))} fitted, {len(study.role('validate'))} held out"
    return (
        f"{counted(len(study.trials), 'trial')} ({counts}), {counted(markers, 'marker')} on "
        f"{study.cable.free_length_m * 1e3:.0f} mm of cable; "
        f"{noise_in_words(comparison)}{sensors and f'; {sensors}'}. Errors are rms per coordinate."
    )


def _where(series: Sequence[Series]) -> dict[str, Plot | TableData]:
    """Profiles over all trials, and a line for each."""
    heads = ["trial", "used", *(f"{s.name}, mm" for s in series), "what is left", "it goes with"]
    rows = []
    for i, trial in enumerate(series[0].comparison.study.trials):
        wheres = [s.comparison.where[i] for s in series]
        role = "fitted" if trial.role == "fit" else "held out"
        errors = [f"{w.rms_m * 1e3:.3f}" for w in wheres]
        last = wheres[-1]
        residual = residual_in_words(last, series[-1].comparison)
        rows.append([trial.name, role, *errors, residual, _goes_with(wheres[0])])
    numbers = range(2, 2 + len(series))
    table = TableData("", heads, rows, numbers)
    return {"profiles": Plot.of(profiles(series)), "table": table}


def _goes_with(where: TrialResidual) -> str:
    signals = [
        f"{f.signal} ({correlation(f.correlation)}{'*' if f.p_value < NOTICEABLE else ''})"
        for f in where.correlations
        if abs(f.correlation) >= LEAST_CORRELATION
    ]
    return ", ".join(signals[:2]) or "–"


def _trials(series: Sequence[Series]) -> list[dict[str, object]]:
    """Overlay and residual maps of every trial; one is shown at a time, the worst first."""
    comparison = series[0].comparison
    worst = int(np.argmax([w.rms_m if np.isfinite(w.rms_m) else 0.0 for w in comparison.where]))
    trials: list[dict[str, object]] = []
    for i, trial in enumerate(comparison.study.trials):
        role = "fitted" if trial.role == "fit" else "held out"
        wrench = wrench_overlay(series, trial.name)
        trials.append(
            {
                "name": trial.name,
                "note": f"{role}, largest error" if i == worst else role,
                "chosen": i == worst,
                "overlay": Plot.of(overlay(series, i)),
                "maps": Plot.of(residual_maps(series, i)),
                "wrench": None if wrench is None else Plot.of(wrench),
            }
        )
    return trials


def _parameters(diagnosis: Diagnosis) -> TableData:
    rows = [
        [
            " or ".join((f.effect, *f.tied_with)),
            name,
            digits(p.value, 4),
            _range(p.low, p.high),
            p.unit,
        ]
        for f in diagnosis.missing
        for name, p in f.parameters.items()
    ]
    heads = ["effect", "parameter", "value", "95 % interval, all trials", "unit"]
    return TableData("", heads, rows, (2, 3))


def _laws(diagnosis: Diagnosis, model: Identified) -> list[dict[str, object]]:
    """The law of each accepted effect from its file, and its entry of the manual."""
    accepted, laws = {f.effect for f in diagnosis.missing}, list[dict[str, object]]()
    for effect in (e for e in model.space.effects if e.name in accepted):
        first, *others = inspect.cleandoc(effect.__doc__ or "").split("\n\n")
        entry = catalogue_entry([effect.name])
        laws.append({"effect": effect.name, "first": first, "others": others, "entry": entry})
    return laws
