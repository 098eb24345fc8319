"""Comparison of a model with every trial of a study: its errors, and where they occur."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Motion, moves_from_s
from cell.cable.model import CableModel
from cell.files.plain import plain
from cell.identify.noise import Noise, rms, still_frames
from cell.lab.data.noise_model import NoiseUnknownError, noise_model_of
from cell.lab.data.prepared import PreparedStudy, of_frames
from cell.lab.data.work import SpentError, Work
from cell.lab.fit.fitting import best_initial_state
from cell.lab.fit.heldout import predict_cable
from cell.lab.fit.series import (
    LAGS,
    PowerSpectrum,
    correlation,
    ljung_box,
    overall,
    rms_by_time,
    smoothed,
    spectrum,
)
from cell.study.data import Study, Trial
from cell.study.wrench import COLUMNS

#: The swing is `early` for this long after the gripper has stopped, then `late`.
EARLY_SWING_S = 0.3
PHASES = ("still", "moving", "early swing", "late swing")


@dataclass(frozen=True)
class ResidualProfile:
    """rms residual over groups: `centre`, `rms_m` (groups,); nan where nothing was observed."""

    centre: FloatArray
    rms_m: FloatArray


@dataclass(frozen=True)
class Correlation:
    """Correlation of the tip's residual with a signal, and its two-sided p-value."""

    signal: str
    correlation: float
    p_value: float


@dataclass(frozen=True)
class TrialResidual:
    """Size of one trial's residual by time, place, phase and frequency.

    by_time     over `TIME_BINS` equal spans; by_arc_length over markers; by_phase over `PHASES`
    whiteness_p_value  of Ljung and Box over all markers: small = the residual has a pattern
    correlations       of the tip's residual with signals, strongest first
    """

    trial: str
    rms_m: float
    by_time: ResidualProfile
    by_arc_length: ResidualProfile
    by_phase: dict[str, float]
    spectrum: PowerSpectrum
    whiteness_p_value: float
    correlations: tuple[Correlation, ...]


def trial_residual(
    trial: Trial,
    predicted_m: FloatArray,
    residual: FloatArray,
    white: FloatArray,
    arc_length_m: FloatArray,
    noise: Noise,
) -> TrialResidual:
    """Residual statistics of a trial.

    predicted_m  (times, markers, 2), m; residual likewise, nan where not observed
    white        (times, markers, 2) whitened residual, nan where not observed
    """
    t_s = trial.markers.t_s
    names = phase_of(trial)
    return TrialResidual(
        trial=trial.name,
        rms_m=rms(residual),
        by_time=ResidualProfile(*rms_by_time(t_s, residual)),
        by_arc_length=ResidualProfile(
            arc_length_m, np.array([rms(residual[:, m]) for m in range(residual.shape[1])])
        ),
        by_phase={p: rms(residual[names == p]) for p in PHASES},
        spectrum=spectrum(t_s, residual, noise),
        whiteness_p_value=ljung_box(white.reshape(len(t_s), -1)),
        correlations=correlations(trial, predicted_m, white),
    )


def unsimulated_trial(trial: Trial, arc_length_m: FloatArray, noise: Noise) -> TrialResidual:
    """The `TrialResidual` of a trial that cannot be simulated: its error is infinite."""
    missing = np.full((len(trial.markers.t_s), len(arc_length_m), 2), np.nan)
    residual = trial_residual(trial, missing, missing, missing, arc_length_m, noise)
    return replace(residual, rms_m=float("inf"), correlations=())


def displacement(measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """(…, 2) measured minus predicted; 0 in a single coordinate that was not measured."""
    error = measured - predicted
    lost = np.isnan(error)
    return np.where(lost & ~lost.all(axis=-1, keepdims=True), 0.0, error)


def distance(measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """(…) length of `displacement`; nan where neither coordinate was measured."""
    return np.asarray(np.linalg.norm(displacement(measured, predicted), axis=-1))


def phase_of(trial: Trial) -> NDArray[np.str_]:
    """(times,) the phase of the motion, one of `PHASES`, at each marker time."""
    t_s = trial.markers.t_s
    still = still_frames(t_s, trial.grip, trial.rests_until_s)
    start_s = float(t_s[still.stop]) if still.stop < len(t_s) else np.inf
    stop_s = max(_stop_s(trial.grip), start_s)
    limits = [start_s, stop_s, stop_s + EARLY_SWING_S]
    return np.array(PHASES)[np.searchsorted(limits, t_s, "right")]


def _stop_s(motion: Motion) -> float:
    """When the gripper comes to rest for good: the onset of the motion run backwards."""
    t_s = motion.t_s
    mirrored = t_s[0] + t_s[-1]
    backward = Motion(
        mirrored - t_s[::-1], motion.x_m[::-1], motion.y_m[::-1], motion.angle_rad[::-1]
    )
    onset_s = moves_from_s(backward)
    return float(mirrored - onset_s) if np.isfinite(onset_s) else float(t_s[0])


def correlations(
    trial: Trial, predicted_m: FloatArray, white: FloatArray
) -> tuple[Correlation, ...]:
    """Signals that the residual of the outermost marker is correlated with, strongest first.

    The whitened residual along the cable's normal is correlated with each signal at that marker;
    its p-value counts only the independent values of the two series (Bartlett 1935).
    """
    t_s = trial.markers.t_s
    if len(t_s) < 2 * LAGS:
        return ()
    grip = trial.gripper_m(t_s)
    normal = across_tip(trial, predicted_m)
    velocity = np.sum(np.gradient(predicted_m[:, 0], t_s, axis=0) * normal, axis=1)
    smooth = min(len(t_s) - (1 - len(t_s) % 2), 11)
    acceleration = np.gradient(np.gradient(smoothed(grip, smooth), t_s, axis=0), t_s, axis=0)
    chord = np.unwrap(np.arctan2(-normal[:, 0], normal[:, 1]))
    clamp_angle = np.interp(t_s, trial.grip.t_s, trial.grip.angle_rad)
    signals = {
        "base acceleration, x": acceleration[:, 0],
        "base acceleration, y": acceleration[:, 1],
        "tip velocity": velocity,
        "|v|v of the tip": np.abs(velocity) * velocity,
        "curvature rate": np.gradient(chord - clamp_angle, t_s),
    }
    # a marker with one observed coordinate contributes that coordinate
    observed = np.isfinite(white[:, 0])
    error = np.sum(np.where(observed, white[:, 0], 0.0) * normal, axis=1)
    error = np.where(observed.any(axis=1), error, np.nan)
    result = [Correlation(name, *correlation(error, values)) for name, values in signals.items()]
    return tuple(sorted(result, key=lambda f: -abs(f.correlation)))


def across_tip(trial: Trial, predicted_m: FloatArray) -> FloatArray:
    """(times, 2) unit vector across the cable at the outermost marker."""
    # the grip stands in as second marker where there is only one
    points = np.concatenate([predicted_m, trial.gripper_m(trial.markers.t_s)[:, None]], axis=1)
    along = points[:, 0] - points[:, 1]
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-12)[:, None]
    return np.column_stack([-along[:, 1], along[:, 0]])


def largest(values: FloatArray) -> float:
    """The 99th percentile of the finite values; 0 if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, 99)) if finite.size else 0.0


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
        """(3,) systematic part of the error: root of its mean square less the noise's."""
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
    """Measured wrench and that of a model's points (T, all points, 2); None if not measured.

    white  (T, all points, 2) whitened residual, nan where not observed
    """
    gauges = prepared.gauges
    if gauges is None or not np.isfinite(trial.markers.xy_m[:, gauges.markers :]).any():
        return None
    predicted = gauges.of_wrench(points)
    error = gauges.of_wrench(prepared.error_m(trial, points))
    observed = np.isfinite(error).any(axis=1)
    series = white[:, gauges.markers :].reshape(len(white), -1)[:, : len(COLUMNS)]
    return WrenchResidual(
        trial.name,
        trial.markers.t_s[observed],
        (predicted + error)[observed],
        predicted[observed],
        np.array([gauges.force.noise.std_m] * 2 + [gauges.moment.noise.std_m]),
        np.array([rms(column) for column in error.T]),
        np.array([ljung_box(column[:, None]) for column in series.T]),
    )


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
