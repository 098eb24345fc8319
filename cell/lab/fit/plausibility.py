"""Whether a fitted model can be a model of the cable at all, and which parameters are at bounds."""

from __future__ import annotations

import numpy as np

from cell.lab.data.prepared import PreparedStudy, once_per_study
from cell.lab.fit.fitting import Fit, fit_trials

#: A model with an error above this share of the markers' motion (rms) does not fit the cable.
HOPELESS_SHARE = 0.5
#: With an error above this multiple of the motion the study is wrong: no effect is searched. Cables
#: with a missing effect had errors up to 1.2 times the motion, mirrored ones 3 to 12 times.
NO_MODEL = 2.0
#: An amplitude is at its bound within this share of the distance from zero to the bound.
NEAR_BOUND = 0.01


def is_hopeless(prepared: PreparedStudy, fit: Fit) -> bool:
    """Whether the error of a fit is more than half of the markers' motion."""
    return fit.rms_m > HOPELESS_SHARE * marker_motion_m(prepared)


def is_no_model(prepared: PreparedStudy, fit: Fit) -> bool:
    """Whether the error is so much larger than the markers' motion that no effect explains it."""
    return fit.rms_m > NO_MODEL * marker_motion_m(prepared)


@once_per_study
def marker_motion_m(prepared: PreparedStudy) -> float:
    """rms distance of the fit trials' markers from their own means, per coordinate, m."""
    square, count = 0.0, 0
    for trial in fit_trials(prepared):
        for series in trial.markers.xy_m.reshape(len(trial.markers.t_s), -1).T:
            observed = series[np.isfinite(series)]
            if observed.size:
                square += float(np.sum((observed - observed.mean()) ** 2))
                count += observed.size
    return float(np.sqrt(square / max(count, 1)))


def at_bound(fit: Fit) -> list[tuple[str, float, str]]:
    """Fitted parameters that lie at a bound, except amplitudes that are absent there.

    An amplitude very near its bound counts: the small rest hardly changes the objective.
    returns  (name, value, unit) of each
    """
    space, q = fit.space, fit.q
    absent = {
        f"{e.name}.{p.name}": p.default for e in space.effects for p in e.parameters if p.amplitude
    }
    values = space.natural(q)
    parameters = []
    for i, name in enumerate(space.names):
        default = absent.get(name)
        ends = space.natural(space.low)[i], space.natural(space.high)[i]
        tolerance = [0.0 if default is None else NEAR_BOUND * abs(end - default) for end in ends]
        outside = values[i] <= ends[0] + tolerance[0] or values[i] >= ends[1] - tolerance[1]
        if space.low[i] < space.high[i] and outside and default != values[i]:
            parameters.append((name, float(values[i]), space.units[i]))
    return parameters
