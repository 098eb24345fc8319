"""A model against every trial of a study, and where it fails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.cable.model import CableModel
from cell.lab.fitting import best_delay
from cell.lab.prepared import PreparedStudy, is_released
from cell.lab.where import Where, overall, where
from cell.study.data import Markers, Study, Trial

FloatArray = NDArray[np.float64]

#: Points that show the whole cable, however few markers it has.
DRAWN = 21


@dataclass(frozen=True, eq=False)
class Comparison:
    """A model and a study side by side.

    predicted_m  per trial (times, markers, 2)
    cable_m      per trial (times, `DRAWN` points from tip to grip, 2): the whole cable predicted
    where        one per trial, in the study's order
    """

    study: Study
    noise_m: float
    fit_rms_m: float
    heldout_rms_m: float
    predicted_m: dict[str, FloatArray]
    cable_m: dict[str, FloatArray]
    where: tuple[Where, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain data: errors per trial, profiles, whiteness, what the residual goes with."""
        roles = {t.name: t.role for t in self.study.trials}
        return {
            "format": "cable-comparison/1",
            "noise_m": self.noise_m,
            "fit_rms_m": _number(self.fit_rms_m),
            "heldout_rms_m": _number(self.heldout_rms_m),
            "trials": [
                {
                    "name": w.trial,
                    "role": roles[w.trial],
                    "rms_m": _number(w.rms_m),
                    "by_time": _profile(w.by_time.centre, w.by_time.rms_m, "t_s"),
                    "by_arc_length": _profile(
                        w.by_arc_length.centre, w.by_arc_length.rms_m, "arc_length_m"
                    ),
                    "by_phase": {k: _number(v) for k, v in w.by_phase.items()},
                    "by_frequency": {
                        "frequency_hz": w.spectrum.frequency_hz.tolist(),
                        "residual_m2_per_hz": w.spectrum.residual.tolist(),
                        "noise_m2_per_hz": w.spectrum.noise.tolist(),
                    },
                    "whiteness_p_value": _number(w.whiteness_p_value),
                    "follows": [asdict(f) for f in w.follows],
                }
                for w in self.where
            ],
        }


def compare_model(study: Study, model: CableModel) -> Comparison:
    """Errors of a model on all trials.  Raises NoiseUnknownError, ValueError: cannot simulate."""
    prepared = PreparedStudy.of(study)
    study = prepared.study
    predicted, cable, found = {}, {}, []
    for trial in study.trials:
        delay = best_delay(prepared, model, trial) if is_released(trial) else 0.0
        points, shapes = everywhere(prepared, trial, [model], delay)
        if not np.isfinite(points).all():
            raise ValueError(f"trial {trial.name}: the model cannot be simulated with this motion")
        predicted[trial.name], cable[trial.name] = points[0], shapes[0]
        # rows are (markers, axes, times); unseen values are exactly zero there
        white = prepared.white(trial, points)[0].reshape(-1, 2, len(trial.markers.t_s))
        white = np.where(np.isfinite(trial.markers.xy_m), np.moveaxis(white, 2, 0), np.nan)
        found.append(where(trial, points[0], white, study.arc_length_m, prepared.floor.noise))

    def error(role: str) -> float:
        return overall([t.markers.xy_m - predicted[t.name] for t in study.trials if t.role == role])

    return Comparison(
        study,
        prepared.floor.noise.std_m,
        error("fit"),
        error("validate"),
        predicted,
        cable,
        tuple(found),
    )


def everywhere(
    prepared: PreparedStudy, trial: Trial, models: Sequence[CableModel], delay_s: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Where models put the markers, (models, times, markers, 2), and the cable, (…, `DRAWN`, 2).

    In metres; nan where they cannot be simulated.
    """
    study = prepared.study
    drawn = np.linspace(study.cable.free_length_m, 0.0, DRAWN)
    arcs = np.unique(np.concatenate([study.arc_length_m, drawn]))[::-1]
    t_s = trial.markers.t_s
    blank = replace(trial, markers=Markers(t_s, np.zeros((len(t_s), len(arcs), 2))))
    finer = replace(prepared, study=replace(study, arc_length_m=arcs))
    points = finer.predict(blank, models, np.full(len(models), delay_s))
    at, shape = (np.searchsorted(-arcs, -s) for s in (study.arc_length_m, drawn))
    return points[:, :, at], points[:, :, shape]


def _profile(centre: FloatArray, rms_m: FloatArray, name: str) -> dict[str, list[float | None]]:
    return {name: centre.tolist(), "rms_m": [_number(v) for v in rms_m]}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
