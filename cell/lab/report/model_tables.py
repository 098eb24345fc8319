"""Tables and sentences about models: their parameters, comparisons, effects, laws, suggestions."""

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
from cell.lab.data.results import Errors
from cell.lab.report.tables import NOISE_ALONE
from cell.lab.report.wording import (
    chance,
    correlation,
    digits,
    mm,
    noise_label,
    short,
)
from cell.lab.strength.compare import Comparison

if TYPE_CHECKING:
    from cell.lab.next.discover import Discovery
    from cell.lab.next.suggestion import Suggestion


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
