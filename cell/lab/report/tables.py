"""What the lab prints: one plain sentence, and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from cell.cable.effects.base import Effect
from cell.identify.identified import Identified
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.results import Agreement, Diagnosis, Doubt, Errors
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
    correlation,
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
from cell.lab.verdict.rules import DEFAULT_RULES

if TYPE_CHECKING:
    from cell.lab.next.discover import Discovery
    from cell.lab.next.suggest import Suggestion

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


def checks_table(diagnosis: Diagnosis) -> Table:
    """What the verdict rests on."""
    table = Table(title="What the verdict rests on", box=SIMPLE_HEAD)
    for column in CHECK_HEADS:
        table.add_column(column, justify="right" if column in ("answer", "limit") else "left")
    colours = {"passed": "green", "failed": "red"}
    for row in check_rows(diagnosis):
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
        *([checks_table(diagnosis)] if diagnosis.checks else []),
        *([ranking_table(diagnosis)] if diagnosis.ranking else []),
        *([limits_table(diagnosis)] if diagnosis.limits else []),
        *([agreement_table(agreement)] if agreement else []),
        steps_text(steps),
    ]


def verdict_line(diagnosis: Diagnosis) -> str:
    """The verdict and what it means."""
    return f"Verdict {diagnosis.verdict}: {meaning(diagnosis)}."


def model_table(model: Identified) -> Table:
    """Parameters with 95 % intervals."""
    table = Table(title="Parameters, 95 % intervals", box=SIMPLE_HEAD)
    for column in ("parameter", "value", "low", "high", "unit"):
        table.add_column(column, justify="left" if column in ("parameter", "unit") else "right")
    low, high = model.interval()
    rows = zip(model.space.names, model.values, low, high, model.space.units, strict=True)
    for name, value, lo, hi, unit in rows:
        table.add_row(Text(name), digits(value, 4), digits(lo, 4), digits(hi, 4), Text(unit))
    return table


def warning_lines(warnings: Sequence[Doubt]) -> list[str]:
    """One line each, for the top of what is printed."""
    return [f"Warning: {w.message}." for w in warnings]


def errors_line(prepared: PreparedStudy, errors: Errors) -> str:
    """Fitted and held-out error against the noise."""
    return (
        f"error {mm(errors.fit_rms_m)} mm fitted, {mm(errors.heldout_rms_m)} mm held out, "
        f"{noise_label(prepared.study.noise_std_m is not None)} "
        f"{mm(prepared.noise_model.noise.std_m)} mm (rms per coordinate)"
    )


def comparison_sentence(comparisons: Sequence[Comparison]) -> str:
    """What models miss, from the first to the last."""
    first, last = comparisons[0], comparisons[-1]
    held = np.isfinite(first.heldout_rms_m)
    where = "motions not fitted to" if held else "the motions fitted to"
    noise = f"the {noise_label(first.noise_is_stated)} is {short(first.noise_m * 1e3)} mm"
    if first is last:
        beyond = f" and {short(last.heldout_rms_m * 1e3)} mm on motions not fitted to"
        return (
            f"The model misses {short(last.fit_rms_m * 1e3)} mm on the motions fitted to"
            f"{beyond if held else ''}; {noise}."
        )
    before, after = short(first.error_m * 1e3), short(last.error_m * 1e3)
    goes = f"{'falls' if last.error_m < first.error_m else 'rises'} from {before} to {after} mm"
    if before == after:
        goes = f"stays at {after} mm"
    return f"From “{first.model}” to “{last.model}” the error on {where} {goes}; {noise}."


def comparisons_table(comparisons: Sequence[Comparison]) -> Table:
    """Errors of models side by side, trial by trial."""
    table = Table(title="Error, mm rms per coordinate", box=SIMPLE_HEAD)
    table.add_column("trial")
    table.add_column("role")
    for c in comparisons:
        table.add_column(c.model, justify="right")
    for i, trial in enumerate(comparisons[0].study.trials):
        table.add_row(trial.name, trial.role, *(mm(c.where[i].rms_m) for c in comparisons))
    table.add_section()
    table.add_row("fitted", "", *(mm(c.fit_rms_m) for c in comparisons))
    table.add_row("held out", "", *(mm(c.heldout_rms_m) for c in comparisons))
    label = noise_label(comparisons[0].noise_is_stated)
    table.add_row(label, "", *(mm(c.noise_m) for c in comparisons))
    table.add_row("effects", "", *("\n".join(c.effects) or "–" for c in comparisons))
    return table


def comparison_table(comparison: Comparison) -> Table:
    """Error of each trial, by phase."""
    table = Table(title="Error, mm rms per coordinate", box=SIMPLE_HEAD)
    phases = list(comparison.where[0].by_phase)
    for column in ("trial", "role", "all", *phases, "p (white)"):
        table.add_column(column, justify="left" if column in ("trial", "role") else "right")
    for trial, w in zip(comparison.study.trials, comparison.where, strict=True):
        table.add_row(
            Text(trial.name),
            trial.role,
            mm(w.rms_m),
            *(mm(w.by_phase[p]) for p in phases),
            chance(w.whiteness_p_value),
        )
    table.add_row("fitted", "", mm(comparison.fit_rms_m))
    table.add_row("held out", "", mm(comparison.heldout_rms_m))
    table.add_row(noise_label(comparison.noise_is_stated), "", mm(comparison.noise_m))
    return table


def correlations_table(comparison: Comparison) -> Table:
    """Correlations of the tip's residual with signals, by trial."""
    table = Table(title="Correlation of the tip's residual", box=SIMPLE_HEAD)
    names = sorted({f.signal for w in comparison.where for f in w.correlations})
    for column in ("trial", *names):
        table.add_column(column, justify="left" if column == "trial" else "right")
    for w in comparison.where:
        found = {f.signal: f for f in w.correlations}
        cells = [
            f"{correlation(found[n].correlation)}{'*' if found[n].p_value < 0.01 else ''}"
            if n in found
            else ""
            for n in names
        ]
        table.add_row(Text(w.trial), *cells)
    return table


def effects_table(library: Mapping[str, type[Effect]]) -> Table:
    """Names, laws and parameters of effects."""
    table = Table(box=SIMPLE_HEAD)
    for column in ("effect", "law", "parameters"):
        table.add_column(column)
    for name, effect in library.items():
        law = " ".join((effect.__doc__ or "").split("\n\n")[0].split())
        parameters = "\n".join(
            f"{p.name} [{p.unit}] {p.low:g} … {p.high:g}" for p in effect.parameters if p.fitted
        )
        table.add_row(Text(name), Text(law), Text(parameters))
    return table


def describe_effects(library: Mapping[str, type[Effect]]) -> list[dict[str, Any]]:
    """The same as plain data."""
    return [
        {
            "effect": name,
            "law": " ".join((effect.__doc__ or "").split()),
            "parameters": [
                {
                    "name": p.name,
                    "unit": p.unit,
                    "low": p.low,
                    "high": p.high,
                    "typical": p.starts[0],
                }
                for p in effect.parameters
            ],
        }
        for name, effect in library.items()
    ]


def discovery_table(discovery: Discovery) -> Table:
    """Numbers of the law."""
    table = Table(title="Discovered law", box=SIMPLE_HEAD)
    for column in ("parameter", "value", "low", "high", "unit"):
        table.add_column(column, justify="left" if column in ("parameter", "unit") else "right")
    for p in discovery.parameters:
        ends = (digits(p.low, 4), digits(p.high, 4))
        table.add_row(Text(p.name), digits(p.value, 4), *ends, Text(p.unit))
    return table


def discovery_sentence(discovery: Discovery) -> str:
    """What a discovered law does to the error."""
    where = "held-out error" if discovery.confirmed else "error on the trials fitted to"
    times = discovery.after_m / discovery.noise_m
    left = "What is left is noise."
    if not discovery.complete:
        left = f"What is left is {times:.1f} times the noise: another effect is missing too."
    elif times > NOISE_ALONE:
        left = f"What is left is {times:.1f} times the noise: small, but more than noise."
    doubt = "" if discovery.confirmed else " No trial is held out: the law is not confirmed."
    return (
        f"With {discovery.effect} the {where} falls from {mm(discovery.before_m)} to "
        f"{mm(discovery.after_m)} mm, noise {mm(discovery.noise_m)} mm. {left}{doubt}"
    )


def steps_text(steps: Sequence[Step]) -> str:
    """Next steps as text: why, and below it the command."""
    return "\n".join(
        f"{step.why}:\n    {step.command}" if step.command else step.why for step in steps
    )


def suggestion_table(suggestion: Suggestion) -> Table:
    """The motions and what they would tell."""
    table = Table(title="Suggested motion, and the next best", box=SIMPLE_HEAD)
    for column in ("motion", "separation χ²", "hardest to distinguish", "power"):
        table.add_column(
            column, justify="right" if column in ("separation χ²", "power") else "left"
        )
    for option in suggestion.options[:5]:
        table.add_row(
            option.motion.describe(),
            f"{option.separation:.1f}",
            option.hardest,
            f"{option.power:.2f}",
        )
    first, *others = suggestion.candidates
    table.caption = f"distinguishes {first} from {', '.join(others)}; {_kept(suggestion)}"
    return table


def _kept(suggestion: Suggestion) -> str:
    """Which limits the motions keep, and how many did not."""
    refused = sum(suggestion.refused.values())
    if suggestion.surroundings.picture_m is None:
        return (
            "checked only against a box of ±100 mm around home: give --config for the limits, the "
            "picture and the workpiece of a cell"
        )
    return (
        "hand within its limits, cable and jaw in the picture, cable clear of the workpiece, all "
        f"including the uncertainty of the cable; {refused} motions refused"
    )


def _shown_mm(errors: Errors) -> float:
    """The error on motions not fitted to, if there are any."""
    held_m = errors.heldout_rms_m
    return 1e3 * (held_m if np.isfinite(held_m) else errors.fit_rms_m)
