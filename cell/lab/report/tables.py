"""What a diagnosis prints: one plain sentence, and tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from cell.lab.data.results import Agreement, CheckResult, Diagnosis, Doubt, Errors
from cell.lab.data.thresholds import DEFAULT_RULES
from cell.lab.next.advice import STATUSES, Step, meaning
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
    at_noise,
    by_evidence,
    chance,
    check_rows,
    digits,
    interrupted,
    limit_rows,
    mm,
    nearest_note,
    nearest_rows,
    noise_label,
    noise_like,
    place_in_words,
    places,
    plain,
    short,
    unexplained,
    why_not_told,
)
from cell.lab.strength.compare import Comparison

#: Said where no check failed: the search was stopped.
NOT_WHY = "These motions cannot show why."
#: Column of what was fitted to held-out trials too.
FITTED_TO_ALL = "fitted to all"
#: Up to so many times the noise a remaining error is called noise.
NOISE_ALONE = DEFAULT_RULES.gross_misfit
_COLOURS = {"present": "green", "inspect": "yellow", "absent": "dim", "cannot_tell": ""}


def sentence(
    diagnosis: Diagnosis, baseline: Comparison | None = None, final: Comparison | None = None
) -> str:
    """The finding in one sentence, for a production engineer.

    baseline  the model without the effects found beside the trials: to say where it fails
    final     with them: to say whether what is left is noise in every respect
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
    if "interrupted" in diagnosis.codes and not diagnosis.missing:
        return interrupted(diagnosis, misses)
    if not diagnosis.missing:
        return f"{misses}, {at_noise(diagnosis)}. {why_not_told(diagnosis) or NOT_WHY}"
    after_mm = _shown_mm(diagnosis.missing[-1].errors)
    names = " and ".join(
        " or ".join(plain(n) for n in (f.effect, *f.tied_with)) for f in diagnosis.missing
    )
    rest = f"{after_mm / noise_mm:.1f} times the noise, not yet explained"
    if after_mm < NOISE_ALONE * noise_mm:
        rest = noise_like(noise_mm, final)
    hedge = f" {why_not_told(diagnosis)}" if diagnosis.verdict == "cannot_tell" else ""
    return f"{misses}; with {names} in it {short(after_mm)} mm: {rest}.{hedge}"


def _worst_place(comparison: Comparison) -> str:
    """Which part of the cable, and which phase of the motion, have the largest error."""
    squares = np.array([w.by_arc_length.rms_m**2 for w in comparison.where])
    squares = squares[np.isfinite(squares).any(axis=1)]
    if len(squares) == 0:
        return ""
    by_marker = np.sqrt(np.mean(squares, axis=0))
    share = comparison.study.arc_length_m[int(np.nanargmax(by_marker))]
    part = place_in_words(share / comparison.study.cable.free_length_m)
    phases = list(comparison.where[0].by_phase)
    by_phase = [
        np.mean([w.by_phase[p] ** 2 for w in comparison.where if np.isfinite(w.by_phase[p])] or [0])
        for p in phases
    ]
    when = {
        "still": "even at rest",
        "moving": "while the hand moves",
        "early swing": "early in the swing",
        "late swing": "late in the swing",
    }
    return f", most of it {part} {when[phases[int(np.argmax(by_phase))]]}"


def nearest_table(diagnosis: Diagnosis) -> Table:
    """Of an unexplained study: the effects that leave least, how much and where."""
    table = Table(title="Nearest effects, each alone", box=SIMPLE_HEAD)
    for column in NEAREST_HEADS:
        table.add_column(column, justify="left" if column in ("effect", "most of it") else "right")
    for row in nearest_rows(diagnosis):
        table.add_row(*map(Text, row))
    table.caption = nearest_note(diagnosis)
    return table


def waterfall_table(diagnosis: Diagnosis) -> Table:
    """Error of the baseline, after each effect added, and the noise."""
    table = Table(title="Error, mm rms per coordinate", box=SIMPLE_HEAD)
    in_part, left = bool(diagnosis.partial), diagnosis.left
    heads = ("model", "fitted", "held out", *[FITTED_TO_ALL] * in_part, "parameters (95 %)", "p")
    for column in (*heads, "ΔBIC"):
        table.add_column(
            column, justify="left" if column in ("model", "parameters (95 %)") else "right"
        )
    base, noise = diagnosis.baseline, mm(diagnosis.noise_m)
    before = ["–" if left is None else mm(left.before_rms_m)] * in_part
    errors = (mm(base.fit_rms_m), mm(base.heldout_rms_m))
    table.add_row("baseline", *errors, *before, "", "", "")
    for found in diagnosis.missing or diagnosis.partial:
        parameters = ", ".join(
            f"{name} {digits(p.value, 4)} ({digits(p.low, 4)} … {digits(p.high, 4)}) {p.unit}"
            for name, p in found.parameters.items()
        )
        tied = f" or {', '.join(found.tied_with)}" if found.tied_with else ""
        fitted = mm(found.errors.fit_rms_m)
        held = mm(found.errors.heldout_rms_m)
        table.add_row(
            f"+ {found.effect}{tied}",
            *(("–", "–", fitted) if in_part else (fitted, held)),
            Text(parameters),
            chance(found.p_value),
            places(found.delta_bic, 0),
        )
    label = noise_label(diagnosis.noise_is_stated)
    table.add_row(label, noise, noise, *[noise] * in_part, "", "", "")
    return table


def ranking_table(diagnosis: Diagnosis) -> Table:
    """All effects, what explains most first."""
    table = Table(title="Effects, each alone beside the baseline", box=SIMPLE_HEAD)
    for column in ("effect", "χ² explained", "p", "status"):
        table.add_column(column, justify="left" if column in ("effect", "status") else "right")
    for r in by_evidence(diagnosis):
        colour = _COLOURS[r.status]
        status = f"[{colour}]{r.status}[/]" if colour else r.status
        table.add_row(r.effect, places(r.score, 1), chance(r.p_value), status)
    shown = dict.fromkeys(r.status for r in diagnosis.ranking)
    table.caption = "; ".join(f"{s}: {STATUSES[s]}" for s in shown)
    return table


def limits_table(diagnosis: Diagnosis) -> Table:
    """How strong the effects could be that are neither named nor tied."""
    table = Table(title="What the study excludes, 95 %", box=SIMPLE_HEAD)
    for column in LIMIT_HEADS:
        table.add_column(column, justify="right" if column.endswith("mm") else "left")
    for row in limit_rows(diagnosis):
        table.add_row(*map(Text, row))
    table.caption = LIMIT_NOTE
    return table


def checks_table(checks: Sequence[CheckResult]) -> Table:
    """What a verdict rests on."""
    table = Table(title="What the verdict rests on", box=SIMPLE_HEAD)
    for column in CHECK_HEADS:
        table.add_column(column, justify="right" if column in ("answer", "limit") else "left")
    colours = {"passed": "green", "failed": "red"}
    for row in check_rows(checks):
        table.add_row(*map(Text, row[:-1]), Text(row[-1], colours.get(row[-1], "dim")))
    table.caption = CHECK_NOTE
    return table


def agreement_table(found: Sequence[Agreement]) -> Table:
    """Estimates of the parameters per trial."""
    table = Table(title="Estimates per trial", box=SIMPLE_HEAD)
    for column in agreement_heads(found):
        table.add_column(column)
    for row in agreement_rows(found):
        table.add_row(*map(Text, row))
    table.caption = AGREEMENT_NOTE
    return table


def diagnosis_parts(
    diagnosis: Diagnosis, comparisons: Sequence[Comparison], steps: Sequence[Step]
) -> list[str | Table]:
    """All that is printed of a diagnosis, in its order.

    comparisons  of the baseline, and last of the model with everything found
    """
    agreement = diagnosis.agreement
    return [
        sentence(diagnosis, comparisons[0], comparisons[-1]),
        verdict_line(diagnosis),
        *warning_lines(diagnosis.warnings),
        *([agreement_sentence(agreement)] if agreement else []),
        waterfall_table(diagnosis),
        *([nearest_table(diagnosis)] if diagnosis.nearest else []),
        *([checks_table(diagnosis.checks)] if diagnosis.checks else []),
        *([ranking_table(diagnosis)] if diagnosis.ranking else []),
        *([limits_table(diagnosis)] if diagnosis.limits else []),
        *([agreement_table(agreement)] if agreement else []),
        steps_text(steps),
    ]


def verdict_line(diagnosis: Diagnosis) -> str:
    """The verdict and what it means."""
    return f"Verdict {diagnosis.verdict}: {meaning(diagnosis)}."


def warning_lines(warnings: Sequence[Doubt]) -> list[str]:
    """One line each, for the top of what is printed."""
    return [f"Warning: {w.message}." for w in warnings]


def steps_text(steps: Sequence[Step]) -> str:
    """Next steps as text: why, and below it the command."""
    return "\n".join(
        f"{step.why}:\n    {step.command}" if step.command else step.why for step in steps
    )


def _shown_mm(errors: Errors) -> float:
    """The error on motions not fitted to, if there are any."""
    held_m = errors.heldout_rms_m
    return 1e3 * (held_m if np.isfinite(held_m) else errors.fit_rms_m)
