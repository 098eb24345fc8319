"""A study without outliers of its markers and wrenches, with notes that list them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError, Problem
from cell.study.data import Source, Study, Trial
from cell.study.independence import without_copies
from cell.study.sample_outliers import outlier_distances
from cell.study.wrench import COLUMNS, FILE, UNITS

#: Largest share of outliers in a marker's rows, beyond which its tracking is bad; and a number of
#: outliers that is always permitted, as in a short trial.
MAX_OUTLIER_SHARE, FEW = 0.02, 3
#: Number of outliers that are listed per trial.
LISTED = 3


def without_outliers(study: Study) -> Study:
    """The study with outliers of markers set to nan, and notes of them.

    raises  InputError: too many of a marker are wrong
    """
    wrong = [
        outlier_distances(t.markers.t_s, t.markers.xy_m.reshape(len(t.markers.t_s), -1))
        for t in study.trials
    ]
    return without_samples(study, wrong)


def without_samples(study: Study, wrong: Sequence[FloatArray]) -> Study:
    """The study with these outliers set to nan, and a note per trial that has any.

    wrong   per trial (times, channels), m: distance of each outlier, nan elsewhere
    raises  InputError: too many of a marker are wrong
    """
    trials: list[Trial] = []
    notes: list[str] = []
    problems: list[Problem] = []
    for trial, apart in zip(study.trials, wrong, strict=True):
        apart_m = apart.reshape(trial.markers.xy_m.shape)
        there = np.isfinite(apart_m)
        if not there.any():
            trials.append(trial)
            continue
        source = trial.source
        counted_m = _across_only(trial, apart_m) if study.filmed else apart_m
        if problem := _too_many(trial, counted_m, source):
            problems.append(problem)
        notes.append(_note(apart_m, source))
        cleaned_m = np.where(there, np.nan, trial.markers.xy_m)
        trials.append(replace(trial, markers=replace(trial.markers, xy_m=cleaned_m)))
    if problems:
        raise InputError(problems)
    return replace(study, trials=tuple(trials), notes=(*study.notes, *notes))


def most_outliers(rows: NDArray[np.int_]) -> NDArray[np.int_]:
    """Largest permitted number of outliers in a number of detected rows."""
    return np.asarray(np.maximum(FEW, np.floor(MAX_OUTLIER_SHARE * rows)), dtype=int)


def limit_text(most: int) -> str:
    """Text of the limit on outliers."""
    return f"limit {MAX_OUTLIER_SHARE:.0%}" if most > FEW else f"limit {most}"


def _across_only(trial: Trial, apart_m: FloatArray) -> FloatArray:
    """`apart_m` (times, markers, 2) of samples that lie apart across the cable, nan elsewhere."""
    if apart_m.shape[1] == 1:
        return apart_m
    along = np.gradient(trial.markers.xy_m, axis=1)
    offset = np.nan_to_num(apart_m)
    lengthwise = np.abs(np.sum(offset * along, axis=2))
    crosswise = np.abs(offset[..., 1] * along[..., 0] - offset[..., 0] * along[..., 1])
    return np.where((lengthwise > crosswise)[..., None], np.nan, apart_m)


def _too_many(trial: Trial, apart_m: FloatArray, source: Source) -> Problem | None:
    """Problem of a marker with more outliers than permitted; else None."""
    rows = np.asarray(np.isfinite(apart_m).any(axis=2))
    detected = np.isfinite(trial.markers.xy_m).any(axis=2).sum(axis=0)
    count = rows.sum(axis=0)
    most = most_outliers(detected)
    if not np.any(count > most):
        return None
    marker = int(np.argmax(count - most))
    row = int(np.argmax(rows[:, marker]))
    axis = int(np.nanargmax(np.abs(apart_m[row, marker])))
    value_m, away_m = trial.markers.xy_m[row, marker, axis], apart_m[row, marker, axis]
    return Problem(
        source.file,
        int(source.lines[row]),
        None,
        source.column(marker, axis),
        f"{value_m:g} m lies {away_m * 1e3:+.2g} mm apart from the rows before and after it, as "
        f"do {count[marker]} of this marker's {detected[marker]} rows; {limit_text(most[marker])}: "
        "mend how the marker is tracked, or empty the cells where it is not",
    )


def _note(apart_m: FloatArray, source: Source) -> str:
    """Note on the outliers of a trial: number, places and distances of the largest."""
    away = np.nan_to_num(np.abs(apart_m))
    rows = np.flatnonzero((away > 0.0).any(axis=(1, 2)))
    farthest = rows[np.argsort(-away[rows].max(axis=(1, 2)), kind="stable")]
    places = [_place(int(row), apart_m[row], source) for row in farthest[:LISTED]]
    more = f" and {len(rows) - LISTED} more lines" if len(rows) > LISTED else ""
    count = int(np.count_nonzero(away))
    values, lies = ("value", "lies") if count == 1 else ("values", "lie")
    return (
        f"{source.file}: {count} {values} {lies} apart from the rows before and after, as no cable "
        f"does: {', '.join(places)}{more}; left out"
    )


def _place(row: int, apart_m: FloatArray, source: Source) -> str:
    """Text of the largest outlier in a line."""
    marker, axis = np.unravel_index(int(np.nanargmax(np.abs(apart_m))), apart_m.shape)
    column = source.column(int(marker), int(axis))
    others = int(np.isfinite(apart_m).sum()) - 1
    more = f" and {others} more of its columns" if others else ""
    return f"line {source.lines[row]}, {column} by {apart_m[marker, axis] * 1e3:+.2g} mm{more}"


def notes_of_samples(study: Study) -> list[str]:
    """Notes of outliers, and of trials that are copies of one recording.

    raises  InputError: too many samples are wrong
    """
    return list(without_copies(without_outliers(study)).notes[len(study.notes) :])


#: Groups of columns with a common amplifier: forces, and the moment.
_TOGETHER = (slice(0, 2), slice(2, 3))


def without_wrench_outliers(study: Study, folder: Path) -> Study:
    """The study with outliers of wrenches set to not measured, and notes of them.

    folder  of the study, for messages
    raises  InputError: too many of a column are wrong
    """
    trials, notes, problems = [], list(study.notes), []
    for trial in study.trials:
        if trial.wrench is None:
            trials.append(trial)
            continue
        values, t_s = trial.wrench.values, trial.wrench.t_s
        apart = np.concatenate([outlier_distances(t_s, values[:, c]) for c in _TOGETHER], axis=1)
        outliers, file = np.isfinite(apart), folder / trial.name / FILE
        if outliers.any():
            notes.append(_note_of_wrench(file, apart))
        measured, count = np.isfinite(values).sum(axis=0), outliers.sum(axis=0)
        most = most_outliers(measured)
        for i in np.flatnonzero(count > most)[:1]:
            message = (
                f"lies apart from the rows before and after it, as do {count[i]} of {measured[i]} "
                f"rows; {limit_text(most[i])}: mend the sensor's record, or leave the column out"
            )
            line = int(np.argmax(outliers[:, i])) + 2
            problems.append(Problem(file, line, None, COLUMNS[i], message))
        cleaned = replace(trial.wrench, values=np.where(outliers, np.nan, values))
        trials.append(replace(trial, wrench=cleaned))
    if problems:
        raise InputError(problems)
    return replace(study, trials=tuple(trials), notes=tuple(notes))


def _note_of_wrench(file: Path, apart: FloatArray) -> str:
    """Note on the outliers of a wrench: number, places and distances of the first."""
    places = np.argwhere(np.isfinite(apart))
    shown = [
        f"line {row + 2}, {COLUMNS[i]} by {apart[row, i]:+.2g} {UNITS[COLUMNS[i]]}"
        for row, i in places[:LISTED]
    ]
    more = f" and {len(places) - LISTED} more" if len(places) > LISTED else ""
    return (
        f"{file}: {len(places)} values apart from the rows before and after, as no motion makes "
        f"them: {', '.join(shown)}{more}; left out"
    )
