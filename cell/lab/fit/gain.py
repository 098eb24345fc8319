"""The uncertain gain of a force sensor: a share of what a fitted model says that it shows.

What is measured errs with the very values that the gain is to explain: a factor of that, instead,
makes every force look too small by the noise's share in its power.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.whitening import whiteners_of
from cell.lab.fit.fitting import Fit, best_initial_states


def gain_is_uncertain(prepared: PreparedStudy) -> bool:
    """Whether there are wrenches that may all be too large by a factor."""
    return prepared.gauges is not None and prepared.gauges.gain_std > 0.0


def with_gain_of(prepared: PreparedStudy, fit: Fit) -> PreparedStudy:
    """The study whitened for a gain of the wrenches of a model; itself where no gain is uncertain.

    A trial that the model cannot simulate stays as it is.
    source  Fuller 1987, Measurement Error Models, sec. 1.1: attenuation by errors in a regressor
    """
    gauges = prepared.gauges
    if gauges is None or not gain_is_uncertain(prepared):
        return prepared
    trials = [t for t in prepared.study.trials if gauges.are_in(t)]
    points = prepared.predict_all(trials, [fit.model], best_initial_states(prepared, fit))
    there = {t.name: p[0] for t, p in zip(trials, points, strict=True) if np.isfinite(p).all()}
    gauges = gauges.as_expected(there)
    whiteners = whiteners_of(
        prepared.study, prepared.noise, gauges, prepared.lines, prepared.levels
    )
    return replace(prepared, gauges=gauges, whiteners=whiteners)
