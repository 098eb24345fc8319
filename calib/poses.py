"""In which poses the hand is best shown: those that make the map surest over the field."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib.cell import CellFit
from calib.jaw_marks import Gravity, JawObservation, MarksModel
from drivers.interfaces import FloatArray

#: Nothing that is to be found comes nearer to the picture's edge, px.
_EDGE_PX = 25.0


def in_picture(
    fit: CellFit, poses: Sequence[FloatArray], marks_m: FloatArray, size_px: tuple[int, int]
) -> NDArray[np.bool_]:
    """(S,) whether all marks are in the picture with the hand at poses X_BT (4, 4)."""
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
    field = fit.map_slopes(field_px)
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
