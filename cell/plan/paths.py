"""Paths of the gripping point: jerk-limited straight strokes, sampled at the arm's rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import ruckig

from cell.cable.arrays import FloatArray
from cell.cable.clamp import pose_of
from cell.cable.geometry import Motion
from drivers.interfaces import Pose, Trajectory
from drivers.servo import servo_response

#: Distance from the goal at which a gripper counts as arrived, m: an arm's repeatability, and too
#: little to set a cable swinging when the arm moves the rest of the way.
AT_GOAL_M = 5e-5
#: Difference between clamp angles that count as the same.
SAME_ANGLE_RAD = 1e-3
#: Time over which derivatives of a path are computed, s: a stroke's last step is shorter.
_SPAN_S = 0.004


@dataclass(frozen=True)
class MotionLimits:
    """Limits of the gripping point's motion along either axis of the plane, and of its turning."""

    velocity_m_per_s: float = 0.5
    acceleration_m_per_s2: float = 5.0
    jerk_m_per_s3: float = 200.0
    velocity_rad_per_s: float = 0.8
    acceleration_rad_per_s2: float = 4.0
    jerk_rad_per_s3: float = 40.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"motion limit {name} = {value}: must be finite and > 0")

    def slowed(self, times: float) -> MotionLimits:
        """Limits of the same motion in `times` the time."""
        return MotionLimits(
            self.velocity_m_per_s / times,
            self.acceleration_m_per_s2 / times**2,
            self.jerk_m_per_s3 / times**3,
            self.velocity_rad_per_s / times,
            self.acceleration_rad_per_s2 / times**2,
            self.jerk_rad_per_s3 / times**3,
        )


def identification_path(
    start: Pose,
    distance_m: float,
    limits: MotionLimits,
    rate_hz: float,
    *,
    duration_s: float = 0.3,
    hold_s: float = 1.0,
) -> Trajectory:
    """Down by `distance_m`, in `duration_s` or as long as the limits ask, then held for `hold_s`.

    raises  ValueError: an impossible distance, duration or rate
    """
    if not distance_m > 0.0:
        raise ValueError(f"identification distance is {distance_m} m: must be > 0")
    if hold_s < 0.0:
        raise ValueError(f"hold is {hold_s} s: must be ≥ 0")
    down = _stroke((start.x_m, start.y_m), (0.0, -distance_m), limits, rate_hz, duration_s)
    held = np.repeat(down[-1:], round(hold_s * rate_hz), axis=0)
    return _path([down, held], start.angle_rad, rate_hz)


def insertion_path(
    start: Pose,
    offset_m: float,
    advance_m: float,
    limits: MotionLimits,
    rate_hz: float,
    *,
    delay_s: float = 0.0,
) -> Trajectory:
    """Down by `offset_m`, then left by `advance_m`; at rest at both ends and at the corner.

    delay_s  rest of the gripper before the path, rounded to the arm's period
    raises   ValueError: a negative offset or delay, an advance ≤ 0, an impossible rate
    """
    if delay_s < 0.0:
        raise ValueError(f"delay {delay_s} s must be ≥ 0")
    if offset_m < 0.0 or not advance_m > 0.0:
        raise ValueError(f"offset {offset_m} m must be ≥ 0 and advance {advance_m} m > 0")
    down = _stroke((start.x_m, start.y_m), (0.0, -offset_m), limits, rate_hz)
    advance = _stroke((float(down[-1, 0]), float(down[-1, 1])), (-advance_m, 0.0), limits, rate_hz)
    rest = np.repeat(down[:1], round(delay_s * rate_hz), axis=0)
    return _path([rest, down, advance[1:]], start.angle_rad, rate_hz)


def retreat_path(start: Pose, end: Pose, limits: MotionLimits, rate_hz: float) -> Trajectory:
    """First level, then up or down, then turning in place: the tip leaves an opening first.

    raises  ValueError: the poses are the same, an impossible rate
    """
    level = _stroke((start.x_m, start.y_m), (end.x_m - start.x_m, 0.0), limits, rate_hz)
    upright = _stroke((end.x_m, start.y_m), (0.0, end.y_m - start.y_m), limits, rate_hz)
    xy = np.concatenate([level, upright[1:]])
    angle_rad = np.full(len(xy), start.angle_rad)
    if abs(end.angle_rad - start.angle_rad) > SAME_ANGLE_RAD:
        turn_rad = _turn(start.angle_rad, end.angle_rad, limits, rate_hz)[1:]
        xy = np.vstack([xy, np.repeat(xy[-1:], len(turn_rad), axis=0)])
        angle_rad = np.concatenate([angle_rad, turn_rad])
    if len(xy) < 2:
        raise ValueError(f"retreat from {start} to {end}: no distance to go")
    return Trajectory(np.arange(len(xy)) / rate_hz, xy[:, 0].copy(), xy[:, 1].copy(), angle_rad)


def path_to_rest(path: Trajectory, from_s: float, limits: MotionLimits) -> Trajectory:
    """The path until a time, then a stop as fast as the limits allow.

    Where the path exceeds the limits, so does the stop: a gripper that is already braking would
    otherwise move back.

    path    evenly sampled, its clamp angle constant
    from_s  from the path's beginning
    raises  ValueError: the path has ended by then, or ruckig finds no way to rest
    """
    t_s = path.t_s - path.t_s[0]
    first = max(2, int(np.searchsorted(t_s, from_s)) + 1)
    if first + 2 > len(t_s):
        raise ValueError(f"the path ends {t_s[-1]:.3f} s after it began, before {from_s:.3f} s")
    rate_hz = 1.0 / float(t_s[1] - t_s[0])
    xy_m = np.stack([path.x_m, path.y_m], axis=-1)
    before, here, after = xy_m[first - 2 : first + 1]
    wish = ruckig.InputParameter(2)
    wish.control_interface = ruckig.ControlInterface.Velocity
    wish.current_position = here.tolist()
    wish.current_velocity = (0.5 * rate_hz * (after - before)).tolist()
    wish.current_acceleration = (rate_hz**2 * (after - 2.0 * here + before)).tolist()
    acceleration, jerk = (_steepest(xy_m, rate_hz, order) for order in (2, 3))
    wish.max_acceleration = np.maximum(limits.acceleration_m_per_s2, acceleration).tolist()
    wish.max_jerk = np.maximum(limits.jerk_m_per_s3, jerk).tolist()
    braked = _sampled(wish, rate_hz)[1:]
    stopped = _path([xy_m[:first], braked], float(path.angle_rad[0]), rate_hz)
    return replace(stopped, t_s=stopped.t_s + path.t_s[0])


def _steepest(xy_m: FloatArray, rate_hz: float, order: int) -> FloatArray:
    """(2,) largest size of a derivative of places (T, 2) along each axis; 0 if they are too few."""
    stride = max(1, int(np.ceil(_SPAN_S * rate_hz)))
    for _ in range(order):
        xy_m = (xy_m[stride:] - xy_m[:-stride]) * rate_hz / stride
    return np.asarray(np.abs(xy_m).max(axis=0, initial=0.0))


def path_to(goal: Pose, start: Pose, limits: MotionLimits, rate_hz: float) -> Trajectory | None:
    """`retreat_path` from here to a goal; None = the gripper is there already."""
    away_m = max(abs(start.x_m - goal.x_m), abs(start.y_m - goal.y_m))
    if away_m < AT_GOAL_M and abs(start.angle_rad - goal.angle_rad) < SAME_ANGLE_RAD:
        return None
    return retreat_path(start, goal, limits, rate_hz)


def executed_motion(
    path: Trajectory,
    lag_s: float,
    *,
    settle_s: float = 0.0,
    history: Motion | None = None,
) -> Motion:
    """The gripper's motion when an arm with a known lag is commanded along `path` from time 0.

    settle_s  how long the gripper is held still after it has arrived
    history   measured motion up to now, its times ≤ 0: the cable still swings from it
    raises    ValueError: negative durations, a history that reaches beyond time 0
    """
    if settle_s < 0.0:
        raise ValueError(f"settling time is {settle_s} s: must be ≥ 0")
    response = servo_response(path, lag_s)
    rows = np.column_stack([response.t_s, response.x_m, response.y_m, response.angle_rad])
    if settle_s > 0.0:
        rows = np.vstack([rows, rows[-1] + [settle_s, 0.0, 0.0, 0.0]])
    if history is not None:
        end_s = float(history.t_s[-1])
        if end_s > rows[0, 0]:
            raise ValueError(f"history ends at {end_s} s: must be before the path, {rows[0, 0]} s")
        # without the noise of its log, but with its full length, as in a fit: an effect may move
        # the cable before the gripper first moves
        past_s = history.t_s[history.t_s < rows[0, 0]]
        rows = np.vstack([np.column_stack([past_s, *pose_of(history)(past_s)]), rows])
    return Motion(*(np.ascontiguousarray(column) for column in rows.T))


def _stroke(
    start_m: tuple[float, float],
    move_m: tuple[float, float],
    limits: MotionLimits,
    rate_hz: float,
    minimum_duration_s: float | None = None,
) -> FloatArray:
    """(samples, 2) positions of one rest-to-rest stroke, both ends included, m."""
    if not rate_hz > 0.0:
        raise ValueError(f"arm rate is {rate_hz} Hz: must be > 0")
    target = [start_m[0] + move_m[0], start_m[1] + move_m[1]]
    if move_m == (0.0, 0.0):
        return np.array([target])
    wish = ruckig.InputParameter(2)
    wish.current_position, wish.target_position = list(start_m), target
    wish.max_velocity = [limits.velocity_m_per_s] * 2
    wish.max_acceleration = [limits.acceleration_m_per_s2] * 2
    wish.max_jerk = [limits.jerk_m_per_s3] * 2
    if minimum_duration_s is not None:
        wish.minimum_duration = minimum_duration_s
    return _sampled(wish, rate_hz)


def _turn(start_rad: float, end_rad: float, limits: MotionLimits, rate_hz: float) -> FloatArray:
    """(samples,) clamp angles from rest to rest, both ends included, rad."""
    wish = ruckig.InputParameter(1)
    wish.current_position, wish.target_position = [start_rad], [end_rad]
    wish.max_velocity = [limits.velocity_rad_per_s]
    wish.max_acceleration = [limits.acceleration_rad_per_s2]
    wish.max_jerk = [limits.jerk_rad_per_s3]
    return _sampled(wish, rate_hz)[:, 0]


def _sampled(wish: ruckig.InputParameter, rate_hz: float) -> FloatArray:
    """(samples, axes) positions of the fastest trajectory, both ends included."""
    trajectory = _trajectory(wish)
    count = int(np.ceil(trajectory.duration * rate_hz - 1e-9)) + 1
    times = np.minimum(np.arange(count) / rate_hz, trajectory.duration)
    return np.array([trajectory.at_time(float(t))[0] for t in times], dtype=np.float64)


def _trajectory(wish: ruckig.InputParameter) -> ruckig.Trajectory:
    """The fastest trajectory.  Where speed and acceleration reach their limits at the same moment,
    rounding makes ruckig find none, and limits lower by a billionth help.
    """
    axes = len(wish.target_position)
    acceleration, jerk = wish.max_acceleration, wish.max_jerk
    for less in (0.0, 1e-9, 1e-7):
        wish.max_acceleration = [(1.0 - less) * a for a in acceleration]
        wish.max_jerk = [(1.0 - 2.0 * less) * j for j in jerk]
        trajectory = ruckig.Trajectory(axes)
        try:
            result = ruckig.Ruckig(axes).calculate(wish, trajectory)
        except ruckig.RuckigError as error:
            result = error
            continue
        if result in (ruckig.Result.Working, ruckig.Result.Finished):
            return trajectory
    raise ValueError(f"no path from {wish.current_position} to {wish.target_position}: {result}")


def _path(strokes: Sequence[FloatArray], angle_rad: float, rate_hz: float) -> Trajectory:
    xy = np.concatenate(strokes)
    t = np.arange(len(xy)) / rate_hz
    return Trajectory(t, xy[:, 0].copy(), xy[:, 1].copy(), np.full(len(xy), angle_rad))
