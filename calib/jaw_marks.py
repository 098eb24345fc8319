"""The jaw's marks in pictures, as one joint model of lens, camera, robot, jaw and gravity.

Frames: B the robot's base, T its tool as the arm reports it, M the marks on the jaw (origin at the
gripping point, x away from the cable, y up), C the camera.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.lens import Lens, pose, project, rotation
from calib.robust import sum_variance
from drivers.interfaces import FloatArray

#: Step of finite differences, relative for parameters above 1.
_STEP = 1e-6
#: Indices of the parameters: lens, base in camera, marks in tool, scale of the marks, gravity, and
#: deformation of the plate, see `shapes`.
LENS, CAMERA, MARK, SCALE, GRAVITY, SHAPE = (
    slice(0, 9),
    slice(9, 15),
    slice(15, 21),
    21,
    slice(22, 24),
    slice(24, None),
)


def parameter_count(marks: int) -> int:
    """Number of parameters of the joint fit with this many marks."""
    return 24 + 3 * marks - 7


def shapes(marks_m: FloatArray) -> FloatArray:
    """(3 M − 7, M, 3) orthonormal deformations of the plate with stated marks (M, 2).

    First 2 M − 4 within the plate, then M − 3 out of it.  They exclude the plate's position,
    rotation and scale.
    """
    x, y = marks_m.T
    zero, one = np.zeros(len(x)), np.ones(len(x))
    moves = np.stack([np.stack(m, 1).ravel() for m in ((one, zero), (zero, one), (x, y), (-y, x))])
    within = np.linalg.svd(moves)[2][4:].reshape(-1, len(x), 2)
    above = np.linalg.svd(np.stack([one, x, y]))[2][3:]
    ways = np.zeros((len(within) + len(above), len(x), 3))
    ways[: len(within), :, :2], ways[len(within) :, :, 2] = within, above
    return ways


def places_m(x: FloatArray, marks_m: FloatArray) -> FloatArray:
    """(M, 3) marks in the frame M by parameters (P,), from their stated centres (M, 2)."""
    shift = np.tensordot(x[SHAPE], shapes(marks_m), axes=1)
    stated = np.column_stack([marks_m, np.zeros(len(marks_m))])
    return np.asarray((1.0 + x[SCALE]) * (stated + shift))


@dataclass(frozen=True, eq=False)
class Plate:
    """Light discs on the jaw: (M, 2) centres in the frame M, and their radius, m."""

    marks_m: FloatArray
    radius_m: float = 0.0


@dataclass(frozen=True, eq=False)
class JawObservation:
    """The jaw's marks with the gripper at rest: the arm's pose X_BT (4, 4), and (M, 2) pixels.

    smear_px  distance in the picture that they moved during the exposure
    """

    name: str
    X_BT: FloatArray
    pixels: FloatArray
    smear_px: float = 0.0


@dataclass(frozen=True, eq=False)
class Gravity:
    """The direction of gravity in the robot's base frame, with its uncertainty.

    up       (3,) unit vector against gravity in the base frame, as mounted
    spread_rad its standard deviation for the mounted base
    threads    (N, 2) pixels along plumb lines, one array each
    """

    up: FloatArray
    spread_rad: float
    threads: tuple[FloatArray, ...] = ()


class MarksModel:
    """Residuals of all marks; `together` weights the common part of all marks of one pose."""

    def __init__(
        self,
        shown: Sequence[JawObservation],
        marks_m: FloatArray,
        gravity: Gravity,
        together: float,
    ) -> None:
        self._hands = np.array([s.X_BT for s in shown])
        self._pixels = np.concatenate([s.pixels for s in shown])
        self._marks = marks_m
        self._gravity = gravity
        self._together = together

    def __call__(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(S M, 2) residuals, px, and (S M, 2, P) derivatives."""
        R_CB, by_camera = rotation(x[9:12])
        R_TM, by_mark = rotation(x[15:18])
        R_BT, t_BT = self._hands[:, :3, :3], self._hands[:, :3, 3]
        sized = places_m(x, self._marks)
        in_tool = sized @ R_TM.T + x[18:21]
        in_base = np.einsum("sij,mj->smi", R_BT, in_tool) + t_BT[:, None]
        flat = in_base.reshape(-1, 3)
        pixels, by_point, by_lens = project(x[LENS], flat @ R_CB.T + x[12:15])
        slopes = np.zeros((len(flat), 2, len(x)))
        slopes[:, :, LENS] = by_lens
        slopes[:, :, 9:12] = by_point @ np.einsum("ijk,nj->nik", by_camera, flat)
        slopes[:, :, 12:15] = by_point
        to_camera = np.einsum("ij,sjk->sik", R_CB, R_BT)
        from_tool = by_point.reshape(len(self._hands), -1, 2, 3) @ to_camera[:, None]
        turned = np.einsum("ijk,mj->mik", by_mark, sized)
        slopes[:, :, 15:18] = (from_tool @ turned).reshape(-1, 2, 3)
        slopes[:, :, 18:21] = from_tool.reshape(-1, 2, 3)
        grown = sized @ R_TM.T / (1.0 + x[SCALE])
        slopes[:, :, SCALE] = np.einsum("smij,mj->smi", from_tool, grown).reshape(-1, 2)
        by_place = (1.0 + x[SCALE]) * from_tool @ R_TM
        by_shape = np.einsum("smij,wmj->smiw", by_place, shapes(self._marks))
        slopes[:, :, SHAPE] = by_shape.reshape(len(flat), 2, -1)
        return self._weighted(pixels - self._pixels), self._weighted(slopes)

    def _weighted(self, values: FloatArray) -> FloatArray:
        by_pose = values.reshape(len(self._hands), -1, *values.shape[1:])
        common = by_pose.mean(axis=1, keepdims=True)
        return np.asarray((by_pose - (1.0 - self._together) * common).reshape(values.shape))

    def threads(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(K,) angles of plumb lines from vertical, in deviations, and (K, P) derivatives."""

        def planes(x: FloatArray) -> FloatArray:
            lens = Lens.of(x[LENS])
            return np.array([_plane_of(t, lens) for t in self._gravity.threads]).reshape(-1, 3)

        def up_in_camera(x: FloatArray) -> FloatArray:
            upright = self._gravity.up + x[GRAVITY] @ side
            up: FloatArray = pose(x[CAMERA])[:3, :3] @ (upright / np.linalg.norm(upright))
            return up

        side = sideways(self._gravity.up)
        normals, up = planes(x), up_in_camera(x)
        slopes = np.zeros((len(normals), len(x)))
        columns = np.arange(len(x))
        for k in columns[LENS]:
            slopes[:, k] = _slope(planes, x, k) @ up
        for k in (*columns[CAMERA], *columns[GRAVITY]):
            slopes[:, k] = normals @ _slope(up_in_camera, x, k)
        return normals @ up, slopes


def _slope(function: Callable[[FloatArray], FloatArray], x: FloatArray, k: int) -> FloatArray:
    """Derivative of a function by its k-th parameter."""
    step = np.zeros(len(x))
    step[k] = _STEP * max(1.0, abs(x[k]))
    return np.asarray((function(x + step) - function(x - step)) / (2.0 * step[k]))


def _plane_of(pixels: FloatArray, lens: Lens) -> FloatArray:
    """(3,) normal of the plane of a thread and the camera, over the deviation of its angle."""
    ideal = lens.ideal(pixels)
    rays = (ideal - [lens.cx_px, lens.cy_px]) / [lens.fx_px, lens.fy_px]
    middle = rays.mean(axis=0)
    _, sizes, axes = np.linalg.svd(rays - middle, full_matrices=False)
    along = axes[0] * np.sign(axes[0] @ np.array([0.0, 1.0]))
    normal = np.cross([*middle, 1.0], [*along, 0.0])
    normal /= np.linalg.norm(normal)
    # residuals of neighbouring rows are correlated: both have the same edges of pixels
    way, residual = (rays - middle) @ axes.T[:, 0], (rays - middle) @ axes.T[:, 1]
    scatter = np.sqrt(max(sum_variance(way * residual), sizes[1] ** 2 / len(way) * sizes[0] ** 2))
    angle_spread = max(scatter / sizes[0], 0.02 / lens.fx_px) / sizes[0]
    return np.asarray(normal / angle_spread)


def sideways(up: FloatArray) -> FloatArray:
    """(2, 3) unit vectors at right angles to `up` and to each other."""
    other = np.eye(3)[int(np.argmin(np.abs(up)))]
    a = np.cross(up, other)
    a /= np.linalg.norm(a)
    return np.stack([a, np.cross(up, a)])


def centred(
    observation: JawObservation, x: FloatArray, marks_m: FloatArray, radius_m: float
) -> JawObservation:
    """The observation with pixels of the discs' centres instead of their images' centroids.

    Perspective and distortion shift the two relative to each other.
    """
    angles = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    rim = radius_m * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(32)])
    X_CM = pose(x[CAMERA]) @ observation.X_BT @ pose(x[MARK])
    pixels = observation.pixels.copy()
    for k, mark in enumerate(places_m(x, marks_m)):
        points = np.vstack([mark, mark + rim]) @ X_CM[:3, :3].T + X_CM[:3, 3]
        centre, *edge = project(x[LENS], points)[0]
        a = np.array(edge) - centre
        b = np.roll(a, -1, axis=0)
        cross = a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]
        if abs(cross.sum()) > 0.0:
            pixels[k] -= np.sum((a + b) * cross[:, None], axis=0) / (3.0 * cross.sum())
    return replace(observation, pixels=pixels)
