"""What whitens the trials of a study: noise, arc lengths that are uncertain, tares of gauges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cell.identify.marker_shift import slopes_along
from cell.identify.noise import Noise
from cell.identify.whitener import Whitener
from cell.lab.data.gauges import Gauges
from cell.study.data import Study


def whiteners_of(study: Study, noise: Noise, gauges: Gauges | None = None) -> dict[str, Whitener]:
    """What whitens each trial of a study.

    The whitener of a trial knows nothing of the others, yet a marker's arc length is the same in
    all n of them.  So each trial may have one of its own, of n times the variance: no combination
    of trials is then believed more than it may, and what moves a marker alike in all of them as
    much as one standard deviation allows.  The same holds of a sensor's gain.
    """
    std_m, markers = study.arc_length_std_m, len(study.arc_length_m)
    own = {t.name: None if gauges is None else gauges.sensors(t) for t in study.trials}
    if std_m is None or not np.any(std_m > 0.0):
        return {t.name: Whitener(t.markers.xy_m, noise, sensors=own[t.name]) for t in study.trials}
    each_m = np.sqrt(len(study.trials)) * std_m[:, None]
    whiteners = {}
    for t in study.trials:
        shift_m = np.zeros(t.markers.xy_m.shape)
        places = replace(t, markers=replace(t.markers, xy_m=t.markers.xy_m[:, :markers]))
        shift_m[:, :markers] = each_m * slopes_along(places, study.arc_length_m)
        whiteners[t.name] = Whitener(t.markers.xy_m, noise, shift_m, own[t.name])
    return whiteners
