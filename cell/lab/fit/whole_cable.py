"""Predictions of models along the whole cable, not only at its markers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.model import CableModel
from cell.lab.data.prepared import PreparedStudy
from cell.study.data import Markers, Trial

#: Points that show the whole cable, however few markers it has.
DRAWN = 21


def predict_whole_cable(
    prepared: PreparedStudy,
    trial: Trial,
    models: Sequence[CableModel],
    initial_states: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Where models put the markers, (models, times, markers, 2), and the cable, (…, `DRAWN`, 2).

    In metres; nan where they cannot be simulated.  Behind the markers are gauges, if there are any.
    """
    study = prepared.study
    drawn = np.linspace(study.cable.length_m, 0.0, DRAWN)
    arcs = np.unique(np.concatenate([study.arc_length_m, drawn]))[::-1]
    t_s = trial.markers.t_s
    gauges = trial.markers.xy_m.shape[1] - len(study.arc_length_m)
    blank = replace(trial, markers=Markers(t_s, np.zeros((len(t_s), len(arcs) + gauges, 2))))
    finer = replace(prepared, study=replace(study, arc_length_m=arcs))
    points = finer.predict(
        blank, models, None if initial_states is None else np.tile(initial_states, (len(models), 1))
    )
    at, shape = (np.searchsorted(-arcs, -s) for s in (study.arc_length_m, drawn))
    at = np.concatenate([at, np.arange(len(arcs), len(arcs) + gauges)])
    return points[:, :, at], points[:, :, shape]
