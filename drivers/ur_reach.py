"""Whether a UR arm's joints can follow a path, as far as its nominal dimensions tell."""

from __future__ import annotations

import numpy as np

from drivers.interfaces import FloatArray, LimitError, Trajectory
from drivers.plane_mount import PlaneMount
from drivers.ur_kinematics import OutOfReachError, UrModel

_NOTHING_MOVED = "nothing was moved"

#: Between two places at which the joints are looked at: at most this time, s, or this way, m (a
#: turn of 1 rad counts as 0.1 m), whichever is longer.
STEP_S, STEP_M = 0.02, 0.002


def check_reach(
    path: Trajectory,
    q_rad: FloatArray,
    model: UrModel,
    X_FT: FloatArray,
    mount: PlaneMount,
    device: str = "arm",
) -> None:
    """Joint angles and speeds along a path whose times count from 0.

    q_rad   (6,) joint angles now, near which those of the path are looked for
    X_FT    (4, 4) tool on the flange
    raises  LimitError: out of reach, or a joint too fast; with the time of the first such place
    """
    before_s = None
    for t_s in _places_s(path).tolist():
        try:
            q_next = model.inverse(mount.to_base(path.at(t_s)), q_rad, X_FT)
        except OutOfReachError as error:
            raise LimitError(device, f"at t = {t_s:.3f} s {error}", _NOTHING_MOVED) from error
        if before_s is not None:
            fastest = float(np.max(np.abs(q_next - q_rad))) / (t_s - before_s)
            if fastest > model.max_joint_speed_rad_per_s:
                raise LimitError(
                    device,
                    f"at t = {t_s:.3f} s a joint turns at {fastest:.2f} rad/s, allowed "
                    f"{model.max_joint_speed_rad_per_s:.2f} rad/s",
                    _NOTHING_MOVED,
                )
        before_s, q_rad = t_s, q_next


def _places_s(path: Trajectory) -> FloatArray:
    """(n,) times at which the joints are looked at, the first and the last of the path included.

    Counted along the path, so that a rest in it takes no places from a fast part.
    """
    turns = 0.1 * np.diff(path.angle_rad)
    ways_m = np.hypot(np.hypot(np.diff(path.x_m), np.diff(path.y_m)), turns)
    steps = np.minimum(np.diff(path.t_s) / STEP_S, ways_m / STEP_M)
    done = np.concatenate([[0.0], np.cumsum(steps)])
    count = max(1, int(np.ceil(done[-1])))
    inner = np.interp(np.linspace(0.0, done[-1], count + 1)[1:-1], done, path.t_s)
    return np.concatenate([path.t_s[:1], inner, path.t_s[-1:]])
