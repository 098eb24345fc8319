"""Model of an arm's servo on a streamed path: a lag without overshoot."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from math import exp, factorial, fsum

import numpy as np

from drivers.interfaces import FloatArray, Pose, Trajectory

#: Time after the end of a path, in lags, until the response rests (2e-6 of a step remains).
SETTLING_LAGS = 8.0


def servo_response(
    path: Trajectory, lag_s: float, rate_hz: float = 1000.0, start: Pose | None = None
) -> Trajectory:
    """Trajectory that an arm at rest really takes.

    Each coordinate passes a critically damped second-order lag, 1 / (1 + s lag/2)²: a ramp is
    followed `lag_s` late, a step without overshoot.

    path     commanded, interpolated linearly between its points
    lag_s    ≥ 0; 0 = followed exactly
    rate_hz  sample rate of the result, Hz
    start    where the arm rests; None = exactly on the path's first pose
    returns  response from `start` until it rests, evenly sampled
    source   exact for an input that is linear between samples (first-order hold)
    """
    if not (np.isfinite(lag_s) and lag_s >= 0.0):
        raise ValueError(f"lag_s = {lag_s}: must be finite and >= 0")
    step_s = 1.0 / rate_hz
    duration_s = float(path.t_s[-1] - path.t_s[0]) + SETTLING_LAGS * lag_s
    offsets_s = step_s * np.arange(int(np.ceil(duration_s / step_s - 1e-9)) + 1)
    t_s = path.t_s[0] + offsets_s
    begin = start if start is not None else path.at(float(path.t_s[0]))
    x, y, angle = (
        _lagged(np.interp(t_s, path.t_s, values), lag_s, step_s, rest)
        for values, rest in (
            (path.x_m, begin.x_m),
            (path.y_m, begin.y_m),
            (path.angle_rad, begin.angle_rad),
        )
    )
    return Trajectory(t_s, x, y, angle)


def _lagged(values: FloatArray, lag_s: float, step_s: float, rest: float) -> FloatArray:
    if lag_s == 0.0:
        return values
    departure = values - rest
    departure[0] = 0.0
    steps = 2.0 * step_s / lag_s
    numerator, decay = _numerator(steps), exp(-steps)
    passed = np.convolve(departure, numerator)[: len(values)]
    return rest + _decaying_sum(_decaying_sum(passed, decay), decay)


@lru_cache(maxsize=16)
def _numerator(step: float) -> FloatArray:
    """(3,) of the discrete filter whose denominator is (1 − e^(−step))², both poles alike.

    step  between samples, in time constants: half a lag
    """

    def ramp(y: float) -> float:
        """Response to a ramp after y time constants; for small y by the series."""
        if y > 1.0:
            return y - 2.0 + (y + 2.0) * exp(-y)
        return fsum((2 - n) / factorial(n) * (-y) ** n for n in range(3, 20))

    # a sample is a hat of three ramps; its response without the poles
    one, two, three = (ramp(k * step) / step for k in (1, 2, 3))
    hat = np.array([one, two - 2.0 * one, three - 2.0 * two + one])
    decay = exp(-step)
    return np.convolve(hat, [1.0, -2.0 * decay, decay * decay])[:3]


def _decaying_sum(values: FloatArray, decay: float) -> FloatArray:
    """(n,) y with y_k = decay y_(k−1) + values_k; block by block, as there is no such function."""
    shares, later = _decay(decay)
    blocks = np.pad(values, (0, -len(values) % len(later))).reshape(-1, len(later))
    within = blocks @ shares
    for before, block in pairwise(within):
        block += later * before[-1]
    return np.asarray(within.ravel()[: len(values)], dtype=np.float64)


@lru_cache(maxsize=16)
def _decay(decay: float) -> tuple[FloatArray, FloatArray]:
    """(64, 64) weights of a block's values in each sum, (64,) weights of the last sum before."""
    order = np.arange(64)
    since = order[:, None] - order
    later: FloatArray = np.asarray(decay ** (order + 1.0), dtype=np.float64)
    return np.where(since >= 0, decay ** np.maximum(since, 0), 0.0).T, later
