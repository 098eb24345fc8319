"""Units of time and length for files that state none, and standard deviations of arc lengths."""

from __future__ import annotations

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.entries import MAX_ARC_STD_FRACTION, MAX_LENGTH_M
from cell.study.imports.capture import ROW_NUMBER, Capture, CapturedColumn, Finding, Sure
from cell.study.imports.column_names import ColumnKind, meaning
from cell.study.imports.contents import FILM_RATES_HZ, Contents, epoch_unit
from cell.study.imports.gripper_section import TimeSection
from cell.study.imports.shape import arc_lengths, middle, resting
from cell.study.imports.units import METRES, SECONDS
from cell.study.series import noise_m

#: Spreadsheets count days.
_DAY = {"day": 86_400.0}
#: A log has so many times more or fewer rows a second than its file states, at most.
_OTHER_RATE = 5.0
#: A stated rate and stated times contradict each other from this share on: times rounded to
#: milliseconds, and rates to whole numbers, differ by less.
_CONTRADICTS = 0.05
#: Lengths of cables that anybody films, in each unit; what is in two ranges is a guess.
_USUAL_M = (0.02, 5.0)
#: A stated unit that makes the markers span less is a wrong one, m.
_SHORTEST_M = 0.005
#: A stated free length decides the unit if the chain is this share longer or shorter at most.
_WITHIN = 0.3
#: Markers that span so many times more or less than the cable are in another unit.
WRONG_UNIT = 3.0
#: A rate is another one if it differs by more than two digits of 1 / rate may do.
_SAME_RATE = 0.005
#: Two files of one motion last equally long within these factors.
_AS_LONG = (0.5, 3.0)
#: What begins later than this counts from another epoch, s.
_EPOCH_S = 1000.0


def time_section(
    capture: Capture, inside: Contents, rate_hz: float | None, lasts_s: float | None = None
) -> tuple[TimeSection, Finding]:
    """Column of time and its unit.

    rate_hz  rows a second that somebody stated; None = as the file states
    lasts_s  duration of another file of the same motion; None = there is none
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
            unit, sure, why = SECONDS[epoch], Sure.SEEN, f"{epoch} since 1970, by their size"
        else:
            unit, sure, why = _second(counts, step, steps, rate_hz, capture.rate_hz)
        if unit is None and lasts_s is not None:
            unit, sure, why = _as_long(float(np.nansum(steps)), lasts_s) or (unit, sure, why)
    first = float(capture.column(column)[0]) * (unit or 1.0)
    zero = counts or abs(first) > _EPOCH_S
    if unit is None:
        sentence = f"time counts in steps of {step:g} in column {column!r}: {why}"
        sentence += "; give time.seconds_per_unit"
        sentence += "" if rate_hz is not None else ", or --rate"
    else:
        shown = f"{1.0 / (step * unit):.4g} rows a second" if step > 0.0 else "no steady rate"
        sentence = f"time is in column {column!r}, {unit:.6g} s a unit ({why}): {shown}"
    section = TimeSection(column=column, seconds_per_unit=unit, starts_at_zero=zero)
    return section, Finding("time", sentence, sure)


def is_coarse(times: FloatArray) -> bool:
    """Whether times (rows,) are from a coarse clock, which repeats in most of the rows."""
    steps = np.diff(times)
    return bool(len(steps) and np.all(steps >= 0.0) and 2 * np.count_nonzero(steps) < len(steps))


def other_rate(capture: Capture, section: TimeSection) -> str:
    """Message that rows are timed at another rate than their file states; else empty."""
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


def _as_stated(
    name: str, steps: tuple[float, float], wanted_hz: float | None, file_hz: float | None
) -> tuple[float | None, Sure, str]:
    """Seconds a unit that the file states, unless a rate contradicts it.

    steps  median and mean between rows
    """
    unit = SECONDS[name]
    for rate_hz, whose in ((wanted_hz, "--rate says"), (file_hz, "the file's header says")):
        if rate_hz is None or min(steps) <= 0.0:
            continue
        if all(abs(step * unit * rate_hz - 1.0) > _CONTRADICTS for step in steps):
            shown = f"the file says {name}, which makes {1.0 / (steps[0] * unit):.4g} rows a second"
            if whose.startswith("--"):
                return None, Sure.WANTED, f"{shown}, yet {whose} {rate_hz:g}"
            return unit, Sure.GUESSED, f"{shown}, though {whose} {rate_hz:g}"
    return unit, Sure.SAID, f"the file says {name}"


def _second(
    counts: bool, step: float, steps: FloatArray, wanted_hz: float | None, file_hz: float | None
) -> tuple[float | None, Sure, str]:
    """Seconds a unit that the file does not state, how sure, and why.

    wanted_hz, file_hz  rows a second that somebody and that the file states; None = not stated
    """
    rate_hz = wanted_hz or file_hz
    if counts:
        if rate_hz is None:
            return None, Sure.WANTED, "it counts rows, and no rate is stated"
        return 1.0 / rate_hz, Sure.SAID, f"{rate_hz:g} rows a second are stated"
    by_steps, sure, why = _by_steps(step, steps)
    if rate_hz is not None and step > 0.0:
        wanted = 1.0 / rate_hz / step
        units = (SECONDS | _DAY).values()
        unit = min(units, key=lambda u: abs(np.log(u / wanted)))
        if abs(np.log(unit / wanted)) <= _CONTRADICTS:
            return unit, Sure.SAID, f"{rate_hz:g} rows a second are stated"
        if wanted_hz is None and by_steps and abs(np.log(by_steps / wanted)) < np.log(_OTHER_RATE):
            return by_steps, sure, f"{why}, though the file states {rate_hz:g} rows a second"
        return float(f"{wanted:.6g}"), Sure.SAID, f"{rate_hz:g} rows a second are stated"
    return by_steps, sure, why


def _by_steps(step: float, steps: FloatArray) -> tuple[float | None, Sure, str]:
    """Seconds a unit by the steps between rows, how sure, and why."""
    if len(steps) and np.all(steps == 1.0):
        return None, Sure.WANTED, "frames, or milliseconds"
    low_hz, high_hz = FILM_RATES_HZ
    for name in ("s", "ms", "µs", "ns", "day"):
        unit = (SECONDS | _DAY)[name]
        if step > 0.0 and low_hz <= 1.0 / (step * unit) <= high_hz:
            return unit, Sure.GUESSED, f"{name}, a guess by steps of {step:.4g}"
    return None, Sure.WANTED, "no unit makes it a film"


def _as_long(span: float, lasts_s: float) -> tuple[float, Sure, str] | None:
    """The only unit in which times span as long as another file of the same motion lasts."""
    low, high = _AS_LONG
    fitting = [n for n, unit in SECONDS.items() if low < span * unit / lasts_s < high]
    if len(fitting) != 1:
        return None
    why = f"{fitting[0]}, for so it lasts as long as the markers' file"
    return SECONDS[fitting[0]], Sure.GUESSED, why


def _fits(span_m: float, free_length_m: float | None) -> bool:
    """Whether markers may span so much of a cable: three times less or more is another unit."""
    if free_length_m is None:
        return _SHORTEST_M <= span_m <= MAX_LENGTH_M
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
        against = f"{_SHORTEST_M:g} to {MAX_LENGTH_M:g} m"
        against = against if free_length_m is None else f"{free_length_m:g} m"
        sentence = f"the file says {stated}, which makes the markers span {long} of a cable of "
        sentence += f"{against}; give metres_per_unit{_likely(extent, free_length_m)}"
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
            f"{name}, they span {extent * METRES[name]:.3g} m: one is missing, or the gripper"
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


def _likely(extent: float, free_length_m: float | None) -> str:
    """The unit in which a chain of points is as long as a cable, in words; empty = none is."""
    low, high = _USUAL_M
    fitting = [n for n in METRES if extent > 0.0 and low <= extent * METRES[n] <= high]
    if free_length_m is not None:
        fitting = [n for n in METRES if _fits(extent * METRES[n], free_length_m)]
        fitting.sort(key=lambda n: abs(np.log(METRES[n] * extent / free_length_m)))
    if not fitting:
        return ""
    name = fitting[0]
    return f": {METRES[name]:g} if they are {name}, then they span {METRES[name] * extent:.4g} m"


#: Arc lengths are proposed to so much, m.
ROUNDED_M = 1e-5
#: Values nearer to each other differ by how they are computed, m.
_SAME_M = 1e-9
#: Consecutive rows are parted into so many blocks, long enough for a tracker's slow noise.
_BLOCKS = 6
#: Nothing shows the bend between two points: 0.7 rad make a curve this share longer.
_TWO, _ONE_PIECE = 2, 0.02
#: Of three points this share of what the middle one adds is left open; of more, this share of what
#: the curve's length changes by if its ends are not bent: what was wrong on simulated cables.
_OF_MIDDLE, _OF_ENDS = 0.4, 0.5


def arc_length_stds(places_m: FloatArray, length_m: float, from_hand: bool) -> FloatArray:
    """(markers,) standard deviation of arc lengths that a curve through points shows, m.

    Noise shifts each marker by itself.  What the curve does between two points, and noise of the
    gripper, is one error of all n markers; a study knows only independent ones, so it counts √n
    times.

    places_m   (rows, points, 2 or 3) in their order along the cable, nan = not seen
    length_m   free length of the cable
    from_hand  whether the first point is the gripping point; else the last is the cable's tip
    """
    most_m = MAX_ARC_STD_FRACTION * length_m
    lengths, added_m = _lengths_by_block(places_m)
    if len(lengths) < _TWO:
        return np.full(places_m.shape[1] - from_hand, most_m)
    arcs = lengths[:, 1:] - lengths[:, :1] if from_hand else lengths - lengths[:, -1:]
    count = arcs.shape[1]
    own = _of_mean(arcs)
    alike = np.sqrt(count) * _of_mean(arcs.mean(axis=1, keepdims=True))
    noise_std_m = np.maximum(own, max(float(np.sqrt(np.mean(own**2))), float(alike[0])))
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
    """(blocks, points) arc lengths by parts of the rows, and by what noise makes all longer, m."""
    rest = resting(places_m)
    if rest is not None:
        return np.array([arc_lengths(shape[None]) for shape in _shapes(rest)]), 0.0
    blocks = np.array_split(places_m, min(_BLOCKS, len(places_m)))
    lengths = np.array([arc_lengths(block) for block in blocks])
    whole, added_m = places_m[np.isfinite(places_m).all(axis=(1, 2))], 0.0
    if len(whole) > _TWO:  # each row's curve is that of noisy points
        std_m = float(np.nan_to_num(noise_m(whole)))
        noisier = whole + np.random.default_rng(0).normal(0.0, std_m, whole.shape)
        added_m = float(abs(arc_lengths(noisier)[-1] - arc_lengths(whole)[-1]))
    return lengths[np.isfinite(lengths).all(axis=1)], added_m


def _shapes(rest: FloatArray) -> FloatArray:
    """(blocks, points, d) medians of parts of the rows, of each point by those that show it."""
    each = [point[np.isfinite(point).all(axis=1)] for point in rest.transpose(1, 0, 2)]
    count = min(_BLOCKS, *(len(point) for point in each))
    blocks = [[np.median(b, axis=0) for b in np.array_split(point, count)] for point in each]
    return np.array(blocks).transpose(1, 0, 2)


def _between_points(shape: FloatArray, length_m: float) -> float:
    """By how much a curve through points (points, d) may be longer or shorter than the cable, m."""
    whole = float(arc_lengths(shape[None])[-1])
    if len(shape) == _TWO:
        return min(_ONE_PIECE * whole, max(length_m - whole, 0.0))
    if len(shape) == _TWO + 1:
        return _OF_MIDDLE * abs(whole - float(np.linalg.norm(shape[-1] - shape[0])))
    return _OF_ENDS * abs(whole - float(arc_lengths(shape[None], "natural")[-1]))


def _step_m(places_m: FloatArray) -> float:
    """Largest step to which a coordinate is rounded, m; so is its median, then."""
    steps_m = [0.0]
    for values in places_m.reshape(len(places_m), -1).T:
        steps = np.diff(np.unique(values[np.isfinite(values)]))
        steps_m += [float(steps[steps > _SAME_M].min())] if np.any(steps > _SAME_M) else []
    return max(steps_m)
