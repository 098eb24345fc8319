"""Cross-check of the joint fit by classic hand–eye calibration: poses one by one, then the robot.

A plate's pose is found in each picture alone (`solvePnP`), and the camera's place in the robot's
base by bringing these and the arm's poses together.  Of the joint fit it shares the pictures and
nothing else but the first lens.  Park's and Daniilidis' solutions of AX = XB need turns about two
axes at least, which an arm that moves in one plane never makes; places it does show, so they are
what is brought together.
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
    lens     as found from the board alone
    X_BP     (4, 4) plane in base, whose place is a choice and not compared
    """
    from scipy.optimize import least_squares  # half a second, of which only a calibration has need

    flat = np.column_stack([marks_m, np.zeros(len(marks_m))])
    seen = []
    for one in shown:
        _, turn, shift = cv2.solvePnP(
            flat, lens.ideal(one.pixels), lens.matrix, None, flags=cv2.SOLVEPNP_IPPE
        )
        X_CM = pose(np.concatenate([turn.ravel(), shift.ravel()]))
        seen.append(flat @ X_CM[:3, :3].T + X_CM[:3, 3])
    in_camera = np.array(seen)
    hands = np.array([one.X_BT for one in shown])

    def in_base(plate: FloatArray) -> FloatArray:
        """(S, M, 3) marks of a plate that stands at x, y and an angle in the tool."""
        X = pose(np.array([0.0, 0.0, plate[2], plate[0], plate[1], 0.0]))
        in_tool = flat @ X[:3, :3].T + X[:3, 3]
        points: FloatArray = np.einsum("sij,mj->smi", hands[:, :3, :3], in_tool)
        return np.asarray(points + hands[:, None, :3, 3])

    def left(x: FloatArray) -> FloatArray:
        X_CB = pose(x[:6])
        return np.asarray((in_base(x[6:]) @ X_CB[:3, :3].T + X_CB[:3, 3] - in_camera).ravel())

    start = np.concatenate([_brought_together(in_base(np.zeros(3)), in_camera), np.zeros(3)])
    X_CB = pose(least_squares(left, start, x_scale="jac").x[:6])
    return PlaneView.from_pose(lens, X_CB @ X_BP)


def _brought_together(points: FloatArray, others: FloatArray) -> FloatArray:
    """(6,) turn and shift that bring points (…, 3) nearest to others.  Source: Kabsch 1976."""
    p, q = points.reshape(-1, 3), others.reshape(-1, 3)
    u, _, v = np.linalg.svd((q - q.mean(axis=0)).T @ (p - p.mean(axis=0)))
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    return np.concatenate([cv2.Rodrigues(R)[0].ravel(), q.mean(axis=0) - R @ p.mean(axis=0)])


#: Nothing that is to be found comes nearer to the picture's edge, px.
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
    """Which of the candidate poses X_BT (4, 4) to show next, best first.

    Greedy: each is the one that lowers the mean variance of the map over the field most, given
    those before it and the fit so far.  Poses whose marks would leave the picture are never chosen.

    field_px  (G, 2) where the map matters
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
