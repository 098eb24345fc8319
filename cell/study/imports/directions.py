"""The plane of a cable's motion, which way is up, and to which side it leaves the gripper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Finding, Sure
from cell.study.imports.gripper_section import AxesSection
from cell.study.imports.shape import bend

#: An axis of the file is in the plane if this share of it is.
_IN_PLANE = 0.9
#: A bend of the cable decides what is up if it is this large (1 = by a radian), and speaks so many
#: times more for one axis than for the usual one.
_BEND, _TIMES = 0.1, 1.5
#: A plane nearer to the file's axes than this is along them, rad: half a degree moves a place
#: within the plane by 4 parts in 100,000.
_ALONG = 0.0087
_LETTERS = "XYZ"


@dataclass(frozen=True)
class _Up:
    direction: FloatArray
    sure: Sure
    why: str


def find_axes(places: FloatArray, shape: FloatArray) -> tuple[AxesSection, list[Finding]]:
    """Directions of x (right) and y (up) of the study, such that the cable leaves towards −x.

    places  (rows, points, 2 or 3) in order along the cable, the gripper first
    shape   (points, d) of the cable at rest, or its mean
    """
    dimensions = places.shape[2]
    normal, flat = _normal(places)
    up = _up(shape, normal)
    right, along = _right(places, shape, normal, up.direction)
    words = _words(right), _words(up.direction)
    findings = []
    if normal is not None:
        findings.append(
            Finding(
                "axes", f"the motion is in one plane, {flat:.2g} of its size out of it", Sure.SEEN
            )
        )
    findings += [
        Finding("axes.up", f"up is {words[1]}: {up.why}", up.sure),
        Finding(
            "axes.right",
            f"right is {words[0]}: so the cable leaves the gripper to the left{along}",
            Sure.SEEN,
        ),
    ]
    section = AxesSection(right=_plain(right, dimensions), up=_plain(up.direction, dimensions))
    return section, findings


def _normal(places: FloatArray) -> tuple[FloatArray | None, float]:
    """Across the plane in which all points are, and what is out of it, as a share; None in 2D."""
    if places.shape[2] == 2:
        return None, 0.0
    seen = places[np.isfinite(places).all(axis=2)]
    centred = seen - np.median(seen, axis=0)
    _, sizes, directions = np.linalg.svd(centred, full_matrices=False)
    return directions[2], float(sizes[2] / sizes[0])


def _up(shape: FloatArray, normal: FloatArray | None) -> _Up:
    """Which axis of the file is up: the one against which the cable bends from its clamp on."""
    dimensions = shape.shape[1]
    axes = [k for k in range(dimensions) if normal is None or _in_plane(normal, k)]
    if not axes and normal is not None:  # a plane that is askew to all of them
        axes = [int(np.argmin(np.abs(normal)))]
    usual = 1 if dimensions == 2 or 2 not in axes else 2
    if usual not in axes:
        usual = axes[0]
    bent = bend(shape)
    size = {k: abs(float(bent[k])) for k in axes}
    chosen = max(axes, key=lambda k: size[k])
    if size[chosen] < _BEND:
        direction = np.zeros(dimensions)
        direction[usual] = 1.0
        return _Up(direction, Sure.GUESSED, "the usual one, for the cable is straight at rest")
    if chosen != usual and size[chosen] < _TIMES * size[usual]:
        chosen = usual
    direction = np.zeros(dimensions)
    direction[chosen] = -np.sign(bent[chosen])
    sure = Sure.SEEN if chosen == usual else Sure.GUESSED
    return _Up(direction, sure, "at rest the cable bends the other way, as gravity does it")


def _in_plane(normal: FloatArray, axis: int) -> bool:
    return bool(np.sqrt(1.0 - min(1.0, float(normal[axis] ** 2))) > _IN_PLANE)


def _right(
    places: FloatArray, shape: FloatArray, normal: FloatArray | None, up: FloatArray
) -> tuple[FloatArray, str]:
    """The level direction in the plane, from the cable to the gripper."""
    if normal is None:
        level = np.array([up[1], -up[0]])
        told = ""
    else:
        level = np.cross(up, normal - (normal @ up) * up)
        level = level / np.linalg.norm(level)
        nearest = int(np.argmax(np.abs(level)))
        turned = float(np.arccos(min(1.0, abs(float(level[nearest])))))
        if turned < _ALONG:
            level = np.zeros(3)
            level[nearest] = 1.0
        told = "" if turned < _ALONG else f", {np.degrees(turned):.3g}° from the file's axis"
    leaves = float((shape[1:].mean(axis=0) - shape[0]) @ level)
    if leaves == 0.0:
        leaves = float(np.nanmean(places[:, 1:] - places[:, :1], axis=(0, 1)) @ level)
    return (-level if leaves > 0.0 else level) + 0.0, told


def _words(direction: FloatArray) -> str:
    """A direction in words where it is along an axis of the file, else as numbers."""
    nearest = int(np.argmax(np.abs(direction)))
    if abs(direction[nearest]) <= 1.0 - 1e-9:
        return "[" + ", ".join(f"{v:.4g}" for v in direction) + "] of the file"
    backwards = direction[nearest] < 0
    if len(direction) == 3:
        return f"{'−' if backwards else '+'}{_LETTERS[nearest]} of the file"
    return f"the {('first', 'second')[nearest]} coordinate{', reversed' if backwards else ''}"


def _plain(direction: FloatArray, dimensions: int) -> list[float]:
    return [round(float(v), 7) + 0.0 for v in direction[:dimensions]]
