"""A study without the samples of its markers that are wrong, and what is told of these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError, Problem
from cell.study.data import Source, Study, Trial
from cell.study.wrong_samples import wrong_samples

#: A marker that is wrong in a larger share of its rows is badly tracked: that is no slip, and no
#: noise either.  So many rows always may be wrong, as in a short trial.
MOST_WRONG, FEW = 0.02, 3
#: Rows and columns that are told of a trial.
TOLD = 3


def without_wrong_samples(study: Study) -> Study:
    """The study with samples that no cable shows as not seen, and with notes of them.

    raises  InputError: too many of a marker are wrong
    """
    wrong = [
        wrong_samples(t.markers.t_s, t.markers.xy_m.reshape(len(t.markers.t_s), -1))
        for t in study.trials
    ]
    return leaving_out(study, wrong)


def leaving_out(study: Study, wrong: Sequence[FloatArray]) -> Study:
    """The study without what is wrong, and with a note for every trial that has such.

    wrong   per trial (times, channels), m: by how much samples lie apart, nan where one is right
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
        source = _source(trial)
        counted_m = _across_only(trial, apart_m) if study.filmed else apart_m
        if problem := _too_many(trial, counted_m, source):
            problems.append(problem)
        notes.append(_note(apart_m, source))
        kept = np.where(there, np.nan, trial.markers.xy_m)
        trials.append(replace(trial, markers=replace(trial.markers, xy_m=kept)))
    if problems:
        raise InputError(problems)
    return replace(study, trials=tuple(trials), notes=(*study.notes, *notes))


def most_wrong(seen: NDArray[np.int_]) -> NDArray[np.int_]:
    """Of so many rows seen, how many may be wrong."""
    return np.asarray(np.maximum(FEW, np.floor(MOST_WRONG * seen)), dtype=int)


def limit_said(most: int) -> str:
    """The limit of wrong rows, as a message says it."""
    return f"limit {MOST_WRONG:.0%}" if most > FEW else f"limit {most}"


def _across_only(trial: Trial, apart_m: FloatArray) -> FloatArray:
    """`apart_m` (times, markers, 2) of samples that lie apart across the cable, nan elsewhere."""
    if apart_m.shape[1] == 1:
        return apart_m
    along = np.gradient(trial.markers.xy_m, axis=1)
    offset = np.nan_to_num(apart_m)
    lengthwise = np.abs(np.sum(offset * along, axis=2))
    crosswise = np.abs(offset[..., 1] * along[..., 0] - offset[..., 0] * along[..., 1])
    return np.where((lengthwise > crosswise)[..., None], np.nan, apart_m)


def _source(trial: Trial) -> Source:
    """Where a trial's markers stand, or would as written."""
    frames, markers = trial.markers.xy_m.shape[:2]
    file = Path(trial.name) / "markers.csv"
    return trial.markers.source or Source(file, np.arange(frames) + 2, np.arange(markers))


def _too_many(trial: Trial, apart_m: FloatArray, source: Source) -> Problem | None:
    """That more rows of a marker are wrong than may be left out."""
    rows = np.asarray(np.isfinite(apart_m).any(axis=2))
    seen = np.isfinite(trial.markers.xy_m).any(axis=2).sum(axis=0)
    count = rows.sum(axis=0)
    most = most_wrong(seen)
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
        f"do {count[marker]} of this marker's {seen[marker]} rows; {limit_said(most[marker])}: "
        "mend how the marker is tracked, or empty the cells where it is not",
    )


def _note(apart_m: FloatArray, source: Source) -> str:
    """How many samples of a trial are left out, where the farthest are, and by how much."""
    away = np.nan_to_num(np.abs(apart_m))
    rows = np.flatnonzero((away > 0.0).any(axis=(1, 2)))
    farthest = rows[np.argsort(-away[rows].max(axis=(1, 2)), kind="stable")]
    told = [_place(int(row), apart_m[row], source) for row in farthest[:TOLD]]
    more = f" and {len(rows) - TOLD} more lines" if len(rows) > TOLD else ""
    count = int(np.count_nonzero(away))
    values, lies = ("value", "lies") if count == 1 else ("values", "lie")
    return (
        f"{source.file}: {count} {values} {lies} apart from the rows before and after, as no cable "
        f"does: {', '.join(told)}{more}; left out"
    )


def _place(row: int, apart_m: FloatArray, source: Source) -> str:
    """What is wrong in a line."""
    marker, axis = np.unravel_index(int(np.nanargmax(np.abs(apart_m))), apart_m.shape)
    column = source.column(int(marker), int(axis))
    others = int(np.isfinite(apart_m).sum()) - 1
    more = f" and {others} more of its columns" if others else ""
    return f"line {source.lines[row]}, {column} by {apart_m[marker, axis] * 1e3:+.2g} mm{more}"
