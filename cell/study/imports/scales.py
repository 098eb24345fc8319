"""Units of time and length where a file states none: by what recordings of cables usually are."""

from __future__ import annotations

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.entries import MAX_LENGTH_M
from cell.study.imports.capture import ROW_NUMBER, Capture, CapturedColumn
from cell.study.imports.column_names import ColumnKind, meaning
from cell.study.imports.contents import Contents
from cell.study.imports.finding import Finding, Sure
from cell.study.imports.hand_section import TimeSection
from cell.study.imports.units import METRES, SECONDS

#: Steps between rows at rates from 2 to 2000 a second; the units' ranges meet and do not overlap.
_LONGEST_STEP_S = 0.5
#: Lengths of cables that anybody films, in each unit; what is in two ranges is a guess.
_USUAL_M = (0.02, 5.0)
#: A stated free length decides the unit if the chain is this share longer or shorter at most.
_WITHIN = 0.3
#: Markers that span so many times more or less than the cable are in another unit.
WRONG_UNIT = 3.0
#: A rate is another one if it differs by more than two digits of 1 / rate may do.
_SAME_RATE = 0.005
#: What begins later than this counts from another epoch, s.
_EPOCH_S = 1000.0


def time_section(
    capture: Capture, inside: Contents, rate_hz: float | None
) -> tuple[TimeSection, list[Finding]]:
    """Column of time and its unit.

    rate_hz  rows a second that somebody stated; None = as the file states
    """
    rate_hz = rate_hz or capture.rate_hz
    column = inside.time or ROW_NUMBER
    counts = inside.counts or inside.time is None
    steps = np.diff(capture.column(column))
    step = float(np.nanmedian(steps)) if len(steps) else 0.0
    unit, sure, why = _second(inside, counts, step, steps, rate_hz)
    first = float(capture.column(column)[0]) * (unit or 1.0)
    zero = counts or abs(first) > _EPOCH_S
    if unit is None:
        sentence = f"time counts in steps of {step:g} in column {column!r}: {why}"
        sentence += "; give time.seconds_per_unit, or --rate"
    else:
        shown = f"{1.0 / (step * unit):.4g} rows a second" if step > 0.0 else "no steady rate"
        sentence = f"time is in column {column!r}, {unit:.6g} s a unit ({why}): {shown}"
    section = TimeSection(column=column, seconds_per_unit=unit, starts_at_zero=zero)
    return section, [Finding("time", sentence, sure)]


def other_rate(capture: Capture, section: TimeSection) -> str:
    """That rows are counted at another rate than their file states; empty if they are not."""
    unit, rate_hz = section.seconds_per_unit, capture.rate_hz
    counts = (
        section.column == ROW_NUMBER
        or meaning(CapturedColumn(section.column)).kind is ColumnKind.FRAME
    )
    if not counts or unit is None or rate_hz is None:
        return ""
    if abs(unit * rate_hz - 1.0) <= _SAME_RATE:
        return ""
    return (
        f"{capture.path}: states {rate_hz:g} rows a second, the mapping makes {1.0 / unit:.6g}; "
        f"if the file is right give the trial seconds_per_unit: {1.0 / rate_hz:.6g}"
    )


def _second(
    inside: Contents, counts: bool, step: float, steps: FloatArray, rate_hz: float | None
) -> tuple[float | None, Sure, str]:
    """Seconds a unit, how sure, and why."""
    if counts:
        if rate_hz is None:
            return None, Sure.WANTED, "it counts rows, and no rate is stated"
        return 1.0 / rate_hz, Sure.SAID, f"{rate_hz:g} rows a second are stated"
    if inside.time_unit in SECONDS:
        return SECONDS[inside.time_unit], Sure.SAID, f"the file says {inside.time_unit}"
    if rate_hz is not None and step > 0.0:
        wanted = 1.0 / rate_hz / step
        unit = min(SECONDS.values(), key=lambda u: abs(np.log(u / wanted)))
        return unit, Sure.SAID, f"{rate_hz:g} rows a second are stated"
    if len(steps) and np.all(steps == 1.0):
        return None, Sure.WANTED, "frames, or milliseconds"
    for unit in (1.0, 1e-3, 1e-6, 1e-9):
        if step * unit <= _LONGEST_STEP_S:
            return unit, Sure.GUESSED, f"a guess by steps of {step:.4g}"
    return None, Sure.WANTED, "no unit makes it a film"


def _fits(span_m: float, free_length_m: float | None) -> bool:
    """Whether markers may span so much of a cable: three times less or more is another unit."""
    if free_length_m is None:
        return span_m <= MAX_LENGTH_M
    return free_length_m / WRONG_UNIT < span_m < free_length_m * WRONG_UNIT


def metres_per_unit(
    units: set[str], extent: float, free_length_m: float | None
) -> tuple[float | None, Finding]:
    """Metres a unit of the coordinates.

    units   that the file states for them
    extent  length of the chain of points, in the file's unit
    """
    stated = next((u for u in sorted(units) if u in METRES), "")
    if stated and not _fits(METRES[stated] * extent, free_length_m):
        long = f"{METRES[stated] * extent:.4g} m"
        against = "10 m at most" if free_length_m is None else f"{free_length_m:g} m"
        sentence = f"the file says {stated}, which makes the markers span {long} of a cable of "
        sentence += f"{against}; give metres_per_unit"
        return None, Finding("metres_per_unit", sentence, Sure.WANTED)
    if stated:
        sentence = f"lengths are in {stated}, as the file says"
        return METRES[stated], Finding("metres_per_unit", sentence, Sure.SAID)
    if free_length_m is not None and extent > 0.0:
        unit = free_length_m / extent
        name = min(METRES, key=lambda n: abs(np.log(METRES[n] / unit)))
        if abs(np.log(METRES[name] / unit)) < np.log1p(_WITHIN):
            sentence = f"lengths are in {name}: the markers span {extent:.4g} of the cable"
            return METRES[name], Finding("metres_per_unit", sentence, Sure.SEEN)
        sentence = (
            f"a unit of length is {unit:.4g} m, so that the markers span the free length; if it is "
            f"{name}, they span {extent * METRES[name]:.3g} m: one is missing, or the hand"
        )
        return float(f"{unit:.6g}"), Finding("metres_per_unit", sentence, Sure.GUESSED)
    if "px" not in units:
        low, high = _USUAL_M
        fitting = [n for n in ("m", "mm", "cm") if low <= extent * METRES[n] <= high]
        if fitting:
            others = f", though {' or '.join(fitting[1:])} would do" if fitting[1:] else ""
            sentence = f"lengths are in {fitting[0]}, a guess by their size {extent:.4g}{others}"
            return METRES[fitting[0]], Finding("metres_per_unit", sentence, Sure.GUESSED)
    sentence = "the unit of length is not known; give metres_per_unit, or --free-length"
    return None, Finding("metres_per_unit", sentence, Sure.WANTED)
