"""A study without single rows of its wrenches that are wrong, and what is told of these."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError, Problem
from cell.study.data import Study, Trial
from cell.study.left_out import TOLD, limit_said, most_wrong
from cell.study.wrench_file import COLUMNS, FILE, UNITS
from cell.study.wrong_samples import wrong_samples

#: Columns that one amplifier shows: forces, and the moment.
_TOGETHER = (slice(0, 2), slice(2, 3))


def without_slips(study: Study, folder: Path) -> Study:
    """The study with values of wrenches that no motion makes as not measured, and notes of them.

    folder  of the study, for what is told
    raises  InputError: too many of a column are wrong
    """
    trials, notes, problems = [], list(study.notes), []
    for trial in study.trials:
        if trial.wrench is None:
            trials.append(trial)
            continue
        values, t_s = trial.wrench.values, trial.wrench.t_s
        apart = np.concatenate([wrong_samples(t_s, values[:, c]) for c in _TOGETHER], axis=1)
        there, file = np.isfinite(apart), folder / trial.name / FILE
        if there.any():
            notes.append(_note(file, apart))
        problems += _too_many(file, trial, there)
        left = replace(trial.wrench, values=np.where(there, np.nan, values))
        trials.append(replace(trial, wrench=left))
    if problems:
        raise InputError(problems)
    return replace(study, trials=tuple(trials), notes=tuple(notes))


def _too_many(file: Path, trial: Trial, there: NDArray[np.bool_]) -> list[Problem]:
    assert trial.wrench is not None
    seen = np.isfinite(trial.wrench.values).sum(axis=0)
    count, most = there.sum(axis=0), most_wrong(seen)
    for i, name in enumerate(COLUMNS):
        if count[i] > most[i]:
            message = (
                f"lies apart from the rows before and after it, as do {count[i]} of {seen[i]} "
                f"rows; {limit_said(most[i])}: mend the sensor's record, or leave the column out"
            )
            return [Problem(file, int(np.argmax(there[:, i])) + 2, None, name, message)]
    return []


def _note(file: Path, apart: FloatArray) -> str:
    """How many values are left out, where the first are, and by how much."""
    places = np.argwhere(np.isfinite(apart))
    shown = [
        f"line {row + 2}, {COLUMNS[i]} by {apart[row, i]:+.2g} {UNITS[COLUMNS[i]]}"
        for row, i in places[:TOLD]
    ]
    more = f" and {len(places) - TOLD} more" if len(places) > TOLD else ""
    return (
        f"{file}: {len(places)} values apart from the rows before and after, as no motion makes "
        f"them: {', '.join(shown)}{more}; left out"
    )
