"""What the lab prints: one plain sentence, and tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from cell.cable.effects.base import Effect
from cell.identify.identified import Identified
from cell.lab.compare import Comparison
from cell.lab.explore import Candidate
from cell.lab.prepared import PreparedStudy
from cell.lab.results import Diagnosis
from cell.lab.wording import peak_in_words, place_in_words, plain, short, unexplained

if TYPE_CHECKING:
    from cell.lab.discover import Discovery
    from cell.lab.suggest import Suggestion

_COLOURS = {"present": "green", "inspect": "yellow", "absent": "dim", "cannot_tell": ""}


def sentence(diagnosis: Diagnosis, baseline: Comparison | None = None) -> str:
    """What was found, as one would say it to a production engineer.

    baseline  the model without the effects found beside the trials: to say where it fails
    """
    noise_mm = diagnosis.noise_m * 1e3
    before_mm = _shown_mm(diagnosis.baseline.heldout_rms_m, diagnosis.baseline.fit_rms_m)
    if diagnosis.verdict == "complete":
        return (
            f"The model is complete: what it misses ({short(before_mm)} mm) is camera noise "
            f"({short(noise_mm)} mm)."
        )
    place = "" if baseline is None else _worst_place(baseline)
    misses = f"The model misses {short(before_mm)} mm{place}"
    if diagnosis.verdict == "unexplained":
        return unexplained(diagnosis, misses)
    if not diagnosis.missing:
        return (
            f"{misses} at {short(noise_mm)} mm of noise; these motions cannot tell why: "
            "try `cell suggest`."
        )
    last = diagnosis.missing[-1].errors
    after_mm = _shown_mm(last.heldout_rms_m, last.fit_rms_m)
    excess = max(before_mm**2 - noise_mm**2, 1e-12)
    share = 100.0 * float(np.clip((before_mm**2 - after_mm**2) / excess, 0.0, 1.0))
    names = " and ".join(
        " or ".join(plain(n) for n in (f.effect, *f.tied_with)) for f in diagnosis.missing
    )
    explains = "explains" if len(diagnosis.missing) == 1 else "explain"
    rest = f"{short(after_mm)} mm, {after_mm / noise_mm:.1f} times the noise, not yet explained"
    if after_mm < 1.1 * noise_mm:
        rest = "camera noise"
    hedge = " These motions cannot tell them apart." if diagnosis.verdict == "cannot_tell" else ""
    return (
        f"{misses}; {names} {explains} {share:.0f} % of what is beyond camera noise; "
        f"the remaining error is {rest}.{hedge}"
    )


def advice(diagnosis: Diagnosis) -> str:
    """What to do next, commands between backticks."""
    options = " ".join(f"--effect {f.effect}" for f in diagnosis.missing)
    tied = any(f.tied_with for f in diagnosis.missing)
    motion = "`cell suggest STUDY -o motion.yaml` gives the motion that tells them apart"
    match diagnosis.verdict:
        case "complete":
            return "Nothing is to be added."
        case "missing" if not tied:
            return f"To add it to the model: `cell fit STUDY {options} -o model.json`."
        case "unexplained":
            look = "To look for an unknown law: `cell discover STUDY -o discovered.py`."
            known = " ".join(f"--effect {f.effect}" for f in diagnosis.partial)
            if not known:
                return look
            return f"With what is known of it: `cell fit STUDY {known} -o model.json`. {look}"
        case "missing":
            return f"To add it: `cell fit STUDY {options} -o model.json`; {motion}."
        case _:
            return f"Measure more: {motion}."


def _worst_place(comparison: Comparison) -> str:
    """Which part of the cable, and which phase of the motion, have the largest error."""
    by_marker = np.sqrt(np.mean([w.by_arc_length.rms_m**2 for w in comparison.where], axis=0))
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
    for column in ("effect", "explains", "left, mm", "fitted", "held out", "most of it"):
        table.add_column(column, justify="left" if column in ("effect", "most of it") else "right")
    for n in diagnosis.nearest:
        table.add_row(
            n.effect,
            f"{100 * n.explained_share:.0f} %",
            _mm(n.left_rms_m),
            _mm(n.errors.fit_rms_m),
            _mm(n.errors.heldout_rms_m),
            peak_in_words(n.peak),
        )
    return table


def waterfall_table(diagnosis: Diagnosis) -> Table:
    """Error of the baseline, after each effect added, and the noise floor."""
    table = Table(title="Error, mm rms per coordinate", box=SIMPLE_HEAD)
    for column in ("model", "fitted", "held out", "parameters (95 %)", "p", "ΔBIC"):
        table.add_column(
            column, justify="left" if column in ("model", "parameters (95 %)") else "right"
        )
    base = diagnosis.baseline
    table.add_row("baseline", _mm(base.fit_rms_m), _mm(base.heldout_rms_m), "", "", "")
    for found in diagnosis.missing or diagnosis.partial:
        parameters = ", ".join(
            f"{name} {p.value:.4g} ({p.low:.4g} … {p.high:.4g}) {p.unit}"
            for name, p in found.parameters.items()
        )
        tied = f" or {', '.join(found.tied_with)}" if found.tied_with else ""
        table.add_row(
            f"+ {found.effect}{tied}",
            _mm(found.errors.fit_rms_m),
            _mm(found.errors.heldout_rms_m),
            parameters,
            f"{found.p_value:.1g}",
            f"{found.delta_bic:.0f}",
        )
    table.add_row("noise", _mm(diagnosis.noise_m), _mm(diagnosis.noise_m), "", "", "")
    return table


def ranking_table(diagnosis: Diagnosis) -> Table:
    """All effects, the most telling first."""
    table = Table(title="Effects, each alone beside the baseline", box=SIMPLE_HEAD)
    for column in ("effect", "χ² explained", "p", "status"):
        table.add_column(column, justify="left" if column in ("effect", "status") else "right")
    for r in diagnosis.ranking:
        colour = _COLOURS[r.status]
        status = f"[{colour}]{r.status}[/]" if colour else r.status
        table.add_row(r.effect, f"{r.score:.1f}", f"{r.p_value:.1g}", status)
    return table


def model_table(model: Identified) -> Table:
    """Parameters with 95 % intervals."""
    table = Table(title="Parameters, 95 % intervals", box=SIMPLE_HEAD)
    for column in ("parameter", "value", "low", "high", "unit"):
        table.add_column(column, justify="left" if column in ("parameter", "unit") else "right")
    low, high = model.interval()
    rows = zip(model.space.names, model.values, low, high, model.space.units, strict=True)
    for name, value, lo, hi, unit in rows:
        table.add_row(name, f"{value:.4g}", f"{lo:.4g}", f"{hi:.4g}", unit)
    return table


def errors_line(prepared: PreparedStudy, candidate: Candidate) -> str:
    """Fitted and held-out error against the noise."""
    held = candidate.heldout.rms_m if candidate.heldout else float("nan")
    return (
        f"error {_mm(candidate.fit.rms_m)} mm fitted, {_mm(held)} mm held out, "
        f"noise {_mm(prepared.floor.noise.std_m)} mm (rms per coordinate)"
    )


def comparison_table(comparison: Comparison) -> Table:
    """Error of each trial, by phase."""
    table = Table(title="Error, mm rms per coordinate", box=SIMPLE_HEAD)
    phases = list(comparison.where[0].by_phase)
    for column in ("trial", "role", "all", *phases, "p (white)"):
        table.add_column(column, justify="left" if column in ("trial", "role") else "right")
    for trial, w in zip(comparison.study.trials, comparison.where, strict=True):
        table.add_row(
            trial.name,
            trial.role,
            _mm(w.rms_m),
            *(_mm(w.by_phase[p]) for p in phases),
            f"{w.whiteness_p_value:.1g}",
        )
    table.add_row("fitted", "", _mm(comparison.fit_rms_m))
    table.add_row("held out", "", _mm(comparison.heldout_rms_m))
    table.add_row("noise", "", _mm(comparison.noise_m))
    return table


def follows_table(comparison: Comparison) -> Table:
    """What the tip's residual goes with."""
    table = Table(title="Correlation of the tip's residual", box=SIMPLE_HEAD)
    names = sorted({f.signal for w in comparison.where for f in w.follows})
    for column in ("trial", *names):
        table.add_column(column, justify="left" if column == "trial" else "right")
    for w in comparison.where:
        found = {f.signal: f for f in w.follows}
        cells = [
            f"{found[n].correlation:+.2f}{'*' if found[n].p_value < 0.01 else ''}"
            if n in found
            else ""
            for n in names
        ]
        table.add_row(w.trial, *cells)
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
        table.add_row(name, law, parameters)
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
    """Terms kept, and the held-out error before and after."""
    table = Table(title="Discovered force", box=SIMPLE_HEAD)
    for column in ("term", "coefficient", "low", "high", "unit"):
        table.add_column(column, justify="left" if column in ("term", "unit") else "right")
    for t in discovery.terms:
        table.add_row(t.name, f"{t.value:.4g}", f"{t.low:.4g}", f"{t.high:.4g}", t.unit)
    table.caption = (
        f"held-out error {_mm(discovery.before_m)} → {_mm(discovery.after_m)} mm, noise "
        f"{_mm(discovery.noise_m)} mm: {100 * discovery.removed_share:.0f} % of the excess removed"
    )
    return table


def suggestion_table(suggestion: Suggestion) -> Table:
    """The motions and what they would tell."""
    table = Table(title="Suggested motion, and the next best", box=SIMPLE_HEAD)
    for column in ("motion", "separation χ²", "hardest to tell", "power"):
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
    table.caption = f"tells {first} from {', '.join(others)}; {_kept(suggestion)}"
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
        f"with what is uncertain of the cable; {refused} motions refused"
    )


def _shown_mm(heldout_m: float, fit_m: float) -> float:
    return 1e3 * (heldout_m if np.isfinite(heldout_m) else fit_m)


def _mm(value_m: float) -> str:
    return f"{value_m * 1e3:.3f}" if np.isfinite(value_m) else "–"
