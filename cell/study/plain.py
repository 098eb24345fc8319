"""A study as plain data, and back to the last bit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Cable, Motion
from cell.study.data import Markers, Study, Trial, Wrench, WrenchSensor
from cell.study.hand_drift import HandDrift, HandDriftSection
from cell.study.wrench_file import SensorEntry, sensor_entry


def study_to_plain(study: Study) -> dict[str, Any]:
    """Names, numbers and arrays; notes and sources are left out."""
    return {
        "name": study.name,
        "cable": study.cable.to_dict(),
        "arc_length_m": study.arc_length_m,
        "gravity_m_per_s2": list(study.gravity_m_per_s2),
        "noise_std_m": study.noise_std_m,
        "arc_length_std_m": None
        if study.arc_length_std_m is None
        else [float(s) for s in study.arc_length_std_m],
        "trials": [
            {
                "name": trial.name,
                "role": trial.role,
                "start": trial.start,
                "release_s": trial.release_s,
                "hand_drift": None if trial.hand_drift is None else trial.hand_drift.to_plain(),
                "grip": {k: getattr(trial.grip, k) for k in ("t_s", "x_m", "y_m", "angle_rad")},
                "markers": {"t_s": trial.markers.t_s, "xy_m": trial.markers.xy_m},
            }
            | ({} if trial.wrench is None else {"wrench": dict(vars(trial.wrench))})
            for trial in study.trials
        ],
    } | ({} if study.sensor == WrenchSensor() else {"wrench": sensor_entry(study.sensor)})


def study_from_plain(data: Mapping[str, Any]) -> Study:
    """Back from `study_to_plain`, by way of JSON or not; None in arrays is nan.

    raises  KeyError, TypeError, ValueError: no study
    """
    x_m_per_s2, y_m_per_s2 = data["gravity_m_per_s2"]
    std_m = data.get("arc_length_std_m")  # recordings of earlier versions have none
    return Study(
        data["name"],
        Cable.from_dict(data["cable"]),
        _array(data["arc_length_m"]),
        tuple(
            Trial(
                t["name"],
                t["role"],
                t["start"],
                Motion(**{k: _array(v) for k, v in t["grip"].items()}),
                Markers(_array(t["markers"]["t_s"]), _array(t["markers"]["xy_m"])),
                t["release_s"],
                _drift(t.get("hand_drift")),
                Wrench(**{k: _array(v) for k, v in t["wrench"].items()}) if "wrench" in t else None,
            )
            for t in data["trials"]
        ),
        (float(x_m_per_s2), float(y_m_per_s2)),
        data["noise_std_m"],
        arc_length_std_m=None if std_m is None else _array(std_m),
        sensor=SensorEntry(**data.get("wrench", {})).sensor(),
    )


def _drift(given: Mapping[str, Any] | None) -> HandDrift | None:
    """Recordings of earlier versions have none."""
    return None if given is None else HandDriftSection(**given).drift()


def _array(values: Any) -> FloatArray:
    return np.array(values, float)
