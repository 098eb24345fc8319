"""Recorded cycles of one cable, gathered into one study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cell.located import InputError, Problem
from cell.study.data import Study
from cell.study.folder import read_study

#: Datasheets of the same cable agree to this.
SAME = 1e-6


def gather(runs: Sequence[Path], name: str) -> Study:
    """One study of the studies in cycles' folders (or of studies themselves).

    The first cycle's roles are kept; later cycles' trials are only compared with, so that what was
    fitted stays what one cable showed.  Trials are named after their cycle's folder.  The noise is
    the largest that any of them states.
    raises  InputError: a folder has no study, or is of another cable, markers or gravity
    """
    first: Study | None = None
    trials, noise_std_m = [], []
    for run in runs:
        folder = run / "study" if (run / "study" / "study.yaml").exists() else run
        study = read_study(folder)
        first = first or study
        if not _alike(first, study):
            message = "is of another cable, other markers or another gravity than the first"
            raise InputError([Problem(folder / "study.yaml", 1, None, "cable", message)])
        noise_std_m.append(study.noise_std_m)
        for trial in study.trials:
            role = trial.role if study is first else "validate"
            label = trial.name if len(runs) == 1 else f"{run.resolve().name}_{trial.name}"
            trials.append(replace(trial, name=label, role=role))
    if first is None:
        raise ValueError("no cycle given")
    stated_m = max((n for n in noise_std_m if n is not None), default=None)
    return replace(first, name=name, trials=tuple(trials), noise_std_m=stated_m)


def _alike(a: Study, b: Study) -> bool:
    ours, theirs = (
        np.concatenate([list(vars(s.cable).values()), s.arc_length_m, s.gravity_m_per_s2])
        for s in (a, b)
    )
    return ours.shape == theirs.shape and np.allclose(ours, theirs, rtol=SAME)
