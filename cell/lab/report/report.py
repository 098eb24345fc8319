"""The lab's reports, each one HTML page that is readable without a network."""

from __future__ import annotations

import html
import inspect
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cell.identify.identified import Identified
from cell.lab.data.results import Diagnosis
from cell.lab.next.advice import STATUSES, Step, meaning
from cell.lab.report.cable_overlay import overlay
from cell.lab.report.curves import profile_curves
from cell.lab.report.figure_layout import ADDED, BETWEEN, MODEL, Series
from cell.lab.report.figures import by_trial, history, profiles, ranking, residual_maps, waterfall
from cell.lab.report.html_page import html_code, html_page, html_plot, html_table
from cell.lab.report.model_tables import comparison_sentence
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
from cell.lab.verdict.diagnose import Examination

#: Signals that a residual goes with, listed if the correlation is at least this.
LEAST_CORRELATION = 0.2
#: Models drawn over another for which it is drawn larger, at most.
MOST_ABOVE = 3

_FAILS = "Where the model fails"


def diagnosis_page(
    examination: Examination,
    comparisons: Sequence[Comparison],
    model: Identified,
    steps: Sequence[Step],
) -> str:
    """Report of a diagnosis.

    comparisons  of the baseline, then with each effect added, as in `examination.steps`
    model        the last of these
    steps        what to do next
    """
    diagnosis = examination.diagnosis
    first, last = comparisons[0], comparisons[-1]
    series = [Series("model", "of the model", MODEL, first)]
    if last is not first:
        name = f"with {_names(examination)}"
        series = [replace(series[0], above=1), Series(name, name, ADDED, last)]
    says = html.escape(sentence(diagnosis, first, last))
    look = "says" if diagnosis.verdict in ("complete", "missing") else "says bad"
    parts = [
        f'<p class="{look}">{says}</p>',
        _facts(first),
        f'<p class="note">Verdict <code>{diagnosis.verdict}</code>: '
        f"{html.escape(meaning(diagnosis))}.</p>",
        *(f'<p class="warning">{html_code(w)}</p>' for w in warning_lines(diagnosis.warnings)),
        _next(steps),
        "<h2>Error as effects are added</h2>",
        html_plot(waterfall(diagnosis)),
        *_nearest(diagnosis),
    ]
    if diagnosis.missing:
        parts += ["<h2>What is missing</h2>", _parameters(examination), _laws(examination)]
    parts += [
        *_evidence(examination),
        *_checks(diagnosis),
        *_limits(diagnosis),
        *_agreement(diagnosis),
        f"<h2>{'What is left' if diagnosis.verdict == 'complete' else _FAILS}</h2>",
        *_where(series),
        "<h2>Trial by trial</h2>",
        *_trials(series),
        "<h2>The cable</h2>",
        _cable(model),
    ]
    return html_page(f"Diagnosis of {first.study.name}", parts)


def comparison_page(comparisons: Sequence[Comparison]) -> str:
    """Report of models beside each other, in the order in which they were made."""
    first, last = comparisons[0], comparisons[-1]
    series = _series(comparisons)
    ends = series if len(series) < 3 else [series[0], series[-1]]
    parts = [f'<p class="says">{html.escape(comparison_sentence(comparisons))}</p>', _facts(first)]
    if last is not first:
        parts += [
            "<h2>Error as effects are added</h2>",
            html_plot(history(comparisons)),
            _models(comparisons),
            "<h2>Error on every trial</h2>",
            html_plot(by_trial(series)),
        ]
    parts += [f"<h2>{_FAILS}</h2>", *_where(series), "<h2>Trial by trial</h2>", *_trials(ends)]
    return html_page(f"Comparison with {first.study.name}", parts)


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
    said = "".join(f"<p>{html.escape(s)}.</p>" for s in profile_sentences(found))
    parts = [
        '<p class="note">Each parameter is held at values near its best one, and all others are '
        "refitted. The rise of −2 ln likelihood reaches 3.84, dashed, at the ends of its 95 % "
        "interval. Where the dotted parabola differs, the fit's own intervals are wrong too. "
        "Diamonds: another parameter is at its bound, so the curve does not come from the "
        "measurement alone. A residual beyond noise reduces the weight of every frame, and "
        "increases that of the prior. So the likeliest value may differ from the fitted one.</p>",
        said,
        html_plot(profile_curves(found)),
        html_table(
            ["parameter", "fitted", "95 % by curvature", "likeliest", "95 % by profile", "unit"],
            rows,
            (1, 2, 3, 4),
        ),
    ]
    return html_page(f"Profiles of {study}", parts)


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


def _models(comparisons: Sequence[Comparison]) -> str:
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
    return html_table(heads, rows, (2, 3, 4, 5))


def _names(examination: Examination) -> str:
    return " and ".join(f.effect.replace("_", " ") for f in examination.diagnosis.missing)


def _facts(comparison: Comparison) -> str:
    study = comparison.study
    markers = len(study.arc_length_m)
    counts = f"{len(study.role('fit'))} fitted, {len(study.role('validate'))} held out"
    return (
        f'<p class="facts">{len(study.trials)} trials ({counts}), {markers} '
        f"marker{'s' * (markers > 1)} on {study.cable.free_length_m * 1e3:.0f} mm of cable; "
        f"{noise_in_words(comparison)}. Errors are rms per coordinate.</p>"
    )


def _where(series: Sequence[Series]) -> list[str]:
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
    return [
        html_plot(profiles(series)),
        html_table(heads, rows, numbers),
        '<p class="note">“It goes with”: signals with which the tip’s error of the first model '
        "is most correlated (* = beyond chance).</p>",
    ]


def _goes_with(where: TrialResidual) -> str:
    found = [
        f"{f.signal} ({correlation(f.correlation)}{'*' if f.p_value < NOTICEABLE else ''})"
        for f in where.correlations
        if abs(f.correlation) >= LEAST_CORRELATION
    ]
    return ", ".join(found[:2]) or "–"


def _trials(series: Sequence[Series]) -> list[str]:
    """Overlay and residual maps of every trial, one shown at a time, the worst one first."""
    comparison = series[0].comparison
    worst = int(np.argmax([w.rms_m if np.isfinite(w.rms_m) else 0.0 for w in comparison.where]))
    options, parts = [], []
    for i, trial in enumerate(comparison.study.trials):
        name, chosen = html.escape(trial.name), i == worst
        role = "fitted" if trial.role == "fit" else "held out"
        note = f"{role}{', largest error' if chosen else ''}"
        picked, hidden = (" selected", "") if chosen else ("", " hidden")
        options.append(f'<option value="{name}"{picked}>{name} ({note})</option>')
        parts.append(
            f'<div class="trial" data-trial="{name}"{hidden}>'
            f"{html_plot(overlay(series, i))}{html_plot(residual_maps(series, i))}</div>"
        )
    choice = f'<p><label>Trial: <select id="chooser">{"".join(options)}</select></label></p>'
    note = (
        '<p class="note">Move the slider or press ▶. The thick lines lead from each measured point '
        "towards that of the model, enlarged by the factor given. Grey band: twice the "
        "noise. In the maps white is noise, colours are logarithmic, and the hand moves "
        "between the dotted lines.</p>"
    )
    return [choice, note, *parts]


def _parameters(examination: Examination) -> str:
    rows = [
        [
            " or ".join((f.effect, *f.tied_with)),
            name,
            digits(p.value, 4),
            _range(p.low, p.high),
            p.unit,
        ]
        for f in examination.diagnosis.missing
        for name, p in f.parameters.items()
    ]
    return html_table(["effect", "parameter", "value", "95 % interval", "unit"], rows, (2, 3))


def _laws(examination: Examination) -> str:
    """The law of each accepted effect, as its file states it."""
    accepted = {f.effect for f in examination.diagnosis.missing}
    laws = []
    for effect in examination.steps[-1].effects:
        if effect.name not in accepted:
            continue
        first, *others = inspect.cleandoc(effect.__doc__ or "").split("\n\n")
        laws.append(f"<h3>{effect.name}</h3><p class='law'>{html_code(first)}</p>")
        laws += [f"<p>{html_code(text)}</p>" for text in others]
    return "".join(laws)


def _everything(examination: Examination) -> str:
    rows = [
        [r.effect, places(r.score, 1), chance(r.p_value), r.status.replace("_", " ")]
        for r in by_evidence(examination.diagnosis)
    ]
    table = html_table(["effect", "χ² explained", "p", "status"], rows, (1, 2))
    shown = dict.fromkeys(r.status for r in examination.diagnosis.ranking)
    meant = "; ".join(f"{s.replace('_', ' ')}: {STATUSES[s]}" for s in shown)
    table += f'<p class="note">{html.escape(meant)}.</p>'
    return f"<details><summary>as numbers</summary>{table}</details>"


def _evidence(examination: Examination) -> list[str]:
    """How much each effect explains, if any was looked for."""
    if not examination.diagnosis.ranking:
        return []
    return [
        "<h2>Which effect</h2>",
        '<p class="note">Evidence for each effect, alone beside the model, on the trials that were '
        "fitted: √χ² explained, in standard deviations; whiskers: two of them. Left of the dotted "
        "line it is chance. Several effects may imitate the true one, so the one that explains "
        "most here is not always the true one.</p>",
        html_plot(ranking(examination.diagnosis)),
        _everything(examination),
    ]


def _nearest(diagnosis: Diagnosis) -> list[str]:
    """Of an unexplained study: the effects that leave least."""
    if not diagnosis.nearest:
        return []
    table = html_table(NEAREST_HEADS, nearest_rows(diagnosis), (1, 2, 3))
    return ["<h3>Nearest effects</h3>", table, f'<p class="note">{nearest_note(diagnosis)}.</p>']


def _checks(diagnosis: Diagnosis) -> list[str]:
    """What the verdict rests on, if anything was asked."""
    if not diagnosis.checks:
        return []
    table = html_table(CHECK_HEADS, check_rows(diagnosis), (1, 2))
    return ["<h2>What the verdict rests on</h2>", f'<p class="note">{CHECK_NOTE}.</p>', table]


def _limits(diagnosis: Diagnosis) -> list[str]:
    """What the study excludes, if limits were sought."""
    if not diagnosis.limits:
        return []
    table = html_table(LIMIT_HEADS, limit_rows(diagnosis), (2, 3))
    return ["<h2>What the study excludes</h2>", f'<p class="note">{LIMIT_NOTE}.</p>', table]


def _agreement(diagnosis: Diagnosis) -> list[str]:
    """Whether the trials agree, and the estimates per trial, if there are several."""
    found = diagnosis.agreement
    if not found:
        return []
    said = html.escape(agreement_sentence(found))
    table = html_table(agreement_heads(found), agreement_rows(found), range(1, len(found) + 1))
    note = f'<p class="note">{AGREEMENT_NOTE}.</p>'
    return ["<h2>Estimates per trial</h2>", f"<p>{said}</p>", table, note]


def _cable(model: Identified) -> str:
    low, high = model.interval()
    rows = [
        [name, digits(value, 4), _range(lo, hi), unit]
        for name, value, lo, hi, unit in zip(
            model.space.names, model.values, low, high, model.space.units, strict=True
        )
    ]
    table = html_table(["parameter", "value", "95 % interval", "unit"], rows, (1, 2))
    return f"<details><summary>all fitted parameters</summary>{table}</details>"


def _next(steps: Sequence[Step]) -> str:
    """What to do next, commands to be copied."""
    lines = [
        f"<p>{html.escape(s.why)}{':' if s.command else ''}</p>"
        + (f"<pre>{html.escape(s.command)}</pre>" if s.command else "")
        for s in steps
    ]
    return f'<div class="next">{"".join(lines)}</div>' if lines else ""
