"""Findings in plain words: sentences and parts of sentences of the lab."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from cell.lab.compare import NOTICEABLE, Comparison
from cell.lab.prepared import ERRS
from cell.lab.results import Agreement, Diagnosis, Limit, MissingEffect, Peak, TrialValue
from cell.lab.trial_residual import TrialResidual

#: Table of detection limits.
LIMIT_HEADS = ("effect", "parameter", "possible (95 %)", "moves the tip by, mm")
LIMIT_NOTE = (
    "Each effect alone beside the model found, of the shape that this study shows worst; what the "
    "model leaves counts as noise. Beyond that range it is excluded; within it could be there"
)

#: Table of what each trial says.
AGREEMENT_NOTE = (
    "Each trial's own value, 95 %, were the shape of EI along the cable and the exponent known as "
    "all trials together say; “spread”: standard deviation between trials beyond these intervals"
)


def unexplained(diagnosis: Diagnosis, misses: str, noise_name: str = "camera noise") -> str:
    """Sentence of a study that no effect explains to the noise: what comes nearest.

    misses  how much the model misses and where, the beginning of the sentence
    """
    noise = f"{noise_name} is {short(diagnosis.noise_m * 1e3)} mm"
    if not diagnosis.partial:
        said = f"{misses}, {noise}, and no effect that was tried explains it."
        if diagnosis.nearest:
            said += f" Nearest, fitted to all trials: {', '.join(_near(diagnosis))}."
        return said
    names = " and ".join(_class(f) for f in diagnosis.partial)
    share = percent(diagnosis.partial[-1].explained_share)
    explains = "explains" if len(diagnosis.partial) == 1 else "explain"
    said = f"{misses}, {noise}; {names} {explains} most of it, not all: {share}"
    if diagnosis.left is not None:
        said += (
            f", and {short(diagnosis.left.rms_m * 1e3)} mm stay, {diagnosis.left.over_noise:.1f} "
            f"times the noise, most {peak_in_words(diagnosis.left.peak)}"
        )
    return f"{said}. What that is, no effect that was tried tells."


def interrupted(diagnosis: Diagnosis, misses: str) -> str:
    """Sentence of a diagnosis that was stopped: what came nearest until then."""
    said = f"Interrupted. {misses} at {short(diagnosis.noise_m * 1e3)} mm of noise"
    if not diagnosis.nearest:
        return f"{said}; no effect was fitted yet."
    return f"{said}. Nearest so far, nothing confirmed: {', '.join(_near(diagnosis))}."


def _near(diagnosis: Diagnosis) -> list[str]:
    """Each of the nearest effects and what it leaves, mm."""
    return [
        f"{plain(n.effect)} explains {percent(n.explained_share)} and leaves "
        f"{short(n.left_rms_m * 1e3)} mm"
        for n in diagnosis.nearest
    ]


def _class(found: MissingEffect) -> str:
    """An effect and those that cannot be told from it."""
    return " or ".join(plain(n) for n in (found.effect, *found.tied_with))


def noise_like(noise_mm: float, final: Comparison | None) -> str:
    """What an error is that is no larger than the noise, in one consistent statement."""
    if final is None:
        return f"camera noise ({short(noise_mm)} mm)"
    patterns, trials = final.patterns(), len(final.where)
    seen = f"in {patterns} of {trials} trials it has a pattern, too small to be told what from"
    if not final.noise_is_stated:
        return (
            f"camera noise ({short(noise_mm)} mm)"
            if not patterns
            else (f"no larger than camera noise ({short(noise_mm)} mm); {seen}")
        )
    rest_mm = final.noise_at_rest_m * 1e3
    camera = f"; camera noise at rest is {short(rest_mm)} mm" if np.isfinite(rest_mm) else ""
    said = f"within the measurement's error as the study states it ({short(noise_mm)} mm){camera}"
    return said if not patterns else f"{said}; {seen}"


def left_in_words(where: TrialResidual, comparison: Comparison) -> str:
    """What a model leaves of a trial: noise, a pattern that is no larger, or more."""
    white = not where.whiteness_p_value < NOTICEABLE
    if where.rms_m > ERRS * comparison.noise_m:
        return "more than noise" if white else "a pattern above the noise"
    if white:
        return "noise"
    return (
        "a pattern within the stated error"
        if comparison.noise_is_stated
        else ("a pattern no larger than the noise")
    )


def noise_in_words(comparison: Comparison) -> str:
    """The noise, and how it is known."""
    at_rest_m = comparison.noise_at_rest_m
    if not comparison.noise_is_stated:
        return f"camera noise {short(comparison.noise_m * 1e3)} mm, measured at rest"
    camera = (
        f" (camera noise at rest {short(at_rest_m * 1e3)} mm)" if np.isfinite(at_rest_m) else ""
    )
    return f"error of the measurement {short(comparison.noise_m * 1e3)} mm, as stated{camera}"


def peak_in_words(peak: Peak) -> str:
    """Where a residual is largest."""
    at = f"{peak.arc_length_m * 1e3:.0f} mm from the grip at {peak.time_s:.2f} s of {peak.trial}"
    return at if not np.isfinite(peak.frequency_hz) else f"{at}, at {peak.frequency_hz:.1f} Hz"


def limit_rows(diagnosis: Diagnosis) -> list[list[str]]:
    """Of every effect neither named nor tied: what the study leaves possible, by `LIMIT_HEADS`."""
    return [
        [
            limit.effect,
            limit.parameter,
            _range(limit),
            "" if limit.tip_m is None else short(limit.tip_m * 1e3),
        ]
        for limit in sorted(diagnosis.limits, key=lambda one: one.high is None)
    ]


def agreement_sentence(found: Sequence[Agreement]) -> str:
    """Whether the trials agree, and on what they do not; "" of a single trial."""
    if not found:
        return ""
    trials = f"The {len(found[0].by_trial)} trials"
    one = [parameter_in_words(a.parameter, a.unit) for a in found if a.agrees]
    apart = [
        f"{parameter_in_words(a.parameter, a.unit)}: {_said_by_trials(a)}"
        for a in found
        if not a.agrees
    ]
    if not apart:
        return f"{trials} agree on {_listed(one)}."
    others = f" They agree on {_listed(one)}." if one else ""
    return f"{trials} disagree on {'; on '.join(apart)}.{others}"


def _said_by_trials(agreement: Agreement) -> str:
    """The range of what trials say of a parameter alone, and how surely they differ."""
    values = [t.value for t in agreement.by_trial if t.value is not None]
    unit = "" if agreement.unit == "1" else f" {agreement.unit}"
    return (
        f"alone they say {min(values):.3g} … {max(values):.3g}{unit} (p = {agreement.p_value:.1g})"
    )


def _listed(names: Sequence[str]) -> str:
    """Names as a person lists them."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def agreement_heads(found: Sequence[Agreement]) -> list[str]:
    """Heads of the table of what each trial says."""
    return ["trial", *(f"{a.parameter}{'' if a.unit == '1' else f', {a.unit}'}" for a in found)]


def agreement_rows(found: Sequence[Agreement]) -> list[list[str]]:
    """What every trial says of every parameter, all together, their spread, and whether it is one.

    By `agreement_heads`.
    """
    trials = zip(*(a.by_trial for a in found), strict=True)
    return [
        *([values[0].trial, *map(_own_value, values)] for values in trials),
        ["all together", *(f"{a.value:.4g}" for a in found)],
        ["spread", *(f"{a.spread:.2g}" for a in found)],
        ["they agree", *("yes" if a.agrees else f"no, p = {a.p_value:.1g}" for a in found)],
    ]


def _own_value(said: TrialValue) -> str:
    if said.value is None or said.low is None or said.high is None:
        return "–"
    low, high = apart(said.low, said.high)
    return f"{said.value:.4g} ({low} … {high})"


def _range(limit: Limit) -> str:
    if limit.low is None or limit.high is None:
        return "this study could not have shown it"
    low, high = apart(limit.low, limit.high)
    return f"{low} … {high} {'' if limit.unit == '1' else limit.unit}".strip()


def apart(low: float, high: float) -> tuple[str, str]:
    """Two numbers with three digits, and as many more as tell them apart to a tenth."""
    digits = 3
    while digits < 12 and abs(float(f"{low:.{digits}g}") - low) > 0.1 * (high - low):
        digits += 1
    while digits < 12 and abs(float(f"{high:.{digits}g}") - high) > 0.1 * (high - low):
        digits += 1
    return f"{low:.{digits}g}", f"{high:.{digits}g}"


def place_in_words(share: float) -> str:
    """Part of the cable, by the share of its length from the grip."""
    return "at the tip" if share > 0.8 else "at the grip" if share < 0.2 else "in mid-cable"


def plain(name: str) -> str:
    """An effect's name as words."""
    return name.replace("_", " ")


def parameter_in_words(name: str, unit: str) -> str:
    """A parameter as words: `added_mass.kg_per_m` is "added mass (kg/m)".

    A unit at the end of its name, as names in code have it, is shown as one.
    """
    owner, _, own = name.rpartition(".")
    spoken = unit.replace("/", "_per_").replace("·", "_").replace("²", "2").replace("³", "3")
    ending = "_" + re.sub(r"[()]", "", spoken).lower()
    bare = f"_{own}".removesuffix(ending)
    shown = f" ({unit})" if bare != f"_{own}" else ""
    return " ".join(plain(f"{owner}_{bare}").split()) + shown


def percent(share: float) -> str:
    """A share as a person reads it."""
    return f"{100 * share:z.0f} %" if np.isfinite(share) else "–"


def short(value_mm: float) -> str:
    """Two decimals, or two digits of what is smaller."""
    return f"{value_mm:.2f}" if value_mm >= 0.1 else f"{value_mm:.2g}"
