"""Markers of cables that are held straight: there they are where every model has them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.identify.noise import still_frames
from cell.study.data import Study, Trial


def placed(study: Study) -> Study:
    """The study with markers where they are on cables that are held straight before release.

    There every point's place is known without a model: what the still frames show beside it is how
    the marker was put on, and is taken off all frames of the trial.
    """
    return replace(study, trials=tuple(_placed(t, study.arc_length_m) for t in study.trials))


def _placed(trial: Trial, arc_length_m: FloatArray) -> Trial:
    t_s, grip = trial.markers.t_s, trial.grip
    still = still_frames(t_s, grip, trial.release_s)
    if trial.start != "straight" or still.stop == 0:
        return trial
    x, y, angle = (np.interp(t_s[still], grip.t_s, v) for v in (grip.x_m, grip.y_m, grip.angle_rad))
    along = np.stack([-np.cos(angle), -np.sin(angle)], axis=-1)
    straight = np.stack([x, y], axis=-1)[:, None] + arc_length_m[:, None] * along[:, None]
    beside = trial.markers.xy_m[still] - straight
    seen = np.isfinite(beside).any(axis=0)
    offset = np.where(seen, np.nanmean(np.where(seen, beside, 0.0), axis=0), 0.0)
    at_place = replace(trial.markers, xy_m=trial.markers.xy_m - offset)
    return replace(trial, markers=at_place)
