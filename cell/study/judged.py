"""Whether a trial may be of its study's cable: what is refused, and what is odd and told."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Cable
from cell.files.input_error import Problem
from cell.study.checks import exchanged
from cell.study.data import Source, Trial
from cell.study.plausible import clocks_differ, doubt, impossible

#: A marker cannot be farther from the hand than the cable is long; half as far again leaves
#: room for noise, a slipping grip and a clock that is off, and none for millimetres.
FARTHEST = 1.5
#: A hand that moves so many times as far as its markers is given in another unit.
OTHER_UNIT = 30.0


def judged(
    trial: Trial,
    cable: Cable,
    arc_length_m: FloatArray,
    gravity_m_per_s2: tuple[float, float],
) -> tuple[list[Problem], list[str]]:
    """What of a trial is refused, and what is odd and yet possible, each with its line.

    arc_length_m  (markers,) from the gripping point, as in `trial.markers`
    """
    source = _source(trial)
    if far := _far_away(trial, cable, gravity_m_per_s2, source):
        return [far], []
    if places := exchanged(trial.markers):
        return [places], []
    looked_at = (trial, cable, arc_length_m, gravity_m_per_s2)
    if found := impossible(*looked_at):
        return [Problem(source.file, trial.markers.line(found.row), None, "", found.cause)], []
    odd = doubt(*looked_at)
    return [], [] if odd is None else [f"{source.file}: {odd}"]


def _source(trial: Trial) -> Source:
    """Where a trial's markers stand, or would as written."""
    frames, markers = trial.markers.xy_m.shape[:2]
    file = Path(trial.name) / "markers.csv"
    return trial.markers.source or Source(file, np.arange(frames) + 2, np.arange(markers))


def _far_away(
    trial: Trial, cable: Cable, gravity_m_per_s2: tuple[float, float], source: Source
) -> Problem | None:
    """That a marker is farther from the hand than any of this cable can be."""
    grip, markers = trial.grip, trial.markers
    at_m = np.column_stack([np.interp(markers.t_s, grip.t_s, v) for v in (grip.x_m, grip.y_m)])
    # A coordinate that was not seen adds nothing: what is left is the least that it can be.
    away_m = np.nan_to_num(markers.xy_m - at_m[:, None])
    far = np.hypot(away_m[..., 0], away_m[..., 1]) > FARTHEST * cable.length_m
    if not far.any():
        return None
    reach_m, hand_m = _reach_m(markers.xy_m[:, far.any(axis=0)]), _reach_m(at_m)
    if hand_m > OTHER_UNIT * max(reach_m, cable.length_m):
        file = source.file.with_name("grip.csv")
        message = (
            f"the hand's places are up to {hand_m:.3g} m apart, those of the markers "
            f"{reach_m:.3g} m; give metres, not millimetres"
        )
        return Problem(file, 2, None, "x_m, y_m", message)
    shifted = clocks_differ(trial, cable, gravity_m_per_s2)
    if shifted is not None:
        line = int(source.lines[shifted.row])
        return Problem(source.file, line, None, "t_s", shifted.cause)
    row = int(np.argmax(far.any(axis=1)))
    marker = min(np.flatnonzero(far[row]), key=lambda m: int(source.numbers[m]))
    return Problem(
        source.file,
        int(source.lines[row]),
        None,
        source.column(int(marker), 0),
        f"{markers.xy_m[row, marker, 0]:g} lies more than {FARTHEST * cable.length_m:g} m "
        f"({FARTHEST:g} free lengths) from the gripping point; "
        "give metres, in the frame of grip.csv",
    )


def _reach_m(xy_m: FloatArray) -> float:
    """How far apart places (…, 2) are along either axis, what was seen of them."""
    axes = [v[np.isfinite(v)] for v in xy_m.reshape(-1, 2).T]
    return max(float(np.ptp(v)) if v.size else 0.0 for v in axes)
