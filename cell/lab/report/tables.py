"""The output of a diagnosis: one plain sentence, and tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cell.files.table import TableData
from cell.identify.parameters import Prior
from cell.lab.data.results import Agreement, CheckResult, Diagnosis, Doubt, Errors, TrialValue
from cell.lab.data.rules import DEFAULT_RULES
from cell.lab.fit.series import rms_over
from cell.lab.next.advice import STATUSES, NextStep, meaning
from cell.lab.report.wording import (
    agreement_sentence,
    apart,
    at_noise,
    by_evidence,
    chance,
    class_in_words,
    digits,
    ended_early,
    mm,
    noise_label,
    noise_like,
    peak_in_words,
    place_in_words,
    places,
    reasons_not_claimed,
    short,
    unexplained,
    with_interval,
)
from cell.lab.strength.compare import Comparison
from cell.study.facts import sensors_in_words

#: Text if no check failed, because the search was stopped.
NOT_WHY = "These motions cannot show why."
#: Column of models that were fitted to held-out trials too.
FITTED_TO_ALL = "fitted to all"
#: Column of an effect's parameters: `cell fit` gives those of the fit trials.
_INTERVALS = "parameters (95 %, all trials)"
#: Multiple of the noise up to which a remaining error is called noise.
NOISE_ALONE = DEFAULT_RULES.most_over_noise
_SIGNS = {"<=": "≤", ">=": "≥", "<": "<", ">": ">"}
_COLOURS = {"present": "green", "inspect": "yellow", "absent": "dim"}


def sentence(
    diagnosis: Diagnosis, baseline: Comparison | None = None, final: Comparison | None = None
) -> str:
    """The result of a diagnosis in one sentence, for a production engineer.

    baseline  comparison of the model without added effects: where it fails
    final     comparison with them: whether the residual is noise in every respect
    """
    noise_mm = diagnosis.noise_m * 1e3
    before_mm = _shown_mm(diagnosis.baseline)
    if diagnosis.verdict == "complete":
        return (
            f"The model is complete: what it misses ({short(before_mm)} mm) is "
            f"{noise_like(noise_mm, final or baseline)}."
        )
    stated = diagnosis.noise_is_stated
    noise_name = "the stated error of the measurement" if stated else "camera noise"
    place = "" if baseline is None else _worst_place(baseline)
    misses = f"The model misses {short(before_mm)} mm{place}"
    if diagnosis.verdict == "unexplained":
        return unexplained(diagnosis, misses, noise_name)
    if diagnosis.ended_early and not diagnosis.missing:
        return ended_early(diagnosis, misses)
    if not diagnosis.missing:
        return f"{misses}, {at_noise(diagnosis)}. {reasons_not_claimed(diagnosis) or NOT_WHY}"
    after_mm = _shown_mm(diagnosis.missing[-1].errors)
    names = " and ".join(map(class_in_words, diagnosis.missing))
    remainder = f"{after_mm / noise_mm:.1f} times the noise, not yet explained"
    if after_mm < NOISE_ALONE * noise_mm:
        remainder = noise_like(noise_mm, final)
    hedge = f" {reasons_not_claimed(diagnosis)}" if diagnosis.verdict == "cannot_tell" else ""
    return f"{misses}; with {names} in it {short(after_mm)} mm: {remainder}.{hedge}"


def _worst_place(comparison: Comparison) -> str:
    """Text: part of the cable and phase of the motion with the largest error."""
    by_marker = rms_over([w.by_arc_length.rms_m for w in comparison.where])
    if not np.isfinite(by_marker).any():
        return ""
    share = comparison.study.arc_length_m[int(np.nanargmax(by_marker))]
    part = place_in_words(share / comparison.study.cable.length_m)
    phases = list(comparison.where[0].by_phase)
    by_phase = rms_over([[w.by_phase[p] for p in phases] for w in comparison.where])
    when = {
        "still": "even at rest",
        "moving": "while the gripper moves",
        "early swing": "early in the swing",
        "late swing": "late in the swing",
    }
    return f", most of it {part} {when[phases[int(np.argmax(np.nan_to_num(by_phase)))]]}"


def nearest_table(diagnosis: Diagnosis) -> TableData:
    """Table, for an unexplained study, of the effects with the smallest residuals."""
    base, rest = diagnosis.baseline, diagnosis.left
    before_m = float("nan") if rest is None else rest.before_rms_m
    each = [("none", before_m, base, "")]
    each += [(n.effect, n.left_rms_m, n.errors, peak_in_words(n.peak)) for n in diagnosis.nearest]
    rows = [
        [name, mm(all_m), mm(errors.fit_rms_m), mm(errors.heldout_rms_m), where]
        for name, all_m, errors, where in each
    ]
    to = "all" if diagnosis.verdict == "unexplained" else "the fit trials"
    bounds = [name for n in diagnosis.nearest for name in n.at_bound]
    at = f". At a bound: {', '.join(bounds)}: the effect may be stronger than it allows"
    note = (
        f"Error, mm rms per coordinate, with each effect alone added to the model. “all trials”: "
        f"error on all trials, fitted to {to}; –: not fitted so{at if bounds else ''}"
    )
    heads = ("effect", "all trials", "fitted", "held out", "most of it")
    return TableData("Nearest effects, each alone", heads, rows, (1, 2, 3), note)


def waterfall_table(diagnosis: Diagnosis) -> TableData:
    """Error of the baseline, after each effect added, and the noise."""
    in_part, rest = bool(diagnosis.partial), diagnosis.left
    heads = ["model", "fitted", "held out", *[FITTED_TO_ALL] * in_part, _INTERVALS, "p"]
    base, noise = diagnosis.baseline, mm(diagnosis.noise_m)
    before = ["–" if rest is None else mm(rest.before_rms_m)] * in_part
    errors = (mm(base.fit_rms_m), mm(base.heldout_rms_m))
    rows = [["baseline", *errors, *before, "", "", ""]]
    for effect in diagnosis.missing or diagnosis.partial:
        parameters = ", ".join(
            f"{name} {with_interval(p.value, p.low, p.high)} {p.unit}"
            for name, p in effect.parameters.items()
        )
        tied = f" or {', '.join(effect.tied_with)}" if effect.tied_with else ""
        fitted = mm(effect.errors.fit_rms_m)
        heldout = mm(effect.errors.heldout_rms_m)
        rows.append(
            [
                f"+ {effect.effect}{tied}",
                *(("–", "–", fitted) if in_part else (fitted, heldout)),
                parameters,
                chance(effect.p_value),
                places(effect.delta_bic, 0),
            ]
        )
    label = noise_label(diagnosis.noise_is_stated)
    rows.append([label, noise, noise, *[noise] * in_part, "", "", ""])
    texts = {0, heads.index(_INTERVALS)}
    numbers = [i for i in range(len(heads) + 1) if i not in texts]
    return TableData("Error, mm rms per coordinate", [*heads, "ΔBIC"], rows, numbers)


def ranking_table(diagnosis: Diagnosis) -> TableData:
    """Table of all effects, by the χ² that each explains, the largest first."""
    rows = [
        [r.effect, places(r.score, 1), chance(r.p_value), r.status] for r in by_evidence(diagnosis)
    ]
    shown = dict.fromkeys(r.status for r in diagnosis.ranking)
    note = "; ".join(f"{s}: {STATUSES[s]}" for s in shown)
    title = "Effects, each alone added to the baseline"
    return TableData(title, ["effect", "χ² explained", "p", "status"], rows, (1, 2), note, _COLOURS)


def limits_table(diagnosis: Diagnosis) -> TableData:
    """Table of the limits of effects that are neither named nor tied."""
    rows = []
    for limit in sorted(diagnosis.limits, key=lambda entry: entry.high is None):
        possible = "this study could not have shown it"
        if limit.low is not None and limit.high is not None:
            unit = "" if limit.unit == "1" else limit.unit
            possible = f"{' … '.join(apart(limit.low, limit.high))} {unit}".strip()
        moves = "" if limit.tip_m is None else short(limit.tip_m * 1e3)
        rows.append([limit.effect, limit.parameter, possible, moves])
    heads = ("effect", "parameter", "possible (95 %)", "moves the tip by, mm")
    note = (
        "Each effect alone added to the resulting model, with the shape that this study detects "
        "least; the residual of the model counts as noise. An effect outside the range is "
        "excluded; inside it is possible"
    )
    return TableData("What the study excludes, 95 %", heads, rows, (3,), note)


def check_rows(checks: Sequence[CheckResult]) -> list[tuple[str, str, str, str]]:
    """Question, statistic, limit and result of every check."""
    words = {True: "passed", False: "failed", None: "–"}
    return [
        (
            c.question,
            "–" if c.statistic is None else f"{c.statistic:.3g}",
            f"{c.unit} {_SIGNS[c.passes]} {c.limit:g}",
            words[c.passed],
        )
        for c in checks
    ]


def checks_table(checks: Sequence[CheckResult]) -> TableData:
    """Table of the checks of a verdict."""
    heads = ("question", "answer", "limit", "result")
    colours = {"passed": "green", "failed": "red", "–": "dim"}
    note = (
        "The verdict is the worst result of the checks that failed; “–”: the question does not "
        "apply. “cell help diagnosis” explains each statistic, the manual's reference of checks "
        "the reason for its limit"
    )
    return TableData("What the verdict rests on", heads, check_rows(checks), (1, 2), note, colours)


def agreement_table(parts: Sequence[Agreement]) -> TableData:
    """Estimates of the parameters per trial and jointly, their spread, and their agreement."""

    def text(estimate: TrialValue) -> str:
        if estimate.value is None or estimate.low is None or estimate.high is None:
            return "–"
        return f"{digits(estimate.value, 4)} ({' … '.join(apart(estimate.low, estimate.high))})"

    heads = ["trial", *(f"{a.parameter}{'' if a.unit == '1' else f', {a.unit}'}" for a in parts)]
    trials = zip(*(a.by_trial for a in parts), strict=True)
    rows = [
        *([values[0].trial, *map(text, values)] for values in trials),
        ["all together", *(digits(a.value, 4) for a in parts)],
        ["spread", *(digits(a.spread, 2) for a in parts)],
        ["they agree", *("yes" if a.agrees else f"no, p {chance(a.p_value, '= ')}" for a in parts)],
    ]
    note = (
        "Estimate per trial, 95 %, with the shape of EI along the cable and the exponent held at "
        "the values of all trials; “mean_rigidity”: geometric mean of EI along the cable; "
        "“spread”: standard deviation between trials beyond these intervals"
    )
    return TableData("Estimates per trial", heads, rows, note=note)


def diagnosis_parts(
    diagnosis: Diagnosis, comparisons: Sequence[Comparison], steps: Sequence[NextStep]
) -> list[str | TableData]:
    """Sentences and tables of a diagnosis, in order.

    comparisons  of the baseline first, and of the model with all effects last
    """
    agreement = diagnosis.agreement
    sensors = sensors_in_words(comparisons[0].study.trials)
    return [
        sentence(diagnosis, comparisons[0], comparisons[-1]),
        verdict_line(diagnosis),
        *warning_lines(diagnosis.warnings),
        *([f"Evidence: {diagnosis.independence}."] if diagnosis.independence.recordings else []),
        *knots_lines(diagnosis.knots),
        *([f"The study states: {sensors}."] if sensors else []),
        *([agreement_sentence(agreement)] if agreement else []),
        waterfall_table(diagnosis),
        *evidence_tables(diagnosis),
        steps_text(steps),
    ]


def evidence_tables(diagnosis: Diagnosis) -> list[TableData]:
    """Tables of a diagnosis's evidence and limits, without empty ones."""
    return [
        *([nearest_table(diagnosis)] if diagnosis.nearest else []),
        *([checks_table(diagnosis.checks)] if diagnosis.checks else []),
        *([ranking_table(diagnosis)] if diagnosis.ranking else []),
        *([limits_table(diagnosis)] if diagnosis.limits else []),
        *([agreement_table(diagnosis.agreement)] if diagnosis.agreement else []),
    ]


def verdict_line(diagnosis: Diagnosis) -> str:
    """The verdict and what it means."""
    return f"Verdict {diagnosis.verdict}: {meaning(diagnosis)}."


def knots_lines(knots: int) -> list[str]:
    """Sentence on the number of knots of EI(s), if it is not the default."""
    usual = Prior().knots
    if knots == usual:
        return []
    return [f"EI changes fast along this cable: the model has it at {knots} places, not {usual}."]


def warning_lines(warnings: Sequence[Doubt]) -> list[str]:
    """One line for each warning."""
    return [f"Warning: {w.message}." for w in warnings]


def steps_text(steps: Sequence[NextStep]) -> str:
    """Next steps as text: the reason, and below it the command."""
    return "\n".join(
        f"{step.why}:\n    {step.command}" if step.command else step.why for step in steps
    )


def _shown_mm(errors: Errors) -> float:
    """The error on motions not fitted to, if there are any."""
    held_m = errors.heldout_rms_m
    return 1e3 * (errors.fit_rms_m if np.isnan(held_m) else held_m)
