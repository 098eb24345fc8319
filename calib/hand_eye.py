"""Cross-check of the joint fit by classic hand–eye calibration: poses one by one, then the robot.

A plate's pose is estimated in each picture alone (`solvePnP`), and the camera's pose in the robot's
base by registration of these with the arm's poses.  With the joint fit it has only the pictures and
the first lens in common.  Park's and Daniilidis' solutions of AX = XB need rotations about two axes
at least, which an arm in one plane does not make; so positions are registered.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.cell import CellFit
from calib.jaw_marks import Gravity, JawObservation, MarksModel
from calib.lens import Lens, pose
from calib.plane import PlaneView
from drivers.interfaces import FloatArray


def classic_view(
    shown: Sequence[JawObservation], marks_m: FloatArray, lens: Lens, X_BP: FloatArray
) -> PlaneView:
    """Map from pixels to the plane, with the plate's pose estimated picture by picture.

    marks_m  (M, 2) as stated
    lens     as estimated from the board alone
    X_BP     (4, 4) plane in base, which is a choice and not compared
    """
    from scipy.optimize import least_squares  # half a second, needed for a calibration only

    flat = np.column_stack([marks_m, np.zeros(len(marks_m))])
    plates = []
    for observation in shown:
        _, turn, shift = cv2.solvePnP(
            flat, lens.ideal(observation.pixels), lens.matrix, None, flags=cv2.SOLVEPNP_IPPE
        )
        X_CM = pose(np.concatenate([turn.ravel(), shift.ravel()]))
        plates.append(flat @ X_CM[:3, :3].T + X_CM[:3, 3])
    in_camera = np.array(plates)
    hands = np.array([observation.X_BT for observation in shown])

    def in_base(plate: FloatArray) -> FloatArray:
        """(S, M, 3) marks of a plate that stands at x, y and an angle in the tool."""
        X = pose(np.array([0.0, 0.0, plate[2], plate[0], plate[1], 0.0]))
        in_tool = flat @ X[:3, :3].T + X[:3, 3]
        points: FloatArray = np.einsum("sij,mj->smi", hands[:, :3, :3], in_tool)
        return np.asarray(points + hands[:, None, :3, 3])

    def residuals(x: FloatArray) -> FloatArray:
        X_CB = pose(x[:6])
        return np.asarray((in_base(x[6:]) @ X_CB[:3, :3].T + X_CB[:3, 3] - in_camera).ravel())

    start = np.concatenate([_registration(in_base(np.zeros(3)), in_camera), np.zeros(3)])
    X_CB = pose(least_squares(residuals, start, x_scale="jac").x[:6])
    return PlaneView.from_pose(lens, X_CB @ X_BP)


def _registration(points: FloatArray, others: FloatArray) -> FloatArray:
    """(6,) rotation and shift of points (…, 3) to others by least squares.  Source: Kabsch 1976."""
    p, q = points.reshape(-1, 3), others.reshape(-1, 3)
    u, _, v = np.linalg.svd((q - q.mean(axis=0)).T @ (p - p.mean(axis=0)))
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    return np.concatenate([cv2.Rodrigues(R)[0].ravel(), q.mean(axis=0) - R @ p.mean(axis=0)])


#: Least distance of marks from the picture's edge, px.
_EDGE_PX = 25.0


def in_picture(
    fit: CellFit, poses: Sequence[FloatArray], marks_m: FloatArray, size_px: tuple[int, int]
) -> NDArray[np.bool_]:
    """(S,) whether all marks lie within the picture at tool poses X_BT (S, 4, 4)."""
    shown = [JawObservation("", X, np.zeros((len(marks_m), 2))) for X in poses]
    pixels = MarksModel(shown, marks_m, Gravity(fit.up, 1.0), 1.0)(fit.mean)[0]
    pixels = pixels.reshape(len(shown), -1, 2)
    inside = (pixels > _EDGE_PX) & (pixels < np.array(size_px) - 1.0 - _EDGE_PX)
    return np.asarray(np.all(inside, axis=(1, 2)), dtype=np.bool_)


def choose_poses(
    fit: CellFit,
    candidates: Sequence[FloatArray],
    marks_m: FloatArray,
    field_px: FloatArray,
    size_px: tuple[int, int],
    count: int,
) -> list[int]:
    """Indices of the candidate poses X_BT (4, 4) to show next, best first.

    Greedy: each lowers the mean variance of the map over the field most, given those before it and
    the fit so far.  Poses whose marks would leave the picture are never chosen.

    field_px  (G, 2) pixels over which the map's variance is averaged
    """
    shown = [
        JawObservation(f"{k}", X, np.zeros((len(marks_m), 2))) for k, X in enumerate(candidates)
    ]
    slopes = MarksModel(shown, marks_m, Gravity(fit.up, 1.0), 1.0)(fit.mean)[1]
    slopes = slopes.reshape(len(shown), -1, slopes.shape[-1]) / max(fit.noise_px, 0.01)
    inside = in_picture(fit, candidates, marks_m, size_px)
    field = fit.map_jacobian(field_px)
    weight = field.T @ field / len(field_px)
    covariance, chosen = fit.covariance, []
    for _ in range(min(count, int(inside.sum()))):
        gains = np.full(len(shown), -np.inf)
        for k in np.flatnonzero(inside):
            if k in chosen:
                continue
            through = covariance @ slopes[k].T
            middle = np.eye(len(slopes[k])) + slopes[k] @ through
            gains[k] = np.trace(through.T @ weight @ through @ np.linalg.inv(middle))
        best = int(np.argmax(gains))
        through = covariance @ slopes[best].T
        middle = np.eye(len(slopes[best])) + slopes[best] @ through
        covariance = covariance - through @ np.linalg.solve(middle, through.T)
        chosen.append(best)
    return chosen
