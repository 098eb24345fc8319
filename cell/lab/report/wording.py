"""Sentences and parts of sentences about results of the lab."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from cell.cable.effects import library, unscreened
from cell.cable.effects.base import after_number
from cell.files.words import counted
from cell.lab.data.prepared import ERROR_RATIO
from cell.lab.data.results import (
    Agreement,
    Diagnosis,
    MissingEffect,
    Peak,
    RankedEffect,
)
from cell.lab.strength.compare import NOTICEABLE, Comparison, TrialResidual


def catalogue_entry(effects: Sequence[str]) -> str:
    """Sentence that refers to the manual's entries on these effects; empty without entries."""
    described = library() | unscreened()
    names = [name for name in dict.fromkeys(effects) if name in described]
    if not names:
        return ""
    entries = "entry" if len(names) == 1 else "entries"
    return f"Limits, confusions and remedies: `cell help effects`, {entries} {', '.join(names)}."


def reasons_not_claimed(diagnosis: Diagnosis) -> str:
    """The failed checks that prevent a claim, as text; empty if none failed."""
    return " ".join(c.failed for c in diagnosis.checks if c.passed is False)


def unexplained(diagnosis: Diagnosis, misses: str, noise_name: str = "camera noise") -> str:
    """Sentence for a study that no effect explains down to the noise, with the nearest effect.

    misses  how much the model misses and where, the beginning of the sentence
    """
    noise = f"{noise_name} is {short(diagnosis.noise_m * 1e3)} mm"
    rest = diagnosis.left
    if "not_searched" in diagnosis.codes:
        return (
            f"{misses}, {noise}: this is not a model of this cable, and no effect was looked for."
        )
    if not diagnosis.partial:
        text = f"{misses}, {noise}, and no effect that was tried explains it."
        if rest is not None:
            before = f"{short(rest.before_rms_m * 1e3)} mm"
            text += f" Fitted to all trials it misses {before}{_near(diagnosis)}."
        return text
    names = " and ".join(map(class_in_words, diagnosis.partial))
    explains, it = ("explains", "it") if len(diagnosis.partial) == 1 else ("explain", "them")
    text = f"{misses}, {noise}; {names} {explains} most of it, not all"
    if rest is not None:
        text += (
            f": fitted to all trials the model misses {short(rest.before_rms_m * 1e3)} mm without "
            f"{it} and {short(rest.rms_m * 1e3)} mm with {it}, {rest.over_noise:.1f} times the "
            f"noise, most {peak_in_words(rest.peak)}"
        )
    return f"{text}. No effect that was tried explains the remaining error."


def ended_early(diagnosis: Diagnosis, misses: str) -> str:
    """Sentence for a diagnosis that ended early, with the nearest effect until then."""
    why = "Interrupted." if "interrupted" in diagnosis.codes else "The limit of work was reached."
    text = f"{why} {misses}, {at_noise(diagnosis)}"
    rest = diagnosis.left
    if not diagnosis.nearest or rest is None:
        return f"{text}; no effect was fitted yet."
    over_all = f"Over all trials it misses {short(rest.before_rms_m * 1e3)} mm{_near(diagnosis)}"
    return f"{text}. {over_all}; nothing confirmed."


def at_noise(diagnosis: Diagnosis) -> str:
    """Part of a sentence: the noise, or the stated error, that an error is compared with."""
    noise = f"{short(diagnosis.noise_m * 1e3)} mm"
    return f"at a stated error of {noise}" if diagnosis.noise_is_stated else f"at {noise} of noise"


def noise_label(stated: bool) -> str:
    """Label of the noise in tables and figures."""
    return "stated error" if stated else "noise"


def _near(diagnosis: Diagnosis) -> str:
    """Error with each of the nearest effects, where it is smaller."""
    before_m = np.inf if diagnosis.left is None else diagnosis.left.before_rms_m
    smaller = [n for n in diagnosis.nearest if short(n.left_rms_m * 1e3) != short(before_m * 1e3)]
    errors = [f"{short(n.left_rms_m * 1e3)} mm with {plain(n.effect)}" for n in smaller]
    return f", {_listed(errors)}" if errors else ", and no effect makes that less"


def class_in_words(missing: MissingEffect) -> str:
    """An effect and those tied with it."""
    return " or ".join(plain(n) for n in (missing.effect, *missing.tied_with))


def noise_like(noise_mm: float, final: Comparison | None) -> str:
    """Part of a sentence that states that an error is no larger than the noise."""
    noise, pattern = f"({short(noise_mm)} mm)", ""
    if final is not None and (patterns := final.patterns()):
        trials = counted(len(final.where), "trial")
        pattern = f"; in {patterns} of {trials} it has a pattern, too small to identify its cause"
    if final is None or not final.noise_is_stated:
        return f"{'no larger than ' if pattern else ''}camera noise {noise}{pattern}"
    rest_mm = final.noise_at_rest_m * 1e3
    camera = f"; camera noise at rest is {short(rest_mm)} mm" if np.isfinite(rest_mm) else ""
    return f"within the stated error of the measurement {noise}{camera}{pattern}"


def residual_in_words(where: TrialResidual, comparison: Comparison) -> str:
    """The residual of a trial in words: noise, a pattern within the noise, or more than noise."""
    white = not where.whiteness_p_value < NOTICEABLE
    if where.rms_m > ERROR_RATIO * comparison.noise_m:
        return "more than noise" if white else "a pattern above the noise"
    if white:
        return "noise"
    limit = "within the stated error" if comparison.noise_is_stated else "no larger than the noise"
    return f"a pattern {limit}"


def noise_in_words(comparison: Comparison) -> str:
    """The noise and its source."""
    at_rest_m = comparison.noise_at_rest_m
    if not comparison.noise_is_stated:
        return f"camera noise {short(comparison.noise_m * 1e3)} mm, measured at rest"
    camera = (
        f" (camera noise at rest {short(at_rest_m * 1e3)} mm)" if np.isfinite(at_rest_m) else ""
    )
    return f"error of the measurement {short(comparison.noise_m * 1e3)} mm, as stated{camera}"


def peak_in_words(peak: Peak) -> str:
    """Place of the largest residual, in words."""
    at = f"{peak.arc_length_m * 1e3:.0f} mm from the grip at {peak.time_s:.2f} s of {peak.trial}"
    return at if not np.isfinite(peak.frequency_hz) else f"{at}, at {peak.frequency_hz:.1f} Hz"


def mm(value_m: float) -> str:
    """An error in a table; infinite where the model cannot be simulated."""
    return "–" if np.isnan(value_m) else f"{value_m * 1e3:.3f}"


def agreement_sentence(agreements: Sequence[Agreement]) -> str:
    """Which parameters agree between trials, and which do not; "" for a single trial."""
    if not agreements:
        return ""
    trials = f"The {len(agreements[0].by_trial)} trials"
    agreed = [parameter_in_words(a.parameter, a.unit) for a in agreements if a.agrees]
    disagreements = [
        f"{parameter_in_words(a.parameter, a.unit)}: {_estimates_by_trial(a)}"
        for a in agreements
        if not a.agrees
    ]
    if not disagreements:
        return f"{trials} agree on {_listed(agreed)}."
    agreeing = f" They agree on {_listed(agreed)}." if agreed else ""
    return f"{trials} disagree on {'; on '.join(disagreements)}.{agreeing}"


def _estimates_by_trial(agreement: Agreement) -> str:
    """Range of the estimates per trial, and the p-value of their differences."""
    values = [t.value for t in agreement.by_trial if t.value is not None]
    unit = after_number(agreement.unit)
    return (
        f"estimates per trial {digits(min(values), 3)} … {digits(max(values), 3)}{unit} "
        f"(p {chance(agreement.p_value, '= ')})"
    )


def _listed(names: Sequence[str]) -> str:
    """Names as a list with commas and a final "and"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def apart(low: float, high: float) -> tuple[str, str]:
    """Two numbers with three digits, or more, until rounding is a tenth of their difference."""
    many, allowed = 3, 0.1 * (high - low)
    while many < 12 and any(abs(float(f"{v:.{many}g}") - v) > allowed for v in (low, high)):
        many += 1
    return digits(low, many), digits(high, many)


def place_in_words(share: float) -> str:
    """Part of the cable, by the share of its length from the grip."""
    return "at the tip" if share > 0.8 else "at the grip" if share < 0.2 else "in mid-cable"


def plain(name: str) -> str:
    """An effect's name as words."""
    return name.replace("_", " ")


def parameter_in_words(name: str, unit: str) -> str:
    """A parameter as words: `added_mass.kg_per_m` is "added mass (kg/m)".

    A unit at the end of the name is shown in parentheses.
    """
    owner, _, own = name.rpartition(".")
    spoken = unit.replace("/", "_per_").replace("·", "_").replace("²", "2").replace("³", "3")
    ending = "_" + re.sub(r"[()]", "", spoken).lower()
    bare = f"_{own}".removesuffix(ending)
    shown = f" ({unit})" if bare != f"_{own}" else ""
    return " ".join(plain(f"{owner}_{bare}").split()) + shown


def short(value_mm: float) -> str:
    """Two decimals, or two significant digits of values below 0.1."""
    return f"{value_mm:.2f}" if value_mm >= 0.0995 else f"{value_mm:.2g}"


def digits(value: float, many: int) -> str:
    """A number with `many` significant digits; 0 has no sign."""
    return f"{value + 0.0:.{many}g}"


def with_interval(value: float, low: float, high: float) -> str:
    """A value with its interval, four digits each."""
    return f"{digits(value, 4)} ({digits(low, 4)} … {digits(high, 4)})"


def size_in_digits(value: float, none: float) -> str:
    """A size with three digits of its difference from `none`, the value without the effect."""
    if value in (0.0, none) or not math.isfinite(value):
        return f"{value:.3g}"
    more = math.floor(math.log10(abs(value))) - math.floor(math.log10(abs(value - none)))
    return f"{value:.{3 + max(more, 0)}g}"


def places(value: float, many: int) -> str:
    """A number with `many` decimals; a value that rounds to 0 has no sign."""
    shown = f"{value:.{many}f}"
    return shown if float(shown) else shown.lstrip("-")


def correlation(value: float) -> str:
    """A correlation with its sign; a value that rounds to 0 has none."""
    shown = f"{value:+z.2f}"
    return shown if float(shown) else "0.00"


def by_evidence(diagnosis: Diagnosis) -> list[RankedEffect]:
    """All effects by the χ² that each explains, the largest first, as listed and drawn."""
    return sorted(diagnosis.ranking, key=lambda r: -r.score)


def chance(p_value: float, equals: str = "") -> str:
    """A probability with one digit; one that underflows to 0 is shown as "< 1e-300"."""
    return f"{equals}{p_value:.1g}" if p_value > 0.0 else "< 1e-300"
