"""How an arm's servo follows a streamed path: the response of a lag without overshoot."""

from __future__ import annotations

from functools import lru_cache

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
    rate_hz  sample rate of what is returned, Hz
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
    from scipy.signal import lfilter  # half a second, of which only some commands have need

    numerator, denominator = _filter(lag_s, step_s)
    departure = values - rest
    departure[0] = 0.0
    return np.asarray(rest + lfilter(numerator, denominator, departure), dtype=np.float64)


@lru_cache(maxsize=16)
def _filter(lag_s: float, step_s: float) -> tuple[FloatArray, FloatArray]:
    """Numerator and denominator of the discrete filter."""
    from scipy.signal import cont2discrete

    tau = lag_s / 2.0
    numerator, denominator, _ = cont2discrete(  # type: ignore[call-overload]  # the stubs' gap
        ([1.0], [tau * tau, 2.0 * tau, 1.0]), step_s, method="foh"
    )
    return numerator.ravel(), denominator
