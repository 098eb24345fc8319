"""Checks in each cycle, by its own motion, whether latency and lag are as calibrated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.timing import LEAST_FRAMES, Delay, lag_change, latency_change
from cell.cable.arrays import FloatArray
from cell.records.result import AgreementCheck
from drivers.interfaces import Trajectory

#: Largest rms distance of the detections from the arm's log that determines a delay, m.
_MOST_MISFIT_M = 0.0005


@dataclass(frozen=True)
class CalibratedDelays:
    """Uncertainty of the calibrated latency and lag, and their allowed change.

    latency_95_s, lag_95_s  half widths of their 95 % intervals when they were calibrated
    most_change_s           beyond those
    remedy                  for a person, when they have changed
    """

    latency_95_s: float
    lag_95_s: float
    most_change_s: float
    remedy: str


def delay_checks(
    stamps_s: FloatArray,
    detected_m: FloatArray,
    gripper_log: Trajectory,
    commanded: Trajectory,
    lag_s: float,
    known: CalibratedDelays,
) -> tuple[AgreementCheck, ...]:
    """Checks of latency and lag against those in use; none if the motion does not determine them.

    stamps_s  (N,) of frames, the latency subtracted
    detected_m  (N, 2) detected gripping point, nan where it was not detected
    gripper_log  measured poses of the same time
    commanded  the path, its times on the cell's clock
    lag_s     that is in use
    """
    if np.count_nonzero(np.isfinite(detected_m[:, 0])) < LEAST_FRAMES:
        return ()
    changes = (
        ("camera: timestamps late by", latency_change(stamps_s, detected_m, gripper_log)),
        ("arm: lag changed by", lag_change(commanded, gripper_log, lag_s)),
    )
    stored = (known.latency_95_s, known.lag_95_s)
    return tuple(
        _check(name, delay, known.most_change_s + half_s, known.remedy)
        for (name, delay), half_s in zip(changes, stored, strict=True)
    )


def _check(name: str, delay: Delay, most_s: float, remedy: str) -> AgreementCheck:
    """Compare a delay with its limit, widened by the half width of its own interval."""
    most_s += delay.half_width_s
    if delay.rms_m > _MOST_MISFIT_M:
        return AgreementCheck(f"{name}, not measurable with this motion", delay.value_s, "s")
    return AgreementCheck(name, delay.value_s, "s", -most_s, most_s, remedy)
