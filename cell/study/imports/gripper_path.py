"""The gripper's path: from columns, constant, from an encoder, or from integrated acceleration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.yaml_document import Key
from cell.study.hand_drift import HandDrift
from cell.study.imports.accelerometer import (
    REST_ROWS,
    AccelerometerSamples,
    NotIntegrableError,
    integrated,
)
from cell.study.imports.capture import Capture
from cell.study.imports.gripper_section import AccelerationSection, TurnsSection
from cell.study.imports.mapping import ReadMapping, TrialEntry
from cell.study.imports.places import angle_towards, clamp_angle_rad, places_m
from cell.study.imports.shape import lost_rows

#: Limits relative to the cable's length: error of the gripper's position by each error source of an
#: accelerometer, and standard deviation of the position.
DRIFT, MOST_DRIFT = 1e-3, 0.02
#: Tolerances of gravity at rest: of its magnitude, of a sensor that does not show it (relative),
#: and of its direction.
_AS_GRAVITY, _NO_GRAVITY, _TILT_RAD = 0.15, 0.05, 0.1
#: Maximum sampling rate of a path.
_RATE_HZ = 2000.0


@dataclass(frozen=True, eq=False)
class GripperPath:
    """Gripping point (rows, 2), m, and clamp angle (rows,), rad; nan = not known.

    drift  error model of the position; None = it is measured directly
    """

    xy_m: FloatArray
    angle_rad: FloatArray
    drift: HandDrift | None = None
    note: str = ""


def gripper_path(
    read: ReadMapping, entry: TrialEntry, capture: Capture, t_s: FloatArray
) -> GripperPath:
    """The gripper of a trial.

    capture  file of the gripper; t_s (rows,) are its times on the study's clock
    raises   InputError: a column is missing, or acceleration cannot be integrated
    """
    mapping, hand = read.mapping, read.mapping.hand
    axes = hand.axes or mapping.axes
    scale = hand.metres_per_unit or mapping.metres_per_unit or 1.0
    turned = mapping.axes if hand.acceleration is not None else axes  # those are the sensor's own
    angle_rad = clamp_angle_rad(capture, hand.angle, turned)
    if hand.turns is not None:
        return _path_by_encoder(read, entry, capture, t_s, angle_rad)
    if hand.acceleration is not None:
        assert angle_rad is not None  # towards and follows are refused
        return _path_by_sensor(read, entry, capture, t_s, angle_rad)
    note, origin_m = "", hand.origin_m or (0.0, 0.0)
    if hand.columns is not None:
        xy_m = places_m(capture, hand.columns, axes, scale, mapping.lost, unseen=0.0, of_hand=True)
        xy_m = xy_m + origin_m
        note = _lost_rows_text(read, entry, capture)
    else:
        xy_m = np.broadcast_to(np.array(hand.fixed_m, dtype=np.float64), (len(t_s), 2))
    if angle_rad is None:
        second = hand.angle.towards or ()
        towards = places_m(capture, second, axes, scale, mapping.lost, of_hand=True)
        angle_rad = angle_towards(xy_m, towards + origin_m, hand.angle.offset_rad)
    return GripperPath(xy_m, angle_rad, note=note)


def _lost_rows_text(read: ReadMapping, entry: TrialEntry, capture: Capture) -> str:
    """Note on the gripper's rows excluded because of a value of `lost`; empty = none."""
    lost, columns = read.mapping.lost, read.mapping.hand.columns or []
    rows = lost_rows(capture.at([c for c in columns if c is not None]), lost, of_hand=True)
    if not rows.any():
        return ""
    row = int(np.argmax(rows))
    return (
        f"{entry.name}: the gripper is taken as not seen in {np.count_nonzero(rows)} rows, the "
        f"first at {capture.counted} {capture.lines[row]}: it jumps to values of `lost` there, "
        "and back"
    )


def _path_by_encoder(
    read: ReadMapping,
    entry: TrialEntry,
    capture: Capture,
    t_s: FloatArray,
    angle_rad: FloatArray | None,
) -> GripperPath:
    """The gripper of a trial by its axle's encoder; angle None: the clamp turns with the arm."""
    hand = read.mapping.hand
    turns = hand.turns
    assert turns is not None
    turn = turn_of(capture, turns)
    xy_m = place_m(turn.angle_rad, turns)
    follows = angle_rad is None
    angle_rad = turn.angle_rad + hand.angle.offset_rad if angle_rad is None else angle_rad
    if turn.count_rad == 0.0 or turn.moves is None:
        return GripperPath(xy_m, angle_rad)
    cable_m = read.mapping.cable.free_length_m or 1.0
    reach_m = (turns.radius_m or 0.0) + cable_m * follows
    if turn.count_rad * reach_m > MOST_DRIFT * cable_m:
        raise capture.error(
            turn.moves[0],
            f"{entry.name}: one count moves the {'cable' if follows else 'hand'} by "
            f"{turn.count_rad * reach_m * 1e3:.2g} mm, limit {MOST_DRIFT * cable_m * 1e3:.2g} mm; "
            "correct radians_per_unit, or take an encoder with more counts a turn",
            turns.column,
        )
    from_s, to_s = (float(t_s[row]) for row in turn.moves)
    drift = HandDrift(
        from_s,
        to_s,
        turn_std_rad=float(turn.count_rad / np.sqrt(12.0)),
        axle_m=turns.axle_m or (0.0, 0.0),
        clamp_turns=follows,
    )
    return GripperPath(xy_m, angle_rad, drift)


def _path_by_sensor(
    read: ReadMapping, entry: TrialEntry, capture: Capture, t_s: FloatArray, angle_rad: FloatArray
) -> GripperPath:
    mapping = read.mapping
    section = mapping.hand.acceleration
    assert section is not None
    angle_rad = interpolated(t_s, angle_rad)
    shown, measured = _specific_force(read, section, capture)
    known = np.isfinite(shown).all(axis=1) & np.isfinite(angle_rad)
    rows = np.flatnonzero(known)
    turns = section.along == "clamp"
    if len(rows) < 2:
        raise capture.error(0, "shows acceleration in fewer than 2 rows; give its columns", "hand")
    sensed = AccelerometerSamples(
        t_s[known],
        shown[known],
        measured,
        angle_rad[known] if turns else np.zeros(len(rows)),
        mapping.gravity_m_per_s2,
    )
    _check_gravity(read, sensed)
    if not all(measured) and np.ptp(sensed.angle_rad) > 1e-3:
        message = "need both coordinates where the sensor turns with the clamp; name both"
        raise read.error(("hand", "acceleration", "columns"), message)
    cable_m = mapping.cable.free_length_m or 1.0
    begins_m = np.array(entry.hand_starts_at_m or section.starts_at_m or (0.0, 0.0))
    ends_m = entry.hand_ends_at_m
    to_m = None if ends_m is None else (ends_m[0] - begins_m[0], ends_m[1] - begins_m[1])
    try:
        path = integrated(sensed, DRIFT * cable_m, to_m, section.gain_std)
    except NotIntegrableError as error:
        names = " and ".join(c for c in section.columns if c is not None)
        raise capture.error(int(rows[error.row]), f"{entry.name}: {error}", names) from error
    step = max(1, int(1.0 / (_RATE_HZ * sensed.step_s)))
    xy_m = np.full((len(t_s), 2), np.nan)
    xy_m[rows[::step]] = begins_m + path.path_m[::step]
    return GripperPath(
        xy_m, angle_rad, path.drift, _note(entry, capture, xy_m, t_s, path.drift, cable_m)
    )


def interpolated(t_s: FloatArray, angle_rad: FloatArray) -> FloatArray:
    """Angles (rows,), interpolated where they were logged less often than acceleration."""
    known = np.isfinite(angle_rad)
    if not known.any():
        return angle_rad
    return np.interp(t_s, t_s[known], angle_rad[known], left=np.nan, right=np.nan)


def _specific_force(
    read: ReadMapping, section: AccelerationSection, capture: Capture
) -> tuple[FloatArray, tuple[bool, bool]]:
    """(rows, 2) specific force along right and up, and which of the two is measured."""
    axes = read.mapping.hand.axes or read.mapping.axes
    unit = section.m_per_s2_per_unit or 1.0
    finite = np.isfinite(places_m(capture, section.columns, axes, unit))
    shown = places_m(capture, section.columns, axes, unit, unseen=0.0)
    return shown, (bool(finite[:, 0].any()), bool(finite[:, 1].any()))


def _check_gravity(read: ReadMapping, sensed: AccelerometerSamples) -> None:
    """Raise InputError if the sensor's acceleration at rest is neither gravity nor zero."""
    gravity = float(np.hypot(*sensed.gravity))
    if not all(sensed.measured) or gravity == 0.0:
        return
    rest = sensed.specific_force[:REST_ROWS].mean(axis=0)
    size = float(np.hypot(*rest))
    key: Key = ("hand", "acceleration", "m_per_s2_per_unit")
    if size < _NO_GRAVITY * gravity:
        if np.ptp(sensed.angle_rad) > 1e-3:
            message = f"makes {size:.3g} m/s² at rest: the sensor does not show gravity, and it "
            raise read.error(key, f"{message}turns; take one that does, or set it up level")
        return
    if abs(size - gravity) > _AS_GRAVITY * gravity:
        message = f"makes {size:.4g} m/s² at rest, limit {gravity:g} m/s² ± {_AS_GRAVITY:.0%}, or "
        raise read.error(
            key, f"{message}less than {_NO_GRAVITY * gravity:.2g}; give 9.81 for g, 1 for m/s²"
        )
    angle = float(sensed.angle_rad[0])
    x, y = -np.array(sensed.gravity) / gravity
    up = np.array([np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x])
    tilt = float(np.arccos(np.clip(rest @ up / size, -1.0, 1.0)))
    if tilt > np.pi - _TILT_RAD:
        message = "makes gravity point up at rest: the sensor shows g − a; give the negative"
        raise read.error(key, message)
    if tilt > _TILT_RAD:
        raise read.error(
            ("hand", "acceleration", "columns"),
            f"show gravity {np.degrees(tilt):.3g}° aside at rest, limit "
            f"{np.degrees(_TILT_RAD):.2g}°; correct hand.axes, or offset_rad of hand.angle",
        )


def _note(
    entry: TrialEntry, capture: Capture, xy_m: FloatArray, t_s: FloatArray,
    drift: HandDrift | None, cable_m: float,
) -> str:  # fmt: skip
    """Note on the accuracy of an integrated position.  Raises InputError: it is too low."""
    if drift is None:
        return f"{entry.name}: the acceleration shows no motion of the gripper"
    known = np.isfinite(xy_m).all(axis=1)
    std_m = drift.largest_std_m(t_s[known], xy_m[known])
    moved_s = drift.to_s - drift.from_s
    if std_m > MOST_DRIFT * cable_m:
        raise capture.error(
            int(np.argmax(t_s >= drift.to_s)),
            f"{entry.name}: after a motion of {moved_s:.2g} s the place has a standard deviation "
            f"of {std_m * 1e3:.2g} mm, limit {MOST_DRIFT * cable_m * 1e3:.2g} mm; make the motion "
            "shorter, give hand_ends_at_m of the trial, or take a sensor with less noise",
            "hand",
        )
    density = max(drift.noise_m_per_s2_per_rt_hz)
    return (
        f"{entry.name}: the gripper's place is integrated over {moved_s:.2g} s; its standard "
        f"deviation is at most {std_m * 1e3:.2g} mm, by noise of {density:.2g} m/s²/√Hz"
        f"{f' and a gain known to {drift.gain_std:.1%}' if drift.gain_std else ''}. "
        "The study states it, and the lab allows for it"
    )


#: Tolerance of integer multiples of a count, relative to it.
_MULTIPLE_TOLERANCE = 1e-3
#: Double precision represents all integers below this.
_EXACT_INTEGERS = 2.0**53


def count_of(values: FloatArray) -> float:
    """The common step of which all differences of the values (rows,) are multiples; 0 = none."""
    different = np.unique(values[np.isfinite(values)])
    if len(different) < 3:
        return 0.0
    steps = np.diff(different)
    if np.all(different == np.round(different)) and np.abs(different).max() < _EXACT_INTEGERS:
        return float(np.gcd.reduce(steps.astype(np.int64)))
    count = float(steps.min())
    is_multiple = np.abs(steps / count - np.round(steps / count)) < _MULTIPLE_TOLERANCE
    return count if is_multiple.all() and count > 1e-9 * float(np.abs(different).max()) else 0.0


@dataclass(frozen=True, eq=False)
class Turn:
    """Rotation angle of an arm: 0 = it points to the left, positive = pointing down.

    angle_rad  (rows,) nan = unknown
    count_rad  of one count; 0 = the numbers are no counts
    moves      rows in which it leaves its first and reaches its last position; None = no motion
    """

    angle_rad: FloatArray
    count_rad: float
    moves: tuple[int, int] | None


def turn_of(capture: Capture, turns: TurnsSection) -> Turn:
    """Rotation angle measured by an encoder.

    Single-turn encoders are unwrapped.  Counts are dithered over their width, so that estimates of
    noise include the quantization error.
    source  Widrow & Kollár, Quantization Noise, 2008, ch. 19 (dither)
    raises  InputError: there is no such column
    """
    values, unit = capture.column(turns.column), turns.radians_per_unit or 1.0
    angle = values * unit + turns.offset_rad
    known = np.isfinite(angle)
    count_rad = count_of(values) * abs(unit)
    if not known.any():
        return Turn(angle, count_rad, None)
    unwrapped = np.unwrap(angle[known])
    unwrapped = unwrapped - 2.0 * np.pi * np.round(unwrapped[0] / (2.0 * np.pi))
    away = [np.abs(unwrapped - unwrapped[end]) > 1.5 * count_rad for end in (0, -1)]
    rows = np.flatnonzero(known)
    moves = None
    if away[0].any() and away[1].any():
        moves = int(rows[np.argmax(away[0])]), int(rows[len(rows) - 1 - np.argmax(away[1][::-1])])
    dither = np.random.default_rng(len(rows)).uniform(-0.5, 0.5, len(rows))
    angle[known] = unwrapped + count_rad * dither * (moves is not None)
    return Turn(angle, count_rad, moves)


def place_m(turn: FloatArray, turns: TurnsSection) -> FloatArray:
    """(rows, 2) gripping point at turns (rows,) of the arm, in the study's frame."""
    axle_m = np.array(turns.axle_m or (0.0, 0.0))
    out = np.column_stack([-np.cos(turn), -np.sin(turn)])
    return np.asarray(axle_m + (turns.radius_m or 0.0) * out)
