"""Files of the trials, and what a proposed mapping says of each: start, role, clock, form, rate."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cell.study.imports.capture import Capture
from cell.study.imports.contents import contents
from cell.study.imports.finding import Finding, Sure
from cell.study.imports.hand_section import TextSection, TimeSection
from cell.study.imports.mapping import Mapping, TrialEntry
from cell.study.imports.scales import time_section
from cell.study.imports.start import start_of


@dataclass(frozen=True)
class Files:
    """A trial's files as the mapping names them, and what they hold."""

    name: str
    file: str
    capture: Capture
    hand_file: str | None = None
    hand: Capture | None = None


def trial_names(files: Sequence[Path]) -> list[str]:
    """Names of trials by those of their files, each once."""
    names: list[str] = []
    for file in files:
        name = re.sub(r"[^A-Za-z0-9_.-]+", "_", file.stem).strip("_.-") or "trial"
        number = 2
        unique = name
        while unique in names:
            unique, number = f"{name}_{number}", number + 1
        names.append(unique)
    return names


def trial_entries(
    trials: Sequence[Files], mapping: Mapping, rate_hz: float | None
) -> tuple[list[TrialEntry], list[Finding]]:
    """Start, role and clock of every trial, and what its files have of their own.

    rate_hz  rows a second that somebody stated for all files of markers
    raises   InputError: times are in disorder, or a column is missing
    """
    entries: list[TrialEntry] = []
    findings: list[Finding] = []
    for number, (files, entry) in enumerate(zip(trials, mapping.trials, strict=True)):
        role = "validate" if len(trials) > 1 and number == len(trials) - 1 else "fit"
        own, told = _own(files, mapping, rate_hz)
        findings += told
        entry = entry.model_copy(update={"role": role, **own})
        of_trial = mapping.of_trial(entry)
        if of_trial.time.seconds_per_unit is None or mapping.metres_per_unit is None:
            entries.append(entry)
            continue
        begun, told = start_of(files.name, files.capture, files.hand, of_trial)
        entry = entry.model_copy(update=begun)
        entries.append(entry)
        findings += told
    if len(trials) > 1:
        sentence = (
            f"{trials[-1].name} is kept for comparison (role validate), the others are fitted"
        )
        findings.append(Finding("trials", sentence, Sure.GUESSED))
    return entries, findings


def text_section(capture: Capture) -> TextSection | None:
    """How a file is written as text; None = it is no text."""
    if capture.form is None:
        return None
    return TextSection(separator=capture.form.separator, decimal=capture.form.decimal)


def _own(
    files: Files, mapping: Mapping, rate_hz: float | None
) -> tuple[dict[str, Any], list[Finding]]:
    """Entries of a trial in which its files differ from the first trial's."""
    hand = mapping.hand
    own: dict[str, Any] = {}
    findings: list[Finding] = []
    both = [("", files.capture, mapping.text, mapping.time, rate_hz)]
    if files.hand is not None:
        both.append(("hand_", files.hand, hand.text, hand.time or mapping.time, None))
    for prefix, capture, text, time, stated_hz in both:
        form = text_section(capture)
        if form != text and form is not None:
            own[f"{prefix}text"] = form
            sentence = f"{capture.path.name}: cells are separated by {form.separator!r}, "
            sentence += f"the decimal mark is {form.decimal!r}"
            findings.append(Finding("trials.text", sentence, Sure.SEEN))
        unit, told = _seconds_per_unit(capture, time, stated_hz)
        findings += told
        if unit is not None:
            own[f"{prefix}seconds_per_unit"] = unit
    return own, findings


def _seconds_per_unit(
    capture: Capture, section: TimeSection, rate_hz: float | None
) -> tuple[float | None, list[Finding]]:
    """Seconds a unit of a file's times that it states otherwise than the first file does."""
    own, (found,) = time_section(capture, contents(capture), rate_hz)
    unit, of_first = own.seconds_per_unit, section.seconds_per_unit
    if own.column != section.column or unit == of_first:
        return None, []
    entry = "trials.seconds_per_unit"
    if found.sure is Sure.SAID and unit is not None:
        return unit, [Finding(entry, f"{capture.path.name}: {found.sentence}", Sure.SAID)]
    if found.sure is Sure.WANTED and of_first is not None:
        sentence = f"{capture.path.name} states no rate: it is taken as that of the first trial, "
        sentence += f"{1.0 / of_first:g} rows a second"
        return None, [Finding(entry, sentence, Sure.GUESSED)]
    return None, []
