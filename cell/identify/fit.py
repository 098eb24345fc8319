"""Fit of a cable's parameters to trials: all frames jointly, AR(1) noise, Gaussian prior."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.dynamics import Beginning, simulate, simulate_each
from cell.cable.geometry import moves_from_s
from cell.cable.model import CableModel
from cell.cable.solver import DivergedError, Solver
from cell.cable.statics import UnsettledError
from cell.cable.wrench import Gauge, RowMeans
from cell.identify import gauss_newton
from cell.identify.gripper_errors import GripperLogErrors, sampled_motions
from cell.identify.identified import Identified
from cell.identify.noise import Noise, across, estimate_noise, still_frames
from cell.identify.parameters import ParameterSpace
from cell.identify.predicted_frames import PredictedFrames
from cell.identify.whitener import Whitener
from cell.study.data import Markers, Trial

#: Variance inflation from which a fit is repeated with the noise widened by it.
_MATTERS = 1.3
#: With predicted frames a single linear step is taken if it is shorter than `tolerance` standard
#: deviations.
_ONE_STEP = gauss_newton.Options(tolerance=30.0, max_iterations=1)
MINIMISER = gauss_newton.Options(tolerance=1.5)
#: A cold start is first fitted to this much of the swing, s, so that model and measurement do not
#: differ by a full period; EI of the cables that are tried, in units of ρ g L³.
_FIRST_WINDOW_S, _START_RANGE = 0.4, (0.05, 20.0)
#: Attempts after a fit that does not converge, in this order; then its last point is the result.
_CONTINUED, _RESTARTED = "continued", "restarted"


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit.

    solver           of the cable engine; its error should be well below the noise
    gripper_errors   uncertainty of the logged motion
    starts           uniform cables tried for a cold start
    """

    solver: Solver = Solver(segments=30)  # noqa: RUF009
    gripper_errors: GripperLogErrors = GripperLogErrors()  # noqa: RUF009
    starts: int = 32


class FitError(ValueError):
    """A fit that cannot be done, or did not find a minimum.  Scenario: nan in every frame."""


def fit(
    trials: Sequence[Trial],
    arc_length_m: FloatArray,
    space: ParameterSpace,
    *,
    noise: Noise | None = None,
    previous: Identified | None = None,
    predicted: PredictedFrames | None = None,
    options: FitOptions = FitOptions(),
) -> Identified:
    """Most probable parameters of a cable, given all observed markers of `trials`.

    A fit that does not converge is continued, then restarted, with wider noise; then its last
    point is the result, with its error in the covariance.

    arc_length_m  (markers,) from the gripping point, m
    noise         of the markers; None = standard deviation and ar1 estimated from the still frames
    previous      fit of the same parameters to fewer frames of the same trials: the start;
                  None = start from a grid of uniform cables
    predicted     frames of a single trial that were simulated at `previous` in advance
    raises        FitError: no observed marker, neither noise nor still frames, no model that can
                  be simulated
    """
    if not any(np.isfinite(t.markers.xy_m).any() for t in trials):
        raise FitError("no marker is seen in any frame")
    if noise is None:
        noise = still_noise(trials)
    if predicted is not None:
        predicted = predicted.as_filmed(trials[0])
    if previous is None:
        start = _cold_start(trials, arc_length_m, space, noise, options)
    else:
        start = previous.mean
    widened = 1.0 if previous is None else previous.inflation
    iterations, attempts = 0, [_CONTINUED, _RESTARTED]
    while True:
        # a model error beyond the camera's noise lowers the data's weight relative to the prior
        used = replace(noise, std_m=noise.std_m * float(np.sqrt(widened)))
        whiteners = whiteners_of(trials, used)
        residuals = _residuals(trials, arc_length_m, space, whiteners, options.solver, predicted)
        try:
            minimiser = MINIMISER if predicted is None else _ONE_STEP
            solution = gauss_newton.minimise(_problem(space, residuals), start, minimiser)
        except ValueError as error:
            raise FitError(str(error)) from error
        iterations += solution.iterations
        if predicted is not None and not solution.converged:
            predicted = None
            continue
        inflation = variance_inflation(solution.residual, whiteners, len(start))
        if not solution.converged and attempts:
            # a model error makes the objective rough; wider noise makes it smooth
            widened *= max(inflation, _MATTERS)
            if attempts.pop(0) == _CONTINUED:
                start = solution.q
            else:
                start = _cold_start(trials, arc_length_m, space, noise, options)
            continue
        if inflation < _MATTERS or widened > 1.0:
            break
        widened, start = inflation, start if predicted is not None else solution.q
    hand_covariance = _gripper_covariance(
        trials, arc_length_m, space.model(solution.q), whiteners, solution, options, predicted
    )
    return Identified(
        space=space,
        mean=solution.q,
        covariance=solution.covariance * inflation + hand_covariance,
        noise=noise,
        residual_rms_m=rms_m(solution.residual, whiteners),
        model_error_m=tip_error_m(solution.residual, whiteners, arc_length_m, noise),
        converged=solution.converged,
        inflation=widened * inflation,
        frames_used=sum(frames_detected(t) for t in trials),
        frames_total=sum(len(t.markers.t_s) for t in trials),
        iterations=iterations,
        method="map",
        gripper_covariance=hand_covariance,
    )


def tip_error_m(
    white_residual: FloatArray,
    whiteners: Sequence[Whitener],
    arc_length_m: FloatArray,
    noise: Noise,
) -> float:
    """Root mean square residual at the tip in excess of the noise, m."""
    tip, square, count = int(np.argmax(arc_length_m)), 0.0, 0
    for whitener, block in _blocks(white_residual, whiteners):
        error = whitener.error_m(block)[:, tip]
        square += float(np.nansum(error**2))
        count += int(np.isfinite(error).sum())
    return float(np.sqrt(max(0.0, square / max(1, count) - noise.std_m**2)))


def _gripper_covariance(
    trials: Sequence[Trial],
    arc_length_m: FloatArray,
    model: CableModel,
    whiteners: Sequence[Whitener],
    solution: gauss_newton.Solution,
    options: FitOptions,
    predicted: PredictedFrames | None,
) -> FloatArray:
    """(p, p) covariance of the parameters due to the uncertainty of the gripper's motion.

    That of the fit's linear response to residuals from sampled motions of the gripper.
    """
    responses = np.zeros((options.gripper_errors.samples, len(solution.q)))
    if options.gripper_errors.samples == 0:
        return np.zeros_like(solution.covariance)
    for trial, (whitener, jacobian) in zip(
        trials, _blocks(solution.jacobian, whiteners), strict=True
    ):
        if predicted is not None:
            nodes_m = np.concatenate([predicted.markers_m[:1], predicted.others_m])
        else:
            nodes_m = _with_sampled_grips(trial, arc_length_m, model, options)
        white = whitener(nodes_m)
        responses -= (white[1:] - white[0]) @ jacobian
    responses = responses @ solution.covariance
    covariance: FloatArray = responses.T @ responses / options.gripper_errors.samples
    return covariance


def _with_sampled_grips(
    trial: Trial, arc_length_m: FloatArray, model: CableModel, options: FitOptions
) -> FloatArray:
    """(1 + samples, T, markers, 2) markers for the logged motion of the gripper and samples."""
    try:
        return simulate(
            model,
            [trial.grip, *sampled_motions(trial.grip, options.gripper_errors.of(trial))],
            trial.markers.t_s,
            arc_length_m,
            solver=options.solver,
            start=trial.start,
            release_s=trial.release_s,
        )
    except (DivergedError, UnsettledError) as error:
        raise FitError(str(error)) from error


def whiteners_of(trials: Sequence[Trial], noise: Noise) -> list[Whitener]:
    """One whitener per trial, for the noise of the markers."""
    return [Whitener(t.markers.xy_m, noise) for t in trials]


def frames_detected(trial: Trial) -> int:
    """Number of frames in which at least one marker is observed."""
    return int(np.count_nonzero(np.isfinite(trial.markers.xy_m).any(axis=(1, 2))))


def still_noise(
    trials: Sequence[Trial], *, bias_m: float = 0.0, across_only: bool = False
) -> Noise:
    """Noise from the frames before anything moves.  Raises FitError if there are too few."""
    stills = []
    for trial in trials:
        still = still_frames(trial.markers.t_s, trial.grip, trial.rests_until_s)
        markers = trial.markers.xy_m[still]
        if across_only and len(markers):
            axes = across(markers)
            first = np.isfinite(markers).all(axis=-1).argmax(axis=0)  # first complete frame of each
            shift = markers - markers[first, np.arange(markers.shape[1])]
            markers = np.sum(shift * axes, axis=-1, keepdims=True)
        stills.append(markers)
    estimate = estimate_noise(stills)
    if estimate is None or estimate[0] == 0.0:
        raise FitError("the noise cannot be estimated: too few still frames")
    return Noise(*estimate, bias_m, across_only)


@dataclass(frozen=True, eq=False)
class Lane:
    """One simulation of a batch: a model on the motion of a trial, sampled at `times_s`.

    modes  (2, modes) initial places and velocities, of a trial that begins bent
    means  the values of a wrench that are means of a sensor's rows; None = none
    """

    trial: Trial
    model: CableModel
    times_s: FloatArray
    modes: FloatArray | None = None
    means: RowMeans | None = None


def predict_lanes(
    lanes: Sequence[Lane],
    arc_length_m: FloatArray,
    solver: Solver,
    impossible: float = np.inf,
    gauge: Gauge | None = None,
) -> list[FloatArray]:
    """(T, markers, 2) positions of the markers of each lane, m.  All lanes begin alike.

    impossible  value of a lane that cannot be simulated; the others are not affected
    gauge       sensor of the wrench, which follows the markers as in `simulate_each`
    """
    trial = lanes[0].trial
    bent = [lane.modes for lane in lanes if lane.modes is not None]
    predicted = simulate_each(
        [lane.model for lane in lanes],
        [lane.trial.grip for lane in lanes],
        [lane.times_s for lane in lanes],
        arc_length_m,
        solver=solver,
        begin=Beginning.of(trial.start, trial.release_s, bent, len(lanes)),
        gauge=gauge,
        means=[lane.means for lane in lanes],
    )
    return [np.full_like(p, impossible) if np.isnan(p).all() else p for p in predicted]


def predict(
    trial: Trial, models: Sequence[CableModel], arc_length_m: FloatArray, solver: Solver
) -> FloatArray:
    """(lanes, T, markers, 2) predicted markers of a trial, m; as `predict_lanes`."""
    lanes = [Lane(trial, model, trial.markers.t_s) for model in models]
    return np.stack(predict_lanes(lanes, arc_length_m, solver))


def variance_inflation(
    white_residual: FloatArray, whiteners: Sequence[Whitener], parameters: int
) -> float:
    """Factor ≥ 1 by which the parameters' variance exceeds that of white residuals of unit size.

    The mean square of the residuals times their integrated autocorrelation time along the frames:
    a model error lasts for many frames, which do not count as independent.
    source  Sokal 1997, Monte Carlo Methods in Statistical Mechanics, sec. 3; sum up to the first
            lag whose correlation is below its own standard error
    """
    count = sum(w.count for w in whiteners)
    mean_square = float(white_residual @ white_residual) / max(1, count - parameters)
    channels: list[FloatArray] = []
    for whitener, block in _blocks(white_residual, whiteners):
        grid = block.reshape(-1, whitener.channels, whitener.frames)
        channels += [g.reshape(-1, g.shape[-1]) for g in whitener.own_rows(grid) if g.size]
    time, powers = 1.0, [float(np.sum(c * c)) for c in channels]
    for lag in range(1, max(c.shape[1] for c in channels) // 2):
        # a short trial has no information on long lags
        long = [(c, p) for c, p in zip(channels, powers, strict=True) if lag < c.shape[1] // 2]
        power = sum(p for _, p in long)
        product = sum(float(np.sum(c[:, lag:] * c[:, :-lag])) for c, _ in long)
        if power == 0.0 or product / power < 2.0 / np.sqrt(count):
            break
        time += 2.0 * product / power
    return float(max(1.0, mean_square * time))


def rms_m(white_residual: FloatArray, whiteners: Sequence[Whitener]) -> float:
    """Root mean square of measured − predicted per coordinate, m."""
    square = 0.0
    for whitener, block in _blocks(white_residual, whiteners):
        square += float(np.nansum(whitener.error_m(block) ** 2))
    return float(np.sqrt(square / sum(w.count for w in whiteners)))


def _blocks(
    rows: FloatArray, whiteners: Sequence[Whitener]
) -> Iterator[tuple[Whitener, FloatArray]]:
    """Each trial's whitener, and its part of all rows."""
    ends = np.cumsum([w.rows for w in whiteners])
    return zip(whiteners, np.split(rows, ends[:-1]), strict=True)


def _residuals(
    trials: Sequence[Trial],
    arc_length_m: FloatArray,
    space: ParameterSpace,
    whiteners: Sequence[Whitener],
    solver: Solver,
    predicted: PredictedFrames | None = None,
) -> gauss_newton.Residuals:
    def nodes_m(trial: Trial, lanes: FloatArray) -> FloatArray:
        if predicted is not None and np.array_equal(lanes, predicted.lanes):
            return predicted.markers_m
        return predict(trial, [space.model(q) for q in lanes], arc_length_m, solver)

    def residuals(lanes: FloatArray) -> FloatArray:
        parts = [
            whitener(nodes_m(trial, lanes))
            for trial, whitener in zip(trials, whiteners, strict=True)
        ]
        return np.concatenate(parts, axis=1)

    return residuals


def _cold_start(
    trials: Sequence[Trial],
    arc_length_m: FloatArray,
    space: ParameterSpace,
    noise: Noise,
    options: FitOptions,
) -> FloatArray:
    """Best of a grid of uniform cables on the beginning of the first trial, then fitted to it.

    The noise is at least a hundredth of the cable's length.
    """
    beginning = [_window(trials[0], _FIRST_WINDOW_S)]
    rough = replace(noise, std_m=max(noise.std_m, 0.01 * space.cable.free_length_m))
    whiteners = whiteners_of(beginning, rough)
    residuals = _residuals(beginning, arc_length_m, space, whiteners, options.solver)
    weight = space.cable.loaded_density_kg_per_m * space.scale_m_per_s2
    row = np.geomspace(*_START_RANGE, options.starts) * weight
    starts = np.array([space.start(r * space.cable.free_length_m**3) for r in row])
    cost = np.sum(residuals(starts) ** 2, axis=1)
    if not np.isfinite(cost).any():
        raise FitError("no cable of any stiffness can be simulated on this motion")
    best = starts[int(np.nanargmin(np.where(np.isfinite(cost), cost, np.nan)))]
    problem = _problem(space, residuals)
    return gauss_newton.minimise(problem, best, MINIMISER).q


def _window(trial: Trial, duration_s: float) -> Trial:
    """The trial up to `duration_s` after something begins to move."""
    begins_s = moves_from_s(trial.grip) if trial.release_s is None else trial.release_s
    if not np.isfinite(begins_s):
        return trial
    t_s = trial.markers.t_s
    keep = slice(0, max(2, int(np.searchsorted(t_s, begins_s + duration_s))))
    return replace(trial, markers=Markers(t_s[keep], trial.markers.xy_m[keep]))


def _problem(
    space: ParameterSpace, residuals: gauss_newton.Residuals
) -> gauss_newton.LeastSquaresProblem:
    return gauss_newton.LeastSquaresProblem(
        residuals, space.mean, space.precision, space.step, space.low, space.high
    )
