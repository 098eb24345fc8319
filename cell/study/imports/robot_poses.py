"""Converts orientations of robots to quaternions, in additional columns.

  UR         pose_0 … pose_5: place, m, and rotation vector, rad
  KUKA       X, Y, Z, A, B, C: turns about Z, then the new Y, then the new X, degrees
  Fanuc      X, Y, Z, W, P, R: turns about the fixed X, Y, Z, degrees
  ABB        q1 … q4, or q0 … q3: w, x, y, z
  Franka     O_T_EE 0 … 15: a pose as a matrix, column by column, m
source  UR, RTDE guide, actual_TCP_pose; KUKA System Software, ABC angles; Fanuc, W P R of a
        Cartesian position; ABB, RAPID data type orient; libfranka, RobotState
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture, CapturedColumn
from cell.study.imports.units import RADIANS, split_unit

#: Tolerance of rotation matrices and unit quaternions that are written with few digits.
_TOLERANCE = 1e-3
_LAST_WORD = re.compile(r"^(.*?)[\s_.:\-\[]*(q[0-5]|[a-z]|\d{1,2})\]?$", re.IGNORECASE)


def _w_first(values: FloatArray) -> Rotation:
    return Rotation.from_quat(np.roll(values, -1, axis=1))


#: Entry numbers of matrices, column by column: of a rotation, and of a pose.
_MATRICES = [{str(i) for i in range(count)} for count in (9, 16)]
#: Entries of a pose that are directions of a body's axes, and those of its position.
_DIRECTIONS, _PLACE = (0, 1, 2, 4, 5, 6, 8, 9, 10), (12, 13, 14)
_ROTATION = re.compile(r"\s*rot(?:ations?)?$", re.IGNORECASE)
#: Required last words of names, those of the orientation, their default unit, and the conversion to
#: a rotation.
_FORMS: tuple[tuple[str, str, str, Callable[[FloatArray], Rotation]], ...] = (
    ("0 1 2 3 4 5", "3 4 5", "rad", Rotation.from_rotvec),
    ("x y z a b c", "a b c", "deg", partial(Rotation.from_euler, "ZYX")),
    ("x y z w p r", "w p r", "deg", partial(Rotation.from_euler, "xyz")),
    ("q1 q2 q3 q4", "q1 q2 q3 q4", "", _w_first),
    ("q0 q1 q2 q3", "q0 q1 q2 q3", "", _w_first),
)


def with_quaternions(capture: Capture) -> Capture:
    """Add columns `… quaternion x` to `w` for each orientation that a robot wrote."""
    groups: dict[str, dict[str, CapturedColumn]] = {}
    for column in capture.columns:
        bare, unit = split_unit(column.name)
        if match := _LAST_WORD.match(bare):
            unit = column.unit or unit
            groups.setdefault(match[1], {})[match[2].lower()] = CapturedColumn(column.name, unit)
    for stem, parts in groups.items():
        if set(parts) in _MATRICES:
            capture = _with_matrix(capture, stem, [parts[str(i)] for i in range(len(parts))])
        for words, angle_words, default, rotation in _FORMS:
            if not set(words.split()) <= set(parts):
                continue
            if words.startswith("0") and ("pose" not in stem.lower() or len(parts) > 6):
                continue
            if words.startswith("q0") and ("q4" in parts or not _unit_norm(capture, parts, words)):
                continue  # joints of an arm
            chosen = [parts[word] for word in angle_words.split()]
            values = _quaternions(capture, chosen, default, rotation)
            names = [f"{stem} quaternion {axis}".strip() for axis in "xyzw"]
            capture = capture.with_columns(
                [CapturedColumn(name, computed=True) for name in names], values
            )
    return capture


def _unit_norm(capture: Capture, parts: dict[str, CapturedColumn], words: str) -> bool:
    """Whether columns are parts of quaternions, by their norm."""
    size = np.linalg.norm(capture.at([parts[word].name for word in words.split()]), axis=1)
    size = size[np.isfinite(size)]
    return bool(len(size) and np.all(np.abs(size - 1.0) < _TOLERANCE))


def _with_matrix(capture: Capture, stem: str, parts: list[CapturedColumn]) -> Capture:
    """Add the orientation, and of a pose the position; unchanged if it is no rotation."""
    values = capture.at([part.name for part in parts])
    pose = len(parts) > len(_DIRECTIONS)
    matrices = (values[:, _DIRECTIONS] if pose else values).reshape(-1, 3, 3).transpose(0, 2, 1)
    valid = np.isfinite(matrices).all(axis=(1, 2)) & (
        np.abs(np.linalg.det(np.nan_to_num(matrices))) > 0.5
    )
    gram = matrices[valid] @ matrices[valid].transpose(0, 2, 1)
    if not valid.any() or not np.allclose(gram, np.eye(3), atol=_TOLERANCE):
        return capture
    body = _ROTATION.sub("", stem)
    quaternions = np.full((len(values), 4), np.nan)
    quaternions[valid] = Rotation.from_matrix(matrices[valid]).as_quat(canonical=False)
    names = [f"{body} quaternion {axis}" for axis in "xyzw"]
    columns, added = [CapturedColumn(name, computed=True) for name in names], [quaternions]
    if pose:
        unit = parts[_PLACE[0]].unit or "m"
        columns += [CapturedColumn(f"{body} position {axis}", unit) for axis in "xyz"]
        added.append(values[:, _PLACE])
    return capture.with_columns(columns, np.hstack(added))


def _quaternions(
    capture: Capture,
    columns: list[CapturedColumn],
    default: str,
    rotation: Callable[[FloatArray], Rotation],
) -> FloatArray:
    """(rows, 4) x, y, z, w; nan where a part is missing, or all of a quaternion are 0."""
    values = capture.at([column.name for column in columns])
    if default:
        values = values * np.array([RADIANS.get(c.unit, RADIANS[default]) for c in columns])
    valid = np.isfinite(values).all(axis=1)
    if not default:
        valid &= np.linalg.norm(np.nan_to_num(values), axis=1) > 0.5
    quaternions = np.full((len(values), 4), np.nan)
    if valid.any():
        quaternions[valid] = rotation(values[valid]).as_quat(canonical=False)
    return quaternions
