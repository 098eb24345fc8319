"""What whitens the trials of a study: noise, arc lengths, drift of the log, tares of gauges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.identify.marker_shift import carried_m, derivative_along
from cell.identify.noise import Noise
from cell.identify.whitener import Whitener
from cell.lab.data.gauges import Gauges
from cell.lab.data.noise_model import Level
from cell.study.data import Study


def arcs_are_uncertain(study: Study) -> bool:
    """Whether the study says that arc lengths of its markers may be wrong."""
    return study.arc_length_std_m is not None and bool(np.any(study.arc_length_std_m > 0.0))


def whiteners_of(
    study: Study,
    noise: Noise,
    gauges: Gauges | None = None,
    lines: Mapping[str, FloatArray] | None = None,
    levels: Mapping[str, Level] | None = None,
) -> dict[str, Whitener]:
    """What whitens each trial of a study.

    lines  per trial (times, markers, 2) change of markers' places by a metre of arc length, as a
           model has it; as measured where it is missing
    levels noise of a trial's markers over `noise`; 1 where it is missing

    The whitener of a trial knows nothing of the others, yet a marker's arc length is the same in
    all n of them.  So each trial may have one of its own, of n times the variance: no combination
    of trials is then believed more than it may, and what moves a marker alike in all of them as
    much as one standard deviation allows.  The same holds of a sensor's gain.
    """
    lines, levels = lines or {}, levels or {}
    std_m, markers = study.arc_length_std_m, len(study.arc_length_m)
    whiteners = {}
    for t in study.trials:
        # what a sensor shows stands after the markers, and neither shifts nor is carried
        beside = ((0, t.markers.xy_m.shape[1] - markers), (0, 0))
        places = replace(t, markers=replace(t.markers, xy_m=t.markers.xy_m[:, :markers]))
        shift_m, carried = None, carried_m(places)
        if std_m is not None and arcs_are_uncertain(study):
            each_m = np.sqrt(len(study.trials)) * std_m[:, None]
            slopes = lines.get(t.name)
            slopes = derivative_along(places, study.arc_length_m) if slopes is None else slopes
            shift_m = np.pad(each_m * slopes, ((0, 0), *beside))
        if carried is not None:
            carried = np.pad(carried, ((0, 0), (0, 0), *beside))
        sensors = None if gauges is None else gauges.sensors(t)
        level = levels[t.name].of_markers if t.name in levels else None
        whiteners[t.name] = Whitener(t.markers.xy_m, noise, shift_m, carried, sensors, level)
    return whiteners
