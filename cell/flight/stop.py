"""A path that is left for rest: in front of the mouth, when nothing brings the tip through."""

from __future__ import annotations

import numpy as np
import ruckig
from numpy.typing import NDArray

from cell.plan.paths import MotionLimits
from drivers.interfaces import Trajectory

FloatArray = NDArray[np.float64]


def brought_to_rest(path: Trajectory, from_s: float, limits: MotionLimits) -> Trajectory:
    """The same path until a moment, and then to rest as soon as the limits allow.

    from_s  from the path's beginning
    raises  ValueError: the path has ended by then
    """
    t_s = path.t_s - path.t_s[0]
    first = max(2, int(np.searchsorted(t_s, from_s)) + 1)
    if first + 2 > len(t_s):
        raise ValueError(f"the path ends {t_s[-1]:.3f} s after it began, before {from_s:.3f} s")
    step_s = float(t_s[1] - t_s[0])
    at = np.stack([path.x_m, path.y_m], axis=-1)
    before, here, after = at[first - 2 : first + 1]
    wish = ruckig.InputParameter(2)
    wish.control_interface = ruckig.ControlInterface.Velocity
    wish.current_position = here.tolist()
    wish.current_velocity = ((after - before) / (2.0 * step_s)).tolist()
    wish.current_acceleration = ((after - 2.0 * here + before) / step_s**2).tolist()
    wish.target_velocity, wish.target_acceleration = [0.0, 0.0], [0.0, 0.0]
    wish.max_acceleration = [limits.acceleration_m_per_s2] * 2
    wish.max_jerk = [limits.jerk_m_per_s3] * 2
    braking = ruckig.Trajectory(2)
    ruckig.Ruckig(2).calculate(wish, braking)
    count = int(np.ceil(braking.duration / step_s - 1e-9)) + 1
    times = np.minimum(step_s * np.arange(1, count), braking.duration)
    braked = np.array([braking.at_time(float(t))[0] for t in times]).reshape(-1, 2)
    x_m, y_m = np.concatenate([at[:first], braked]).T
    return Trajectory(
        path.t_s[0] + step_s * np.arange(len(x_m)),
        np.ascontiguousarray(x_m),
        np.ascontiguousarray(y_m),
        np.full(len(x_m), path.angle_rad[0]),
    )
