"""Findings in plain words: sentences and parts of sentences of the lab."""

from __future__ import annotations

import numpy as np

from cell.lab.results import Diagnosis, Found, Peak


def unexplained(diagnosis: Diagnosis, misses: str) -> str:
    """Sentence of a study that no effect explains to the noise: what comes nearest.

    misses  how much the model misses and where, the beginning of the sentence
    """
    noise = f"camera noise is {short(diagnosis.noise_m * 1e3)} mm"
    if not diagnosis.partial:
        said = f"{misses}, {noise}, and no known effect explains it: try `cell discover`."
        if diagnosis.nearest:
            said += f" Nearest, fitted to all trials: {', '.join(_near(diagnosis))}."
        return said
    names = " and ".join(_class(f) for f in diagnosis.partial)
    share = 100.0 * diagnosis.partial[-1].explained_share
    explains = "explains" if len(diagnosis.partial) == 1 else "explain"
    said = f"{misses}, {noise}; {names} {explains} most of it, not all: {share:.0f} %"
    if diagnosis.left is not None:
        said += (
            f", and {short(diagnosis.left.rms_m * 1e3)} mm stay, {diagnosis.left.over_noise:.1f} "
            f"times the noise, most {peak_in_words(diagnosis.left.peak)}"
        )
    return f"{said}. What that is, no known effect tells: try `cell discover`."


def _near(diagnosis: Diagnosis) -> list[str]:
    """Each of the nearest effects and what it leaves, mm."""
    return [
        f"{plain(n.effect)} explains {100 * n.explained_share:.0f} % and leaves "
        f"{short(n.left_rms_m * 1e3)} mm"
        for n in diagnosis.nearest
    ]


def _class(found: Found) -> str:
    """An effect and those that cannot be told from it."""
    return " or ".join(plain(n) for n in (found.effect, *found.tied_with))


def peak_in_words(peak: Peak) -> str:
    """Where a residual is largest."""
    at = f"{peak.arc_length_m * 1e3:.0f} mm from the grip at {peak.time_s:.2f} s of {peak.trial}"
    return at if not np.isfinite(peak.frequency_hz) else f"{at}, at {peak.frequency_hz:.1f} Hz"


def place_in_words(share: float) -> str:
    """Part of the cable, by the share of its length from the grip."""
    return "at the tip" if share > 0.8 else "at the grip" if share < 0.2 else "in mid-cable"


def plain(name: str) -> str:
    """An effect's name as words."""
    return name.replace("_", " ")


def short(value_mm: float) -> str:
    """Two decimals, or two digits of what is smaller."""
    return f"{value_mm:.2f}" if value_mm >= 0.1 else f"{value_mm:.2g}"
