"""Comparison of a model with every trial of a study: its errors, and where they occur."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.model import CableModel
from cell.files.plain import plain
from cell.lab.data.noise_model import NoiseUnknownError, noise_model_of
from cell.lab.data.prepared import PreparedStudy, of_frames
from cell.lab.data.work import SpentError, Work
from cell.lab.fit.fitting import best_initial_state
from cell.lab.fit.heldout import predict_cable
from cell.lab.fit.series import overall
from cell.lab.strength.trial_residual import (
    TrialResidual,
    WrenchResidual,
    trial_residual,
    unsimulated_trial,
    wrench_residual,
)
from cell.study.data import Study

#: p-value of whiteness, or of a correlation with a signal, below which it is significant.
NOTICEABLE = 0.01
#: An error below this multiple of the noise is noise: no removed share is defined.
NOISY = 1.02


@dataclass(frozen=True, eq=False)
class Comparison:
    """Errors of a model on the trials of a study.

    noise_m      of the measurement: as the study states it, else the camera's at rest
    noise_at_rest_m   the camera's, from frames in which nothing moves; nan if there are none
    model        displayed name
    effects      names of the model's effects, in the order in which they were added
    predicted_m  per trial (times, markers, 2)
    cable_m      per trial (times, points from tip to grip, 2): the complete cable predicted
    where        residual of each trial, in the study's order
    wrenches     one per trial in which a wrench was measured, and which can be simulated
    """

    study: Study
    noise_m: float
    fit_rms_m: float
    heldout_rms_m: float
    predicted_m: dict[str, FloatArray]
    cable_m: dict[str, FloatArray]
    where: tuple[TrialResidual, ...]
    noise_at_rest_m: float = float("nan")
    model: str = "model"
    effects: tuple[str, ...] = ()
    wrenches: tuple[WrenchResidual, ...] = ()

    @property
    def error_m(self) -> float:
        """rms error on the motions not fitted to, on those fitted to if there are no others.

        Infinite where the model cannot be simulated.
        """
        return self.fit_rms_m if np.isnan(self.heldout_rms_m) else self.heldout_rms_m

    @property
    def noise_is_stated(self) -> bool:
        """Whether the study states its measurement's error."""
        return self.study.noise_std_m is not None

    def patterns(self) -> int:
        """Number of trials in which the residual is not white."""
        return sum(w.whiteness_p_value < NOTICEABLE for w in self.where)

    def removed_share(self, before: Comparison) -> float:
        """Share of the former error beyond noise (mean square) that is gone; < 0 if it grew.

        nan if the former model's error was noise
        """
        excess = before.error_m**2 - self.noise_m**2
        if before.error_m < NOISY * self.noise_m:
            return float("nan")
        if not np.isfinite(excess):  # the former could not be simulated
            return 1.0 if np.isfinite(self.error_m) else 0.0
        return float(min((before.error_m**2 - self.error_m**2) / excess, 1.0))

    def to_json(self) -> dict[str, Any]:
        """Plain data: errors per trial, profiles, whiteness, correlations."""
        roles = {t.name: t.role for t in self.study.trials}
        wrenches = {w.trial: {"wrench": w.to_json()} for w in self.wrenches}
        trials = [
            {
                "name": w.trial,
                "role": roles[w.trial],
                "rms_m": w.rms_m,
                "by_time": {"t_s": w.by_time.centre, "rms_m": w.by_time.rms_m},
                "by_arc_length": {
                    "arc_length_m": w.by_arc_length.centre,
                    "rms_m": w.by_arc_length.rms_m,
                },
                "by_phase": w.by_phase,
                "by_frequency": vars(w.spectrum),
                "whiteness_p_value": w.whiteness_p_value,
                "follows": [vars(f) for f in w.correlations],
                **wrenches.get(w.trial, {}),
            }
            for w in self.where
        ]
        content = {
            "format": "cable-comparison/1",
            "noise_m": self.noise_m,
            "fit_rms_m": self.fit_rms_m,
            "heldout_rms_m": self.heldout_rms_m,
            "trials": trials,
        }
        return dict(plain(content))


def compare_model(
    study: Study, model: CableModel, name: str = "model", work: Work | None = None
) -> Comparison:
    """Errors of a model on all trials; infinite where it cannot be simulated.

    work    budget of simulations; if it is spent, initial states come from the first frames only
    raises  NoiseUnknownError; StoppedError: the caller has stopped the work
    """
    prepared = PreparedStudy.of(study, work=work)
    try:
        return _compared(prepared, model, name)
    except SpentError:
        prepared.work.conclude()
        return _compared(prepared, model, name)


def _compared(prepared: PreparedStudy, model: CableModel, name: str) -> Comparison:
    """The same for a prepared study."""
    study, noise = prepared.unjoined, prepared.noise_model.noise
    predicted, cable, errors = {}, {}, {}
    trial_residuals, wrenches = [], []
    for trial, joined in zip(study.trials, prepared.study.trials, strict=True):
        initial_states = best_initial_state(prepared, model, joined)
        points, shapes = predict_cable(prepared, joined, [model], initial_states)
        places = prepared.of_markers(joined, points[0])
        predicted[trial.name] = places
        cable[trial.name] = of_frames(prepared, joined, shapes[0])
        if not np.isfinite(points).all():
            trial_residuals.append(unsimulated_trial(trial, study.arc_length_m, noise))
            continue
        # rows are (markers, axes, times); missing values are exactly zero there
        white = prepared.white(joined, points)[0].reshape(-1, 2, len(joined.markers.t_s))
        white = np.where(np.isfinite(joined.markers.xy_m), np.moveaxis(white, 2, 0), np.nan)
        errors[trial.name] = prepared.of_markers(joined, prepared.error_m(joined, points[0]))
        of_places = errors[trial.name], prepared.of_markers(joined, white)
        trial_residuals.append(trial_residual(trial, places, *of_places, study.arc_length_m, noise))
        wrenches.append(wrench_residual(prepared, joined, points[0], white))

    def error(role: str) -> float:
        chosen = [t for t in study.trials if t.role == role]
        if not all(np.isfinite(predicted[t.name]).all() for t in chosen):
            return float("inf")
        return overall([errors[t.name] for t in chosen])

    return Comparison(
        study,
        prepared.noise_model.noise.std_m,
        error("fit"),
        error("validate"),
        predicted,
        cable,
        tuple(trial_residuals),
        _noise_at_rest_m(prepared),
        name,
        tuple(active.effect.name for active in model.effects),
        tuple(w for w in wrenches if w is not None),
    )


def _noise_at_rest_m(prepared: PreparedStudy) -> float:
    if prepared.study.noise_std_m is None:
        return prepared.noise_model.noise.std_m
    try:
        return noise_model_of(replace(prepared.study, noise_std_m=None)).noise.std_m
    except NoiseUnknownError:
        return float("nan")


def comparisons_json(comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """Comparisons as plain data: the last model's, and all of them in `models`."""
    first = comparisons[0]
    models = [
        {
            "name": c.model,
            "effects": list(c.effects),
            "removed_share": None if c is first else plain(c.removed_share(first)),
            **{k: v for k, v in c.to_json().items() if k not in ("format", "noise_m")},
        }
        for c in comparisons
    ]
    return {**comparisons[-1].to_json(), "models": models}


def model_names(paths: Sequence[Path]) -> list[str]:
    """Short names of model files, all different."""
    stems = [p.stem for p in paths]
    return [s if stems.count(s) == 1 else str(p) for s, p in zip(stems, paths, strict=True)]
