"""Check of a trial's clamp angle against the cable's root at rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.geometry import ROUGHLY_STILL, moves_from_s
from cell.files.input_error import Problem
from cell.files.yaml_document import Key
from cell.study.data import Trial
from cell.study.imports.cable_root import Root, agreeing_signs, first_rows, root_of_shape
from cell.study.imports.capture import Capture
from cell.study.imports.gripper_section import BODY_AXES
from cell.study.imports.mapping import ReadMapping
from cell.study.imports.places import clamp_angle_rad
from cell.study.imports.shape import FINAL_SHARE
from cell.study.series import wrapped


def angle_problem(
    read: ReadMapping, trial: Trial, arcs: FloatArray, capture: Capture
) -> Problem | None:
    """The problem of a clamp angle that the cable's root at rest contradicts; None = it agrees, or
    the root is not known.

    arcs     (markers,) of the markers, from the tip on
    capture  file with the gripper
    """
    frames_s, moves_s = trial.markers.t_s, moves_from_s(trial.grip, ROUGHLY_STILL)
    hand, at_rest = read.mapping.hand, frames_s < moves_s
    in_frame = hand.origin_m == (0.0, 0.0) and hand.axes is None
    root = _root(trial, arcs, at_rest, in_frame and bool(hand.columns))
    if trial.bent or root is None:
        return None
    off_rad = wrapped(root.rest_rad - float(trial.grip.angle_rad[0]))
    if abs(off_rad) > root.agrees_rad:
        return _off_problem(read, trial, root, off_rad, capture)
    is_late = np.arange(len(frames_s)) >= (1.0 - FINAL_SHARE) * len(frames_s)
    ends = [_root(trial, arcs, rows, bool(hand.columns)) for rows in (at_rest, is_late)]
    angle_rad = np.interp(frames_s, trial.grip.t_s, trial.grip.angle_rad)
    turned = np.array([np.median(angle_rad[rows]) for rows in (at_rest, is_late)])
    known = [r for r in ends if r is not None]
    shown = np.array([r.rest_rad for r in known])
    if len(known) < len(ends):
        return None
    if agreeing_signs(turned, shown, max(r.std_rad for r in known)) != (-1.0,):
        return None
    by, of_root = np.degrees([turned[1] - turned[0], shown[1] - shown[0]])
    remedy = "give the negative of radians_per_unit"
    if hand.angle.body_axis is not None:
        remedy = "reverse both body_axis and `right` of the gripper's axes"
    message = f"turns the clamp of {trial.name} by {by:.1f}°, yet the cable's root by "
    message += f"{of_root:.1f}°: "
    return read.document.problem(("hand", "angle"), f"{message}{remedy}")


def _off_problem(
    read: ReadMapping, trial: Trial, root: Root, off_rad: float, capture: Capture
) -> Problem:
    """The problem of a clamp angle that is wrong at rest, with its remedy."""
    angle, shown_rad = read.mapping.hand.angle, float(trial.grip.angle_rad[0])
    entry = next(w for w in ("constant_rad", "body_axis", "offset_rad")
                 if getattr(angle, w) is not None)  # fmt: skip
    remedy = f"give offset_rad: {wrapped(angle.offset_rad + off_rad):.4g}"
    if entry == "constant_rad":
        remedy = f"give constant_rad: {root.rest_rad:.4g}, or measure it"
    elif (axis := _nearest_axis(read, root, capture)) is not None:
        remedy = f"give body_axis: {axis}, without offset_rad"
    shown, rest, limit = np.degrees([shown_rad, root.rest_rad, root.agrees_rad])
    key: Key = ("hand", "angle", entry)
    return read.document.problem(
        key,
        f"makes the clamp angle of {trial.name} {shown:.1f}° at rest, yet the cable leaves the "
        f"gripper at {rest:.1f}°, limit {limit:.0f}° apart; {remedy}, or correct the axes",
    )


def _root(
    trial: Trial, arcs: FloatArray, rows: NDArray[np.bool_], with_gripper: bool
) -> Root | None:
    """The cable's root by the median of frames (T,); None = they do not show it.

    with_gripper  the gripper's place is that of the markers' frame
    """
    seen = trial.markers.xy_m[rows]
    if not np.isfinite(seen).all(axis=2).any(axis=0).all() or np.any(np.diff(arcs) >= 0.0):
        return None
    shape = np.nanmedian(seen, axis=0)[::-1]
    if with_gripper and arcs[-1] > 0.0:
        place_m = np.median(trial.gripper_m(trial.markers.t_s[rows]), axis=0)
        shape = np.vstack([place_m, shape])
    is_first = with_gripper or arcs[-1] == 0.0
    return root_of_shape(shape, arcs[::-1].tolist(), is_first) if len(shape) > 1 else None


def _nearest_axis(read: ReadMapping, root: Root, capture: Capture) -> str | None:
    """The axis of a body that is nearest to the cable; None = none agrees, or there is no body."""
    hand = read.mapping.hand
    if hand.angle.body_axis is None:
        return None
    off_rad = {}
    for axis in BODY_AXES:
        section = hand.angle.model_copy(update={"body_axis": axis, "offset_rad": 0.0})
        angle_rad = clamp_angle_rad(capture, section, hand.axes or read.mapping.axes)
        known = np.empty(0) if angle_rad is None else angle_rad[np.isfinite(angle_rad)]
        if len(known):
            off_rad[axis] = abs(wrapped(root.rest_rad - float(np.median(first_rows(known)))))
    nearest = min(off_rad, key=lambda axis: off_rad[axis], default=None)
    return nearest if nearest is not None and off_rad[nearest] <= root.agrees_rad else None
