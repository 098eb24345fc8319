"""Samples that are far from a fitted model and from their neighbours, and so are wrong.

What the motion hides from a look at the measurements alone, in few frames a second or in little
noise, shows in what a model leaves of them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.lab.data.prepared import PreparedStudy, as_measured
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import residuals_m
from cell.study.data import Study
from cell.study.left_out import without_samples
from cell.study.wrong_samples import outlier_distances

#: One that is left out shows others, which the fit had followed.
_MOST_ROUNDS = 3


def without_outliers(fits: FitCache) -> tuple[FitCache, tuple[str, ...]]:
    """The fits of a study without samples that its baseline shows to be wrong; what is told.

    The baseline is fitted here; where nothing is wrong it is the one that the fits remembers.
    A trial that the model cannot simulate is left as it is.

    raises  InputError: too many of a marker are wrong
    """
    told: tuple[str, ...] = ()
    for _ in range(_MOST_ROUNDS):
        wrong = _wrong(fits)
        study = as_measured(fits.prepared)
        if not any(np.isfinite(w).any() for w in wrong.values()):
            break
        cleaner = without_samples(study, [wrong[t.name] for t in study.trials])
        told = (*told, *cleaner.notes[len(study.notes) :])
        fits = _with_study(fits, cleaner)
    return fits, told


def _wrong(fits: FitCache) -> dict[str, FloatArray]:
    """Of every trial (times, channels) by how much samples are wrong, m; nan where right."""
    prepared = fits.prepared
    study, left = prepared.unjoined, residuals_m(prepared, fits.base)
    nothing = {t.name: np.full((len(t.markers.t_s), t.markers.xy_m[0].size), np.nan)
               for t in study.trials}  # fmt: skip
    found = {}
    for t, joined in zip(study.trials, prepared.study.trials, strict=True):
        if t.name in left and np.any(np.isfinite(left[t.name])):
            whole = left[t.name].reshape(joined.markers.xy_m.shape)
            errors = prepared.of_markers(joined, whole).reshape(len(t.markers.t_s), -1)
            found[t.name] = outlier_distances(t.markers.t_s, errors)
    return nothing | found


def _with_study(fits: FitCache, study: Study) -> FitCache:
    """The same cache for measurements that differ a little."""
    prepared = fits.prepared
    misfit = None if prepared.noise_is_measured else prepared.noise
    again = PreparedStudy.of(study, misfit=misfit, solver=prepared.solver, work=prepared.work)
    return FitCache.of(replace(fits.setup, prepared=again))
