"""Estimates units of time and length, and standard deviations of arc lengths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.files.words import counted
from cell.study.entries import MAX_ARC_STD_FRACTION, MAX_LENGTH_M
from cell.study.imports.capture import ROW_NUMBER, Capture, CapturedColumn, Finding, Sure
from cell.study.imports.column_names import ColumnKind, meaning
from cell.study.imports.contents import FILM_RATES_HZ, Contents, Point, epoch_unit
from cell.study.imports.gripper_section import TimeSection
from cell.study.imports.shape import arc_lengths, middle, resting
from cell.study.imports.units import METRES, SECONDS
from cell.study.series import noise_m

#: Spreadsheets count days.
_DAY = {"day": 86_400.0}
#: Maximum ratio between the row rate of a log and the rate that its file states, or its inverse.
_RATE_RATIO = 5.0
#: Maximum relative difference between a stated rate and stated times.  Rounding, of times to
#: milliseconds and of rates to integers, causes less.
_RATE_ERROR = 0.05
#: Range of lengths of usual cables, m; units that give a length in it are candidates.
_USUAL_M = (0.02, 5.0)
#: Minimum span of markers, m; a stated unit that gives less is wrong.
_SHORTEST_M = 0.005
#: Maximum relative difference of the chain from the free length for determining the unit.
_LENGTH_ERROR = 0.3
#: Ratio of the markers' span to the free length, or its inverse, from which the unit is wrong.
WRONG_UNIT = 3.0
#: Maximum relative difference of equal rates, for 1 / rate with two digits.
_SAME_RATE = 0.005
#: Range of the ratio between the durations of two files of one motion.
_DURATION_RATIOS = (0.5, 3.0)
#: Times that begin later than this count from another epoch, s.
_EPOCH_S = 1000.0
#: Rows between the ends of columns of one rate, as a share of all rows.
_ENDS_APART = 0.1


def time_section(
    capture: Capture,
    inside: Contents,
    rate_hz: float | None,
    lasts_s: float | None = None,
    entry: str = "time",
) -> tuple[TimeSection, Finding]:
    """Column of time and its unit.

    rate_hz  rows a second that the user states; None = as the file states
    lasts_s  duration of another file of the same motion; None = there is none
    entry    of the mapping; --rate states that of the markers' times
    """
    column = inside.time or ROW_NUMBER
    if rate_hz is not None and is_coarse(capture.column(column)):
        column = ROW_NUMBER
    counts = inside.counts or column == ROW_NUMBER
    steps = np.diff(capture.column(column))
    step = float(np.nanmedian(steps)) if len(steps) else 0.0
    mean = float(np.nanmean(steps)) if len(steps) else 0.0
    if not counts and inside.time_unit in SECONDS:
        unit, sure, why = _as_stated(inside.time_unit, (step, mean), rate_hz, capture.rate_hz)
    else:
        epoch = "" if counts or rate_hz is not None else epoch_unit(capture.column(column))
        if epoch:
            unit, sure, why = SECONDS[epoch], Sure.SHOWN, f"{epoch} since 1970, by their size"
        else:
            unit, sure, why = _second(counts, step, steps, rate_hz, capture.rate_hz)
        if unit is None and lasts_s is not None:
            unit, sure, why = _by_duration(float(np.nansum(steps)), lasts_s) or (unit, sure, why)
    first = float(capture.column(column)[0]) * (unit or 1.0)
    zero = counts or abs(first) > _EPOCH_S
    if unit is None:
        sentence = f"time counts in steps of {step:g} in column {column!r}: {why}; give "
        sentence += f"{entry}.seconds_per_unit"
        sentence += ", or --rate" if rate_hz is None and entry == "time" else ""
    else:
        shown = f"{1.0 / (step * unit):.4g} rows a second" if step > 0.0 else "no steady rate"
        sentence = f"time is in column {column!r}, {unit:.6g} s a unit ({why}): {shown}"
    section = TimeSection(column=column, seconds_per_unit=unit, starts_at_zero=zero)
    return section, Finding("time", sentence, sure)


#: Minimum number of rows between two backward steps in time that form a separate recording.
_RECORDING_ROWS = 5


def time_of_markers(
    capture: Capture,
    inside: Contents,
    gripper: Point | None,
    markers: Sequence[Point],
    rate_hz: float | None,
) -> tuple[TimeSection, Finding]:
    """Times and their unit; if they count rows, to be given where the gripper's columns end long
    before or after the markers', as those of groups with a rate each do.
    """
    time, finding = time_section(capture, inside, rate_hz)
    if gripper is None or not (inside.counts or time.column == ROW_NUMBER):
        return time, finding
    seen = [np.isfinite(capture.at(p.columns)).all(axis=1) for p in (gripper, *markers)]
    hand, cable = (
        int(np.flatnonzero(rows).max(initial=0)) for rows in (seen[0], np.any(seen[1:], axis=0))
    )
    if abs(hand - cable) <= _ENDS_APART * len(capture.values):
        return time, finding
    name = capture.path.name
    sentence = f"the markers are seen in {cable + 1} rows of {name}, the gripper in {hand + 1}: if "
    sentence += f"each has its own rate, give --hand {name} for its gripper, too; else give "
    time = time.model_copy(update={"seconds_per_unit": None})
    return time, Finding("time", f"{sentence}time.seconds_per_unit", Sure.MISSING)


def times_s(capture: Capture, section: TimeSection) -> FloatArray:
    """(rows,) times.  Raises InputError: one is missing, repeated or before the one above it."""
    raw = capture.column(section.column)
    if len(raw) < 2:
        raise capture.error(0, f"has {counted(len(raw), 'row')}, needs at least 2")
    if not np.isfinite(raw).all():
        row = int(np.argmin(np.isfinite(raw)))
        raise capture.error(row, "is empty; every row needs its time", section.column)
    back = np.flatnonzero(np.diff(raw) <= 0.0) + 1
    if len(back):
        row = int(back[0])
        word = "repeats" if raw[row] == raw[row - 1] else "comes after"
        more = f", as in {len(back) - 1} more rows" if len(back) > 1 else ""
        remedy = "remove what is there twice, and sort the rows"
        if _has_restarts(raw, back):
            remedy = "another recording begins here: save each in a file of its own, or remove one"
        if is_coarse(raw):
            remedy = "its clock is coarser than the rows: give --rate, by which they are counted"
        raise capture.error(
            row,
            f"{raw[row]:.12g} {word} {raw[row - 1]:.12g} of the row before{more}; times must rise: "
            f"{remedy}",
            section.column,
        )
    return np.asarray(raw * (section.seconds_per_unit or 1.0))


def _has_restarts(raw: FloatArray, back: NDArray[np.intp]) -> bool:
    """Whether the times are of several recordings: large backward steps, many rows apart."""
    parts = np.diff([0, *back, len(raw)])
    steps = raw[back - 1] - raw[back]
    usual = float(np.median(np.diff(raw)))
    return bool(parts.min() >= _RECORDING_ROWS and steps.min() > _RECORDING_ROWS * usual > 0.0)


def is_coarse(times: FloatArray) -> bool:
    """Whether times (rows,) are from a coarse clock, which repeats in most of the rows."""
    steps = np.diff(times)
    return bool(len(steps) and np.all(steps >= 0.0) and 2 * np.count_nonzero(steps) < len(steps))


def counts_frames(time: TimeSection) -> bool:
    """Whether a column of times counts frames."""
    return meaning(CapturedColumn(time.column)).kind is ColumnKind.FRAME


def other_rate(capture: Capture, section: TimeSection) -> str:
    """Message if the mapping's row rate differs from the file's; else empty."""
    unit, rate_hz = section.seconds_per_unit, capture.rate_hz
    counts = section.column == ROW_NUMBER or counts_frames(section)
    if not counts or unit is None or rate_hz is None or abs(unit * rate_hz - 1.0) <= _SAME_RATE:
        return ""
    return (
        f"{capture.path}: states {rate_hz:g} rows a second, the mapping makes {1.0 / unit:.6g}; "
        f"if the file is right give the trial seconds_per_unit: {1.0 / rate_hz:.6g}"
    )


def _as_stated(
    name: str, steps: tuple[float, float], wanted_hz: float | None, file_hz: float | None
) -> tuple[float | None, Sure, str]:
    """Seconds a unit as the file states, unless a rate contradicts it; how sure, and why.

    steps  median and mean between rows
    """
    unit = SECONDS[name]
    for rate_hz, source in ((wanted_hz, "--rate says"), (file_hz, "the file's header says")):
        if rate_hz is None or min(steps) <= 0.0:
            continue
        if all(abs(step * unit * rate_hz - 1.0) > _RATE_ERROR for step in steps):
            shown = f"the file says {name}, which makes {1.0 / (steps[0] * unit):.4g} rows a second"
            if source.startswith("--"):
                return None, Sure.MISSING, f"{shown}, yet {source} {rate_hz:g}"
            return unit, Sure.GUESSED, f"{shown}, though {source} {rate_hz:g}"
    return unit, Sure.STATED, f"the file says {name}"


def _second(
    counts: bool, step: float, steps: FloatArray, wanted_hz: float | None, file_hz: float | None
) -> tuple[float | None, Sure, str]:
    """Seconds a unit that the file does not state, how sure, and why.

    wanted_hz, file_hz  rows a second as the user and as the file state; None = not stated
    """
    rate_hz = wanted_hz or file_hz
    if counts:
        if rate_hz is None:
            return None, Sure.MISSING, "it counts rows, and no rate is stated"
        return 1.0 / rate_hz, Sure.STATED, f"{rate_hz:g} rows a second are stated"
    by_steps, sure, why = _by_steps(step, steps)
    if rate_hz is None or not step > 0.0:
        return by_steps, sure, why
    target = 1.0 / rate_hz / step
    unit = min((SECONDS | _DAY).values(), key=lambda u: abs(np.log(u / target)))
    if abs(np.log(unit / target)) > _RATE_ERROR:
        if wanted_hz is None and by_steps and abs(np.log(by_steps / target)) < np.log(_RATE_RATIO):
            return by_steps, sure, f"{why}, though the file states {rate_hz:g} rows a second"
        unit = float(f"{target:.6g}")
    return unit, Sure.STATED, f"{rate_hz:g} rows a second are stated"


def _by_steps(step: float, steps: FloatArray) -> tuple[float | None, Sure, str]:
    """Seconds a unit by the steps between rows, how sure, and why."""
    if len(steps) and np.all(steps == 1.0):
        return None, Sure.MISSING, "frames, or milliseconds"
    low_hz, high_hz = FILM_RATES_HZ
    for name in ("s", "ms", "µs", "ns", "day"):
        unit = (SECONDS | _DAY)[name]
        if step > 0.0 and low_hz <= 1.0 / (step * unit) <= high_hz:
            return unit, Sure.GUESSED, f"{name}, a guess by steps of {step:.4g}"
    return None, Sure.MISSING, "no unit makes it a film"


def _by_duration(span: float, lasts_s: float) -> tuple[float, Sure, str] | None:
    """Unit in which times span the duration of another file of the motion, if it is unique."""
    low, high = _DURATION_RATIOS
    candidates = [n for n, unit in SECONDS.items() if low < span * unit / lasts_s < high]
    if len(candidates) != 1:
        return None
    reason = f"{candidates[0]}, for so it lasts as long as the markers' file"
    return SECONDS[candidates[0]], Sure.GUESSED, reason


def _plausible(span_m: float, free_length_m: float | None) -> bool:
    if free_length_m is None:
        return _SHORTEST_M <= span_m <= MAX_LENGTH_M
    return free_length_m / WRONG_UNIT < span_m < free_length_m * WRONG_UNIT


def metres_per_unit(
    units: set[str], extent: float, free_length_m: float | None, by_stroke: float | None = None
) -> tuple[float | None, Finding]:
    """Metres a unit of the coordinates.

    by_stroke  as the gripper's motion in its own file shows; None = it does not

    units   that the file states for them
    extent  length of the chain of points, in the file's unit
    """
    if by_stroke is not None:
        of_cable = "" if free_length_m is None else f" of the free length {free_length_m:g} m"
        sentence = f"a unit of length is {by_stroke:.4g} m, by the gripper's stroke in its own "
        sentence += f"file: then the markers span {extent * by_stroke:.3g} m{of_cable}"
        return float(f"{by_stroke:.6g}"), Finding("metres_per_unit", sentence, Sure.GUESSED)
    stated = next((u for u in sorted(units) if u in METRES), "")
    if stated and not _plausible(METRES[stated] * extent, free_length_m):
        long = f"{METRES[stated] * extent:.4g} m"
        against = f"{_SHORTEST_M:g} to {MAX_LENGTH_M:g} m"
        against = against if free_length_m is None else f"{free_length_m:g} m"
        sentence = f"the file says {stated}, which makes the markers span {long} of a cable of "
        sentence += f"{against}; give metres_per_unit{_remedy(extent, free_length_m)}, or take the "
        sentence += "columns of points that are not on the cable out of the file"
        return None, Finding("metres_per_unit", sentence, Sure.MISSING)
    if stated:
        sentence = f"lengths are in {stated}, as the file says"
        return METRES[stated], Finding("metres_per_unit", sentence, Sure.STATED)
    if free_length_m is not None and extent > 0.0:
        unit = free_length_m / extent
        name = min(METRES, key=lambda n: abs(np.log(METRES[n] / unit)))
        if abs(np.log(METRES[name] / unit)) < np.log1p(_LENGTH_ERROR):
            sentence = f"lengths are in {name}: the markers span {extent:.4g} of the cable"
            return METRES[name], Finding("metres_per_unit", sentence, Sure.SHOWN)
        sentence = (
            f"a unit of length is {unit:.4g} m, so that the markers span the free length; if it is "
            f"{name}, they span {extent * METRES[name]:.3g} m: one is missing, or the gripper"
        )
        return float(f"{unit:.6g}"), Finding("metres_per_unit", sentence, Sure.GUESSED)
    if "px" not in units:
        low, high = _USUAL_M
        candidates = [n for n in ("m", "mm", "cm") if low <= extent * METRES[n] <= high]
        if candidates:
            others = f", though {' or '.join(candidates[1:])} would do" if candidates[1:] else ""
            sentence = f"lengths are in {candidates[0]}, a guess by their size {extent:.4g}{others}"
            return METRES[candidates[0]], Finding("metres_per_unit", sentence, Sure.GUESSED)
    sentence = "the unit of length is not known; give metres_per_unit, or --free-length"
    return None, Finding("metres_per_unit", sentence, Sure.MISSING)


def _remedy(extent: float, free_length_m: float | None) -> str:
    """Text that proposes the most plausible unit; empty = there is none."""
    low, high = _USUAL_M
    candidates = [n for n in METRES if extent > 0.0 and low <= extent * METRES[n] <= high]
    if free_length_m is not None:
        candidates = [n for n in METRES if _plausible(extent * METRES[n], free_length_m)]
        candidates.sort(key=lambda n: abs(np.log(METRES[n] * extent / free_length_m)))
    if not candidates:
        return ""
    name = candidates[0]
    return f": {METRES[name]:g} if they are {name}, then they span {METRES[name] * extent:.4g} m"


#: Rounding step of proposed arc lengths, m.
ROUNDED_M = 1e-5
#: Smaller differences between values are rounding errors, m.
_SAME_M = 1e-9
#: Number of blocks of consecutive rows, each longer than the autocorrelation of a tracker's noise.
_BLOCKS = 6
#: The bend between only two points is unknown: 0.7 rad make a curve this fraction longer.
_PAIR, _OF_PAIR = 2, 0.02
#: Error of a curve's length, from simulated cables.  Three points: fraction of what the middle one
#: adds to the length.  More: fraction of the change by ends without curvature.
_OF_MIDDLE, _OF_ENDS = 0.4, 0.5


def arc_length_stds(places_m: FloatArray, length_m: float, from_hand: bool) -> FloatArray:
    """(markers,) standard deviation of arc lengths of a curve through points, m.

    Noise of markers is independent.  The error of the curve between points, and noise of the
    gripper, are common to all n markers.  A study allows independent errors only, so a common error
    is multiplied by √n.

    places_m   (rows, points, 2 or 3) in their order along the cable, nan = not seen
    length_m   free length of the cable
    from_hand  whether the first point is the gripping point; else the last is the cable's tip
    """
    most_m = MAX_ARC_STD_FRACTION * length_m
    lengths, added_m = _lengths_by_block(places_m)
    if len(lengths) < _PAIR:
        return np.full(places_m.shape[1] - from_hand, most_m)
    arcs = lengths[:, 1:] - lengths[:, :1] if from_hand else lengths - lengths[:, -1:]
    count = arcs.shape[1]
    each_m = _of_mean(arcs)
    common_m = np.sqrt(count) * _of_mean(arcs.mean(axis=1, keepdims=True))
    noise_std_m = np.maximum(each_m, max(float(np.sqrt(np.mean(each_m**2))), float(common_m[0])))
    rest = resting(places_m)
    shape = middle(places_m if rest is None else rest)
    curve_m = _between_points(shape, length_m) + added_m
    rounded = (ROUNDED_M**2 + _step_m(places_m) ** 2) / 12.0
    std_m = np.sqrt(noise_std_m**2 + count * curve_m**2 + rounded)
    return np.array([min(float(f"{s:.2g}"), most_m) for s in std_m])


def _of_mean(values: FloatArray) -> FloatArray:
    """Standard deviation of the mean over blocks (blocks, …)."""
    return np.asarray(np.std(values, axis=0, ddof=1) / np.sqrt(len(values)))


def _lengths_by_block(places_m: FloatArray) -> tuple[FloatArray, float]:
    """(blocks, points) arc lengths in blocks of rows, and the length that noise adds, m."""
    rest = resting(places_m)
    if rest is not None:
        return np.array([arc_lengths(shape[None]) for shape in _shapes(rest)]), 0.0
    blocks = np.array_split(places_m, min(_BLOCKS, len(places_m)))
    lengths = np.array([arc_lengths(block) for block in blocks])
    complete, added_m = places_m[np.isfinite(places_m).all(axis=(1, 2))], 0.0
    if len(complete) > _PAIR:  # each row's curve is that of noisy points
        std_m = float(np.nan_to_num(noise_m(complete)))
        noisier = complete + np.random.default_rng(0).normal(0.0, std_m, complete.shape)
        added_m = float(abs(arc_lengths(noisier)[-1] - arc_lengths(complete)[-1]))
    return lengths[np.isfinite(lengths).all(axis=1)], added_m


def _shapes(rest: FloatArray) -> FloatArray:
    """(blocks, points, d) medians in blocks of rows, for each point of rows that show it."""
    each = [point[np.isfinite(point).all(axis=1)] for point in rest.transpose(1, 0, 2)]
    count = min(_BLOCKS, *(len(point) for point in each))
    blocks = [[np.median(b, axis=0) for b in np.array_split(point, count)] for point in each]
    return np.array(blocks).transpose(1, 0, 2)


def _between_points(shape: FloatArray, length_m: float) -> float:
    """Possible error of the length of a curve through points (points, d), m."""
    curve_m = float(arc_lengths(shape[None])[-1])
    if len(shape) == _PAIR:
        return min(_OF_PAIR * curve_m, max(length_m - curve_m, 0.0))
    if len(shape) == _PAIR + 1:
        return _OF_MIDDLE * abs(curve_m - float(np.linalg.norm(shape[-1] - shape[0])))
    return _OF_ENDS * abs(curve_m - float(arc_lengths(shape[None], "natural")[-1]))


def _step_m(places_m: FloatArray) -> float:
    """Largest rounding step of a coordinate, m; it also rounds the median."""
    steps_m = [0.0]
    for values in places_m.reshape(len(places_m), -1).T:
        steps = np.diff(np.unique(values[np.isfinite(values)]))
        steps_m += [float(steps[steps > _SAME_M].min())] if np.any(steps > _SAME_M) else []
    return max(steps_m)
