"""The lab's reports, each one HTML page that is readable without a network."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cell.files.figure_style import ADDED, BETWEEN, MODEL
from cell.files.page import HtmlTable, Plot, page
from cell.identify.identified import Identified
from cell.lab.data.results import Diagnosis
from cell.lab.next.advice import STATUSES, Step, meaning
from cell.lab.report.cable_overlay import overlay
from cell.lab.report.curves import profile_curves
from cell.lab.report.figures import by_trial, history, profiles, ranking, residual_maps, waterfall
from cell.lab.report.model_tables import comparison_sentence
from cell.lab.report.series import Series
from cell.lab.report.tables import sentence, warning_lines
from cell.lab.report.wording import (
    AGREEMENT_NOTE,
    CHECK_HEADS,
    CHECK_NOTE,
    LIMIT_HEADS,
    LIMIT_NOTE,
    NEAREST_HEADS,
    agreement_heads,
    agreement_rows,
    agreement_sentence,
    by_evidence,
    chance,
    check_rows,
    correlation,
    digits,
    left_in_words,
    limit_rows,
    nearest_note,
    nearest_rows,
    noise_in_words,
    noise_label,
    places,
)
from cell.lab.strength.compare import NOTICEABLE, Comparison
from cell.lab.strength.profiles import ParameterProfile, profile_sentences
from cell.lab.strength.trial_residual import TrialResidual

#: Signals that a residual goes with, listed if the correlation is at least this.
LEAST_CORRELATION = 0.2
#: Models drawn over another for which it is drawn larger, at most.
MOST_ABOVE = 3

_TEMPLATES = Path(__file__).parent / "templates"


@dataclass(frozen=True)
class _Part:
    """A table of a page with its title, a sentence above and a note below."""

    title: str
    table: HtmlTable
    note: str
    says: str = ""


@dataclass(frozen=True)
class _Law:
    """The law of an effect, as its file states it."""

    effect: str
    first: str
    others: Sequence[str]


@dataclass(frozen=True)
class _Where:
    """Profiles of an error over all trials, and a line for each."""

    profiles: Plot
    table: HtmlTable


@dataclass(frozen=True)
class _Trial:
    """Overlay and residual maps of a trial."""

    name: str
    note: str
    chosen: bool
    overlay: Plot
    maps: Plot


def diagnosis_page(
    diagnosis: Diagnosis,
    comparisons: Sequence[Comparison],
    model: Identified,
    steps: Sequence[Step],
) -> str:
    """Report of a diagnosis.

    comparisons  of the baseline, then with each effect added
    model        the last of these
    steps        what to do next
    """
    first, last = comparisons[0], comparisons[-1]
    series = [Series("model", "of the model", MODEL, first)]
    if last is not first:
        name = f"with {_names(diagnosis)}"
        series = [replace(series[0], above=1), Series(name, name, ADDED, last)]
    return page(
        _TEMPLATES,
        "diagnosis.html",
        f"Diagnosis of {first.study.name}",
        says=sentence(diagnosis, first, last),
        told=diagnosis.verdict in ("complete", "missing"),
        facts=_facts(first),
        verdict=diagnosis.verdict,
        meaning=meaning(diagnosis),
        warnings=warning_lines(diagnosis.warnings),
        steps=steps,
        waterfall=Plot.of(waterfall(diagnosis)),
        nearest=_nearest(diagnosis),
        nearest_note=nearest_note(diagnosis),
        laws=_laws(diagnosis, model),
        parameters=_parameters(diagnosis),
        ranking=Plot.of(ranking(diagnosis)) if diagnosis.ranking else None,
        effects=_everything(diagnosis),
        statuses=_statuses(diagnosis),
        parts=_parts(diagnosis),
        left=_where(series),
        shown=_trials(series),
        cable=_cable(model),
    )


def comparison_page(comparisons: Sequence[Comparison]) -> str:
    """Report of models beside each other, in the order in which they were made."""
    first, last = comparisons[0], comparisons[-1]
    series = _series(comparisons)
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
        shown=_trials(ends),
    )


def profile_page(study: str, found: Sequence[ParameterProfile]) -> str:
    """Page of a model's profile likelihoods: curves, and intervals beside those of the fit."""
    rows = [
        [
            p.name,
            digits(p.fitted, 4),
            _range(*p.wald),
            digits(p.value, 4),
            _range(p.low, p.high),
            p.unit,
        ]
        for p in found
    ]
    heads = ("parameter", "fitted", "95 % by curvature", "likeliest", "95 % by profile", "unit")
    return page(
        _TEMPLATES,
        "profiles.html",
        f"Profiles of {study}",
        remarks=profile_sentences(found),
        curves=Plot.of(profile_curves(found)),
        profiles=HtmlTable(heads, rows, (1, 2, 3, 4)),
    )


def _range(low: float, high: float) -> str:
    shown = [digits(v, 4) if np.isfinite(v) else "open" for v in (low, high)]
    return " … ".join(shown)


def _series(comparisons: Sequence[Comparison]) -> list[Series]:
    """Models under the names and in the colours of all figures; the last is the one to believe."""
    if len(comparisons) == 1:
        return [Series("model", "of the model", MODEL, comparisons[0])]
    colours = [MODEL, *(BETWEEN[i % len(BETWEEN)] for i in range(len(comparisons) - 2)), ADDED]
    last = len(comparisons) - 1
    return [
        Series(c.model, f"of {c.model}", colour, c, above=min(last - i, MOST_ABOVE))
        for i, (c, colour) in enumerate(zip(comparisons, colours, strict=True))
    ]


def _models(comparisons: Sequence[Comparison]) -> HtmlTable:
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
    return HtmlTable(heads, rows, (2, 3, 4, 5))


def _names(diagnosis: Diagnosis) -> str:
    return " and ".join(f.effect.replace("_", " ") for f in diagnosis.missing)


def _facts(comparison: Comparison) -> str:
    study = comparison.study
    markers = len(study.arc_length_m)
    counts = f"{len(study.role('fit'))} fitted, {len(study.role('validate'))} held out"
    return (
        f"{len(study.trials)} trials ({counts}), {markers} "
        f"marker{'s' * (markers > 1)} on {study.cable.free_length_m * 1e3:.0f} mm of cable; "
        f"{noise_in_words(comparison)}. Errors are rms per coordinate."
    )


def _where(series: Sequence[Series]) -> _Where:
    """Profiles over all trials, and a line for each."""
    heads = ["trial", "used", *(f"{s.name}, mm" for s in series), "what is left", "it goes with"]
    rows = []
    for i, trial in enumerate(series[0].comparison.study.trials):
        wheres = [s.comparison.where[i] for s in series]
        role = "fitted" if trial.role == "fit" else "held out"
        errors = [f"{w.rms_m * 1e3:.3f}" for w in wheres]
        last = wheres[-1]
        left = left_in_words(last, series[-1].comparison)
        rows.append([trial.name, role, *errors, left, _goes_with(wheres[0])])
    numbers = range(2, 2 + len(series))
    return _Where(Plot.of(profiles(series)), HtmlTable(heads, rows, numbers))


def _goes_with(where: TrialResidual) -> str:
    found = [
        f"{f.signal} ({correlation(f.correlation)}{'*' if f.p_value < NOTICEABLE else ''})"
        for f in where.correlations
        if abs(f.correlation) >= LEAST_CORRELATION
    ]
    return ", ".join(found[:2]) or "–"


def _trials(series: Sequence[Series]) -> list[_Trial]:
    """Overlay and residual maps of every trial; one is shown at a time, at first the worst."""
    comparison = series[0].comparison
    worst = int(np.argmax([w.rms_m if np.isfinite(w.rms_m) else 0.0 for w in comparison.where]))
    found = []
    for i, trial in enumerate(comparison.study.trials):
        role = "fitted" if trial.role == "fit" else "held out"
        note = f"{role}, largest error" if i == worst else role
        figures = Plot.of(overlay(series, i)), Plot.of(residual_maps(series, i))
        found.append(_Trial(trial.name, note, i == worst, *figures))
    return found


def _parameters(diagnosis: Diagnosis) -> HtmlTable:
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
    return HtmlTable(["effect", "parameter", "value", "95 % interval", "unit"], rows, (2, 3))


def _laws(diagnosis: Diagnosis, model: Identified) -> list[_Law]:
    """The law of each accepted effect."""
    accepted = {f.effect for f in diagnosis.missing}
    laws = []
    for effect in model.space.effects:
        if effect.name in accepted:
            first, *others = inspect.cleandoc(effect.__doc__ or "").split("\n\n")
            laws.append(_Law(effect.name, first, others))
    return laws


def _everything(diagnosis: Diagnosis) -> HtmlTable:
    """The evidence for every effect."""
    rows = [
        [r.effect, places(r.score, 1), chance(r.p_value), r.status.replace("_", " ")]
        for r in by_evidence(diagnosis)
    ]
    return HtmlTable(["effect", "χ² explained", "p", "status"], rows, (1, 2))


def _statuses(diagnosis: Diagnosis) -> str:
    """What the statuses in that table mean."""
    shown = dict.fromkeys(r.status for r in diagnosis.ranking)
    return "; ".join(f"{s.replace('_', ' ')}: {STATUSES[s]}" for s in shown)


def _nearest(diagnosis: Diagnosis) -> HtmlTable | None:
    """Of an unexplained study: the effects that leave least."""
    if not diagnosis.nearest:
        return None
    return HtmlTable(NEAREST_HEADS, nearest_rows(diagnosis), (1, 2, 3))


def _parts(diagnosis: Diagnosis) -> list[_Part]:
    """What the verdict rests on, what the study excludes, and whether its trials agree."""
    parts = []
    if diagnosis.checks:
        checks = HtmlTable(CHECK_HEADS, check_rows(diagnosis.checks), (1, 2))
        parts.append(_Part("What the verdict rests on", checks, CHECK_NOTE))
    if diagnosis.limits:
        limits = HtmlTable(LIMIT_HEADS, limit_rows(diagnosis), (2, 3))
        parts.append(_Part("What the study excludes", limits, LIMIT_NOTE))
    if found := diagnosis.agreement:
        numbers = range(1, len(found) + 1)
        table = HtmlTable(agreement_heads(found), agreement_rows(found), numbers)
        said = agreement_sentence(found)
        parts.append(_Part("Estimates per trial", table, AGREEMENT_NOTE, said))
    return parts


def _cable(model: Identified) -> HtmlTable:
    low, high = model.interval()
    rows = [
        [name, digits(value, 4), _range(lo, hi), unit]
        for name, value, lo, hi, unit in zip(
            model.space.names, model.values, low, high, model.space.units, strict=True
        )
    ]
    return HtmlTable(["parameter", "value", "95 % interval", "unit"], rows, (1, 2))
