"""A wrench measured at the clamp compared with that of a model, in newtons."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.identify.noise import rms
from cell.lab.data.gauges import Gauges
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.series import ljung_box
from cell.study.data import Trial
from cell.study.wrench import COLUMNS


@dataclass(frozen=True, eq=False)
class WrenchResidual:
    """A trial's wrench and a model's: force x, y, N, and moment, N·m.

    measured, predicted  (T, 3) at times (T,), measured less the likeliest tare; nan = not measured
    noise, rms           (3,) of the sensor in one row, and of measured − predicted
    p_values             (3,) that the error is white: small = it has a pattern; nan = not measured
    """

    trial: str
    t_s: FloatArray
    measured: FloatArray
    predicted: FloatArray
    noise: FloatArray
    rms: FloatArray
    p_values: FloatArray

    @property
    def beyond_noise(self) -> FloatArray:
        """(3,) what of the error is not noise, its systematic part, by mean squares."""
        return np.asarray(np.sqrt(np.maximum(self.rms**2 - self.noise**2, 0.0)))

    def to_json(self) -> dict[str, Any]:
        """Plain data, by column of the file; without those that were not measured."""
        return {
            name: {
                "rms": self.rms[i],
                "noise": self.noise[i],
                "beyond_noise": self.beyond_noise[i],
                "whiteness_p_value": self.p_values[i],
            }
            for i, name in enumerate(COLUMNS)
            if np.isfinite(self.rms[i])
        }


def wrench_residual(
    prepared: PreparedStudy, trial: Trial, points: FloatArray, white: FloatArray
) -> WrenchResidual | None:
    """Of a model's points (T, all points, 2) in a trial; None where no wrench was measured.

    white  (T, all points, 2) whitened residual, nan where not seen
    """
    gauges = prepared.gauges
    if gauges is None or not np.isfinite(trial.markers.xy_m[:, gauges.markers :]).any():
        return None
    predicted = gauges.of_wrench(points)
    error = gauges.of_wrench(prepared.error_m(trial, points))
    seen = np.isfinite(error).any(axis=1)
    series = white[:, gauges.markers :].reshape(len(white), -1)[:, : len(COLUMNS)]
    return WrenchResidual(
        trial.name,
        trial.markers.t_s[seen],
        (predicted + error)[seen],
        predicted[seen],
        noise_of(gauges),
        np.array([rms(column) for column in error.T]),
        np.array([ljung_box(column[:, None]) for column in series.T]),
    )


def noise_of(gauges: Gauges) -> FloatArray:
    """(3,) standard deviation of force x, y, N, and moment, N·m, in one row."""
    force, moment = gauges.force.noise.std_m, gauges.moment.noise.std_m
    return np.array([force, force, moment])
