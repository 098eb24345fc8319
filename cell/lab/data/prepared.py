"""A prepared study: whitened residuals of models, trial by trial."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import wraps
from typing import Any, Concatenate, Literal, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.cable.wrench import AS_POINTS, Gauge
from cell.identify.fit import Lane, predict_lanes
from cell.identify.marker_shift import carried_m, derivative_along
from cell.identify.noise import Noise, still_frames
from cell.identify.whitener import Whitener
from cell.lab.data.gauges import Gauges, scaled, with_gauges, without_gauges
from cell.lab.data.noise_model import (
    Level,
    NoiseModel,
    noise_model_of,
    noise_model_of_residuals,
    with_levels,
)
from cell.lab.data.unknown_start import InitialState, initial_state_of
from cell.lab.data.work import SOLVER, Work
from cell.study.data import Study, Trial


def placed(study: Study) -> Study:
    """The study without constant marker offsets, where the cable is held straight before release.

    There every point's place is known without a model.  The mean offset of a marker in the frames
    at rest is its mounting error, and is subtracted from all frames of the trial.
    """
    return study.with_places(lambda trial: _placed_m(trial, study.arc_length_m))


def _placed_m(trial: Trial, arc_length_m: FloatArray) -> FloatArray:
    t_s, xy_m, grip = trial.markers.t_s, trial.markers.xy_m, trial.grip
    still = still_frames(t_s, grip, trial.release_s)
    if trial.start != "straight" or still.stop == 0:
        return xy_m
    angle = np.interp(t_s[still], grip.t_s, grip.angle_rad)
    along = np.stack([-np.cos(angle), -np.sin(angle)], axis=-1)
    straight = trial.gripper_m(t_s[still])[:, None] + arc_length_m[:, None] * along[:, None]
    deviation_m = xy_m[still] - straight
    observed = np.isfinite(deviation_m).any(axis=0)
    return xy_m - np.where(observed, np.nanmean(np.where(observed, deviation_m, 0.0), axis=0), 0.0)


def arcs_are_uncertain(study: Study) -> bool:
    """Whether the study states an uncertainty of its markers' arc lengths."""
    return study.arc_length_std_m is not None and bool(np.any(study.arc_length_std_m > 0.0))


def whiteners_of(
    study: Study,
    noise: Noise,
    gauges: Gauges | None = None,
    lines: Mapping[str, FloatArray] | None = None,
    levels: Mapping[str, Level] | None = None,
) -> dict[str, Whitener]:
    """The whiteners of a study's trials, one per trial.

    lines  per trial (times, markers, 2) derivative of markers' places by their arc length in a
           model; as measured where it is missing
    levels noise of a trial's markers over `noise`; 1 where it is missing

    Whiteners are independent between trials, yet a marker's arc length is common to all n trials.
    So each trial has its own arc length of n times the variance: a common shift then has the stated
    variance, and no combination of trials is overconfident.  The same holds for a sensor's gain.
    """
    lines, levels = lines or {}, levels or {}
    std_m, markers = study.arc_length_std_m, len(study.arc_length_m)
    whiteners = {}
    for t in study.trials:
        # a sensor's points follow the markers, and neither shift nor drift
        padding = ((0, t.markers.xy_m.shape[1] - markers), (0, 0))
        places = replace(t, markers=replace(t.markers, xy_m=t.markers.xy_m[:, :markers]))
        shift_m, carried = None, carried_m(places)
        if std_m is not None and arcs_are_uncertain(study):
            each_m = np.sqrt(len(study.trials)) * std_m[:, None]
            slopes = lines.get(t.name)
            slopes = derivative_along(places, study.arc_length_m) if slopes is None else slopes
            shift_m = np.pad(each_m * slopes, ((0, 0), *padding))
        if carried is not None:
            carried = np.pad(carried, ((0, 0), (0, 0), *padding))
        sensors = None if gauges is None else gauges.sensors(t)
        level = levels[t.name].of_markers if t.name in levels else None
        whiteners[t.name] = Whitener(t.markers.xy_m, noise, shift_m, carried, sensors, level)
    return whiteners


Number = TypeVar("Number", bound=np.generic)
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

#: A model is wrong if its rms error exceeds the noise by this factor.
ERROR_RATIO = 1.1


@dataclass(frozen=True, eq=False)
class PreparedStudy:
    """A study with its noise model and the whiteners of its trials.

    study  its markers, followed by the measured wrench at the clamp as further points, if any:
           see `gauges`
    work   budget and count of its simulations
    noise  used for whitening: the measurement's, or the larger error of an earlier individual's
           model
    slope_solver  of simulations for derivatives; None = `solver`
    counted   solver that determines the counted work, if not `solver`: the extent of a search must
              not depend on coarser derivatives
    memo      results of `once_per_study`; empty for a new study
    mesh_m    per trial (times, markers, 2) error of the solver's mesh that has been subtracted from
              the study's markers, m
    rounding_m  likewise the mean error of rounded values
    lines     per trial (times, markers, 2) derivative of a model's markers by their arc lengths;
              empty if these are certain, or if no model explains the study yet
    gauges    how wrenches are represented as points; None = there are none
    """

    study: Study
    noise_model: NoiseModel
    noise: Noise
    whiteners: dict[str, Whitener]
    solver: Solver
    work: Work = field(default_factory=Work)
    slope_solver: Solver | None = None
    counted: Solver | None = None
    mesh_m: Mapping[str, FloatArray] = field(default_factory=dict)
    rounding_m: Mapping[str, FloatArray] = field(default_factory=dict)
    lines: Mapping[str, FloatArray] = field(default_factory=dict)
    gauges: Gauges | None = None
    memo: dict[tuple[object, ...], Any] = field(default_factory=dict, init=False, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        """State for another process, without cached results."""
        return {**vars(self), "memo": {}}

    @staticmethod
    def of(
        study: Study,
        *,
        misfit: Noise | None = None,
        solver: Solver | None = None,
        work: Work | None = None,
    ) -> PreparedStudy:
        """Prepare a study.

        work    budget and count
        misfit  error of an earlier individual's model, used if it exceeds the camera's
        raises  NoiseUnknownError
        """
        study = placed(study)
        noise_model = with_levels(study, noise_model_of(study))
        noise, level_m = noise_model.noise, noise_model.noise.std_m
        if misfit is not None and misfit.std_m > ERROR_RATIO * level_m:
            noise = misfit
        study, gauges = with_gauges(study, level_m, noise.std_m / level_m)
        return PreparedStudy(
            study, noise_model, noise, {}, solver or SOLVER, work or Work(), gauges=gauges
        ).rewhitened()

    def rewhitened(self, **changes: Any) -> PreparedStudy:
        """The same with changed fields, and new whiteners."""
        new = replace(self, **changes)
        whiteners = whiteners_of(new.study, new.noise, new.gauges, new.lines, new.levels)
        return replace(new, whiteners=whiteners)

    @property
    def noise_is_measured(self) -> bool:
        """Whether the noise is the measurement's own, not an earlier model's error."""
        return self.noise == self.noise_model.for_whitening

    @property
    def noise_is_stated(self) -> bool:
        """Whether the noise is the measurement's own, of a level that the study states."""
        return self.noise_is_measured and self.noise_model.stated

    @property
    def expected(self) -> Noise:
        """Residual of a right model: the measurement's noise or an earlier model's error."""
        return self.noise_model.noise if self.noise_is_measured else self.noise

    @property
    def levels(self) -> Mapping[str, Level]:
        """Relative noise of each trial's markers, where it differs; else empty."""
        return self.noise_model.levels if self.noise_is_measured else {}

    def noise_m(self, role: Literal["fit", "validate"]) -> float:
        """Root mean square of the measurement's noise in the trials of a role, m."""
        return self.noise_model.rms_m(self.study.role(role), len(self.study.arc_length_m))

    def expected_m(self, role: Literal["fit", "validate"]) -> float:
        """Root mean square residual of a right model there, m; see `expected`."""
        return self.noise_m(role) if self.noise_is_measured else self.noise.std_m

    @property
    def unjoined(self) -> Study:
        """The study with wrenches separate from its markers."""
        return self.study if self.gauges is None else without_gauges(self.study, self.gauges)

    def of_markers(self, trial: Trial, rows: FloatArray) -> FloatArray:
        """(frames, markers, …) of (times, all points, …) of a trial: without those of gauges."""
        return rows if self.gauges is None else self.gauges.of_markers(trial.name, rows)

    def subtracted_m(self, trial: Trial) -> FloatArray:
        """(times, markers, 2) errors that have been subtracted from a trial's markers, m."""
        error_m = self.mesh_m.get(trial.name, np.zeros_like(trial.markers.xy_m))
        return np.asarray(error_m + self.rounding_m.get(trial.name, 0.0))

    def initial_state(self, trial: Trial) -> InitialState:
        """The unknown initial state of a trial."""
        return initial_state_of(trial, self.study.cable, self.study.scale_m_per_s2)

    def predict(
        self, trial: Trial, models: Sequence[CableModel], initial_states: FloatArray | None = None
    ) -> FloatArray:
        """(lanes, times, markers, 2) predicted markers of a trial, m; nan where not simulable.

        initial_states  (lanes, unknowns) of the trial.  The gripper rests at a release, so that a
            delay shifts everything by as much.
        """
        by_trial = None if initial_states is None else {trial.name: initial_states}
        return self.predict_all([trial], models, by_trial)[0]

    def predict_all(
        self,
        trials: Sequence[Trial],
        models: Sequence[CableModel],
        initial_states: Mapping[str, FloatArray] | None = None,
    ) -> list[FloatArray]:
        """The same for several trials; lanes with the same kind of start form one batch.

        initial_states  by trial; 0 where missing
        """
        out = {t.name: np.empty((len(models), *t.markers.xy_m.shape)) for t in trials}
        for group in _batches(self, trials, models, initial_states or {}):
            lanes = [lane for *_, lane in group]
            gauge = self.gauge(lanes[0].trial)
            predicted = predict_lanes(lanes, self.study.arc_length_m, self.solver, np.nan, gauge)
            for (name, number, _), points in zip(group, predicted, strict=True):
                out[name][number] = points
        if self.gauges is not None:
            for trial in trials:
                if self.gauge(trial) is not None:
                    out[trial.name][:, :, -AS_POINTS:] *= self.gauges.scale
        return [out[t.name] for t in trials]

    def gauge(self, trial: Trial) -> Gauge | None:
        """The gauge of the wrench among a trial's points; None if there is none."""
        markers = len(self.study.arc_length_m)
        if self.gauges is None or trial.markers.xy_m.shape[1] == markers:
            return None
        return self.gauges.gauge

    def on_one_core(self) -> PreparedStudy:
        """The same, simulated without own threads, for several fits in parallel."""
        slopes = None if self.slope_solver is None else replace(self.slope_solver, threads=1)
        return replace(self, solver=replace(self.solver, threads=1), slope_solver=slopes)

    def white(self, trial: Trial, predicted_m: FloatArray) -> FloatArray:
        """(lanes, rows) whitened residuals of predictions (lanes, times, markers, 2)."""
        return self.whiteners[trial.name](predicted_m)

    def error_m(self, trial: Trial, predicted_m: FloatArray) -> FloatArray:
        """(times, markers, 2) measured − predicted of one model, m, nan where not observed.

        Where arc lengths are uncertain, relative to the likeliest ones.
        """
        return self.whiteners[trial.name].residual_m(predicted_m)

    def all_white(
        self,
        trials: Sequence[Trial],
        models: Sequence[CableModel],
        initial_states: Mapping[str, FloatArray] | None = None,
    ) -> FloatArray:
        """(lanes, rows) whitened residuals of models over all the trials."""
        predicted = self.predict_all(trials, models, initial_states)
        parts = [self.white(t, points) for t, points in zip(trials, predicted, strict=True)]
        return np.concatenate(parts, axis=1)

    def coarser(self, slopes: Solver) -> PreparedStudy:
        """The same with this solver, but work counted as with the present one."""
        return replace(self, solver=slopes, slope_solver=None, counted=self.solver)

    def white_near(
        self,
        trials: Sequence[Trial],
        models: Sequence[CableModel],
        initial_states: Mapping[str, FloatArray] | None = None,
    ) -> FloatArray:
        """As `all_white`, for models near the first: only differences from it are used."""
        if self.slope_solver is not None:
            white = self.coarser(self.slope_solver).all_white(trials, models, initial_states)
            if np.all(np.isfinite(white[0])):
                return white
        return self.all_white(trials, models, initial_states)

    def by_trial(
        self, trials: Sequence[Trial], rows: NDArray[Number]
    ) -> dict[str, NDArray[Number]]:
        """Per trial its rows of whitened values (rows, …), without the prior's, the last ones."""
        ends = np.cumsum([self.whiteners[t.name].rows for t in trials])
        return dict(zip([t.name for t in trials], np.split(rows, ends), strict=False))

    def count(self, trials: Sequence[Trial]) -> int:
        """Number of observed coordinates in trials."""
        return sum(self.whiteners[t.name].count for t in trials)


def once_per_study(
    function: Callable[Concatenate[PreparedStudy, Arguments], Result],
) -> Callable[Concatenate[PreparedStudy, Arguments], Result]:
    """Decorator: a function of a study and other arguments whose results the study caches."""

    @wraps(function)
    def once(prepared: PreparedStudy, /, *of: Arguments.args, **named: Arguments.kwargs) -> Result:
        key = (function, *of, *named.items())
        if key not in prepared.memo:
            prepared.memo[key] = function(prepared, *of, **named)
        result: Result = prepared.memo[key]
        return result

    return once


def as_measured(prepared: PreparedStudy) -> Study:
    """The study as it was measured: corrections of its markers are undone."""
    study = prepared.study.with_places(lambda t: t.markers.xy_m + prepared.subtracted_m(t))
    return replace(prepared, study=study).unjoined


def of_frames(prepared: PreparedStudy, trial: Trial, rows: FloatArray) -> FloatArray:
    """(frames, …) rows of a trial at the camera's frames, of (times, …) at all sample times."""
    gauges = prepared.gauges
    return rows if gauges is None else rows[gauges.joined[trial.name].frames]


def pooled(prepared: PreparedStudy) -> PreparedStudy:
    """The prepared study with every trial as a fit trial."""
    if all(t.role == "fit" for t in prepared.study.trials):
        return prepared
    return replace(prepared, study=all_fitted(prepared.study))


def all_fitted(study: Study) -> Study:
    """The study with every trial in role `fit`."""
    return replace(study, trials=tuple(replace(t, role="fit") for t in study.trials))


def _batches(
    prepared: PreparedStudy,
    trials: Sequence[Trial],
    models: Sequence[CableModel],
    initial_states: Mapping[str, FloatArray],
) -> Iterable[list[tuple[str, int, Lane]]]:
    """Lanes of all trials and models, grouped by start: trial, model and lane.

    Their work is counted.
    """
    batches: dict[object, list[tuple[str, int, Lane]]] = {}
    for trial in trials:
        t_s, state = trial.markers.t_s, prepared.initial_state(trial)
        counted = prepared.counted or prepared.solver
        prepared.work.add(len(models), float(t_s[-1] - t_s[0]), counted)
        unknown = initial_states.get(trial.name, np.zeros((len(models), state.count)))
        delays = state.delay_s(unknown)
        times = {float(d): t_s - d for d in np.unique(delays)}
        for number, (model, d) in enumerate(zip(models, delays, strict=True)):
            modes = state.modes(unknown[number]) if state.bent else None
            means = None if trial.row_means is None else trial.row_means.earlier(float(d))
            lane = Lane(trial, model, times[float(d)], modes, means)
            key = _start_key(lane), prepared.gauge(trial) is None
            batches.setdefault(key, []).append((trial.name, number, lane))
    return batches.values()


def _start_key(lane: Lane) -> object:
    """Key of a lane's start: lanes with equal keys can share a grid of time steps."""
    trial = lane.trial
    if trial.release_s is not None:
        return trial.start, trial.release_s
    if trial.start == "moving":
        return trial.start, float(lane.times_s[0])
    return trial.start, min(float(lane.times_s[0]), float(trial.grip.t_s[0]))


def with_noise_from(prepared: PreparedStudy, errors: Sequence[FloatArray]) -> PreparedStudy:
    """The prepared study; a stated noise gets the correlations of a model's residuals.

    errors  per fit trial (times, channels), m, nan where not observed
    """
    if not prepared.noise_is_measured:
        return prepared
    fitted, columns = prepared.study.role("fit"), 2 * len(prepared.study.arc_length_m)
    places = [of_frames(prepared, t, e)[:, :columns] for t, e in zip(fitted, errors, strict=True)]
    noise_model = noise_model_of_residuals(prepared.noise_model, places)
    unchanged = noise_model == prepared.noise_model
    return prepared if unchanged else with_noise_model(prepared, noise_model)


def with_noise_model(
    prepared: PreparedStudy,
    noise_model: NoiseModel,
    of_gauges: tuple[NoiseModel, NoiseModel] | None = None,
) -> PreparedStudy:
    """The prepared study, whitened with another noise model.

    of_gauges  noise of force and moment, if it changes too
    """
    noise = noise_model.for_whitening
    same = noise_model.levels == prepared.noise_model.levels
    if noise == prepared.noise and same and of_gauges is None:
        return replace(prepared, noise_model=noise_model)
    levelled = _with_gauge_scale(prepared, noise_model.noise.std_m, of_gauges)
    return levelled.rewhitened(noise_model=noise_model, noise=noise)


def _with_gauge_scale(
    prepared: PreparedStudy, std_m: float, of_gauges: tuple[NoiseModel, NoiseModel] | None
) -> PreparedStudy:
    """The same with gauges scaled to this noise."""
    if prepared.gauges is None:
        return prepared
    force, moment = of_gauges or (prepared.gauges.force, prepared.gauges.moment)
    gauges = replace(prepared.gauges, std_m=std_m, force=force, moment=moment)
    factors = gauges.scale / prepared.gauges.scale
    mesh_m = {name: error_m.copy() for name, error_m in prepared.mesh_m.items()}
    for error_m in mesh_m.values():
        error_m[:, gauges.markers :] *= factors
    study = scaled(prepared.study, gauges, factors)
    return replace(prepared, study=study, gauges=gauges, mesh_m=mesh_m)
