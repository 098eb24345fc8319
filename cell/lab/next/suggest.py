"""The safe motion that best distinguishes the remaining candidates (T-optimal design).

Source: Atkinson & Fedorov, The design of experiments for discriminating between two rival models,
Biometrika 62 (1975) 57.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtr as normal_cdf

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import after_number
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.files.words import counted
from cell.identify.gaussian import covariance_root, marginal_chi2
from cell.identify.parameters import difference_points
from cell.identify.whitener import Whitener
from cell.lab.data.prepared import PreparedStudy, whiteners_of
from cell.lab.data.work import Progress, no_progress
from cell.lab.fit.fitting import Rival
from cell.lab.fit.heldout import predict_cable
from cell.lab.next.effect_query import EffectQuery
from cell.lab.next.motion_file import TURN_RAD, Option, Stroke, Suggestion, strokes
from cell.lab.next.simulated import planned_trials
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel
from cell.lab.verdict.conclusion import Examination
from cell.lab.verdict.doubts import check_model
from cell.settings.surroundings import Surroundings, Swept
from cell.study.data import Markers, Trial

#: χ² difference that decides between two candidates; as `Rules.tie_delta_chi2`.
DECIDED = 9.0
#: A motion with at most this power is not suggested.
NO_POWER = 0.05
#: Most repetitions of a motion that are proposed.
MOST_REPEATED = 100
#: Most motions requested from a line, one after another; smallest power of a motion that is worth a
#: cable.
MOST_REQUESTED, WORTH_REQUESTING_POWER = 2, 0.5
#: Most candidates that one motion can distinguish.
MOST_CANDIDATES = 4
#: Safety margin about the predicted cable, in standard deviations.
SURELY = 3.0
#: Error of a prediction by effects that all candidates lack, m.
MODEL_ERROR_M = 0.001
#: Largest time step of the safety check, s, independent of the camera's frame rate: between two
#: samples the cable may turn back by a fifth of `MODEL_ERROR_M`.
SAFETY_STEP_S = 1.0 / 60.0


def suggest_motion(examination: Examination, surroundings: Surroundings) -> Suggestion:
    """The safe motion at which the remaining candidates differ most, given their free parameters.

    The separation is the χ² between the candidates' markers after each has been adapted within the
    covariance of its parameters from the trials so far.
    raises  ValueError: a single candidate, no motion within the limits, or none that distinguishes
    """
    fits = examination.fits
    candidates = [_rival(model) for model in rivals(examination)]
    suggestion = distinguishing_motions(fits.prepared, candidates, surroundings, fits.progress)
    diagnosis = examination.diagnosis
    separated = diagnosis.verdict == "missing" and not any(e.tied_with for e in diagnosis.missing)
    return worth_a_cable(replace(suggestion, separated=separated), fits.prepared)


def worth_a_cable(suggestion: Suggestion, prepared: PreparedStudy) -> Suggestion:
    """The suggestion, if a motion is likely to decide.  Raises ValueError with a remedy."""
    if max(option.power for option in suggestion.options) < NO_POWER:
        raise ValueError(_no_motion_text(suggestion, prepared))
    return suggestion


def worth_measuring(suggestion: Suggestion) -> Option | None:
    """The motion to request from a line; None = no motion is likely to decide."""
    best = suggestion.options[0]
    return best if best.power >= WORTH_REQUESTING_POWER else None


def _no_motion_text(suggestion: Suggestion, prepared: PreparedStudy) -> str:
    """Error text: no motion distinguishes the candidates; separation of the best, and remedies.

    Separation grows with the number of repetitions, and with the inverse square of the noise.
    """
    best = suggestion.options[0]
    times = DECIDED / max(best.separation, 1e-12)
    noise_mm = prepared.noise.std_m * 1e3
    helps = []
    if times <= MOST_REPEATED:
        helps.append(f"the best one {counted(int(np.ceil(times)), 'time')} over, each as a trial")
    if times <= MOST_REPEATED**2:
        helps.append(f"noise of {noise_mm / np.sqrt(times):.2g} mm instead of {noise_mm:.2g} mm")
    if refused := sum(suggestion.refused.values()):
        reasons = ", ".join(f"{count} for the {why}" for why, count in suggestion.refused.items())
        helps.append(
            f"room for the {counted(refused, 'motion that was', 'motions that were')} "
            f"refused, {reasons}"
        )
    helps.append(
        "measuring what sets them apart in another way (weigh the cable, look at the jaws)"
    )
    first, *rivals = suggestion.candidates
    already = f"{suggestion.separated_text()}. " if suggestion.separated else ""
    return (
        f"{already}study {prepared.study.name}: no safe motion tells {first} from "
        f"{' or '.join(rivals)}; the best, {best.motion.describe()}, decides "
        f"with probability {best.power:.2f} (separation χ² {best.separation:.2g}, {DECIDED:g} are "
        f"needed). What would help: {'; '.join(helps)}"
    )


def distinguishing_motions(
    prepared: PreparedStudy,
    candidates: Sequence[Rival],
    surroundings: Surroundings,
    progress: Progress = no_progress,
) -> Suggestion:
    """The safe motions at which these models differ most, given their free parameters.

    If interrupted, the best of those evaluated so far.

    prepared  noise and markers of the planned measurement
    raises    ValueError: no motion keeps the limits; KeyboardInterrupt: before there was one
    """
    models = [c.model for c in candidates]
    options, refused = [], Counter[str]()
    rest_low_m: dict[float, float] = {}
    tried = strokes(surroundings)
    try:
        for done, stroke in enumerate(tried):
            progress("looking for a motion", done, len(tried))
            angle = stroke.angle_rad
            if angle not in rest_low_m:
                rest_low_m[angle] = _rest_low_m(prepared, models, surroundings, angle)
            option = _evaluated(prepared, candidates, stroke, surroundings, rest_low_m[angle])
            if isinstance(option, str):
                refused[option] += 1
            else:
                options.append(option)
    except KeyboardInterrupt:
        if not options:
            raise
    if not options:
        why = ", ".join(f"{count} for the {reason}" for reason, count in refused.items())
        raise ValueError(
            f"none of {sum(refused.values())} motions is safe in this cell: refused {why}; "
            "widen limits, or let the camera see more"
        )
    options.sort(key=lambda o: -o.separation)
    names = tuple(c.name for c in candidates)
    return Suggestion(names, tuple(options), surroundings, dict(refused))


def rivals(examination: Examination) -> list[FittedModel]:
    """The likeliest set of effects, and those that the trials cannot distinguish from it.

    Without ties, the next likeliest that is not an extension of it: one, or several if nothing was
    confirmed on held-out trials.
    raises  ValueError: there is nothing to distinguish
    """
    diagnosis, fits, final = examination.diagnosis, examination.fits, examination.path[-1]
    if diagnosis.verdict == "complete":
        raise ValueError(
            f"study {fits.prepared.study.name}: the model explains these trials to their "
            "noise, use it as it is; nothing to tell apart"
        )
    fitted = {c.names: c for c in (*fits.known(), *examination.singles, *examination.path)}
    tied = [
        fitted[names]
        for effect in diagnosis.missing
        for rival in effect.tied_with
        if (names := final.names - {effect.effect} | {rival}) in fitted
    ]
    if tied:
        return [final, *tied[: MOST_CANDIDATES - 1]]
    best = sorted(fitted.values(), key=lambda c: -c.evidence)
    if diagnosis.missing:
        best = [final, *(c for c in best if not c.names >= final.names)]
    if len(best) < 2:
        raise ValueError(
            f"study {fits.prepared.study.name}: there is only one candidate, give more with "
            "--try; nothing to tell apart"
        )
    return best[: MOST_CANDIDATES if diagnosis.verdict == "cannot_tell" else 2]


def _evaluated(
    prepared: PreparedStudy,
    candidates: Sequence[Rival],
    stroke: Stroke,
    surroundings: Surroundings,
    rest_low_m: float,
) -> Option | str:
    """A stroke from a safe start with its separation and power; or the reason of its refusal."""
    # The likeliest cable gives a first start quickly, if there is any.
    rate_hz = surroundings.frame_rate_hz
    frame_s = None if rate_hz is None else 1.0 / rate_hz
    planned, (trial,) = planned_trials(prepared, [("stroke", stroke.motion())], frame_s)
    (predicted,), cable = _predicted(planned, trial, [candidates[0].model])
    start = _start(stroke, cable, np.zeros_like(cable), surroundings, rest_low_m)
    if isinstance(start, str):
        return start
    whitener = whitener_of_planned(planned, trial, predicted)
    trial = replace(trial, grip=start.motion())
    predictions, cables, spreads = [], [], []
    for candidate in candidates:
        prediction, cable, spread = _prediction_of(planned, candidate, trial, whitener)
        predictions.append(prediction)
        cables.append(cable)
        spreads.append(SURELY * spread + MODEL_ERROR_M)
    if not all(np.isfinite(v).all() for prediction in predictions for v in prediction):
        return "simulation"
    safe = _start(start, np.stack(cables), np.stack(spreads), surroundings, rest_low_m)
    if isinstance(safe, str):
        return safe
    chi2 = [_separation(predictions[0], other) for other in predictions[1:]]
    errors = [normal_cdf((DECIDED - s) / (2.0 * np.sqrt(max(s, 1e-12)))) for s in chi2]
    hardest = int(np.argmin(chi2))
    return Option(
        safe, chi2[hardest], candidates[1 + hardest].name, float(max(0.0, 1.0 - sum(errors)))
    )


def _start(
    stroke: Stroke,
    cable_m: FloatArray,
    spread_m: FloatArray,
    surroundings: Surroundings,
    rest_low_m: float,
) -> Stroke | str:
    """The stroke from the safe start nearest to home; or the limit that forbids it.

    cable_m, spread_m  (models, times, points, 2) of the cable, and its uncertainty
    """
    if not np.isfinite(cable_m).all():
        return "simulation"
    begin = np.array([stroke.x_m, stroke.y_m])
    ends = np.array([[0.0, 0.0], [stroke.dx_m, stroke.dy_m]])
    swept = Swept.of(cable_m - begin, spread_m, ends, stroke.angle_rad, rest_low_m)
    place = surroundings.nearest_start(swept, (stroke.dx_m, stroke.dy_m))
    if isinstance(place, str):
        return place
    return Stroke(stroke.angle_rad, stroke.dx_m, stroke.dy_m, stroke.duration_s, *place)


def _rest_low_m(
    prepared: PreparedStudy,
    models: Sequence[CableModel],
    surroundings: Surroundings,
    angle_rad: float,
) -> float:
    """Least x of the resting cable from the gripper, turned from home's angle to another, m."""
    home = surroundings.home[2]
    steps = 2 + int(abs(angle_rad - home) / TURN_RAD)
    low = 0.0
    for angle in np.linspace(home, angle_rad, steps):
        t_s = np.array([0.0, 0.05, 0.1])
        motion = Motion(t_s, 0 * t_s, 0 * t_s, np.full(3, angle))
        blank = Markers(t_s, np.zeros((len(t_s), len(prepared.study.arc_length_m), 2)))
        trial = Trial("rest", "validate", "equilibrium", motion, blank)
        for model in models:
            rest_m = predict_cable(prepared, trial, [model])[1][..., 0]
            if not np.isfinite(rest_m).all():  # unknown: its full length
                return -prepared.study.cable.length_m
            low = min(low, float(rest_m.min()))
    return low - MODEL_ERROR_M


def _predicted(
    prepared: PreparedStudy, trial: Trial, models: Sequence[CableModel]
) -> tuple[FloatArray, FloatArray]:
    """Predicted markers in the trial's frames, and cables at the times of the safety check.

    returns  (models, times, markers, 2) and (models, more times, points, 2), m
    """
    markers, cable = predict_cable(prepared, trial, models)
    t_s, grip_s = trial.markers.t_s, trial.grip.t_s
    if np.diff(t_s).max(initial=0.0) <= SAFETY_STEP_S * (1.0 + 1e-9):
        return markers, cable
    count = int(np.ceil((grip_s[-1] - grip_s[0]) / SAFETY_STEP_S)) + 1
    check_s = np.union1d(t_s, np.linspace(grip_s[0], grip_s[-1], count))
    blank = Markers(check_s, np.zeros((len(check_s), len(prepared.study.arc_length_m), 2)))
    checked = replace(trial, markers=blank, row_means=None)
    return markers, predict_cable(prepared, checked, models)[1]


def whitener_of_planned(prepared: PreparedStudy, trial: Trial, expected_m: FloatArray) -> Whitener:
    """The whitener of a planned trial.

    expected_m  (times, points, 2) approximate positions, for uncertain arc lengths of markers and
                the gain of a wrench
    """
    xy_m = np.where(np.isfinite(trial.markers.xy_m), expected_m, np.nan)
    expected = replace(trial, markers=replace(trial.markers, xy_m=xy_m))
    study = replace(prepared.study, trials=(expected,))
    return whiteners_of(study, prepared.noise, prepared.gauges)[trial.name]


def _prediction_of(
    prepared: PreparedStudy, candidate: Rival, trial: Trial, whitener: Whitener
) -> tuple[tuple[FloatArray, FloatArray], FloatArray, FloatArray]:
    """Prediction of a candidate, and its uncertainty given the trials so far.

    returns  (whitened markers and wrench (rows,), root of covariance (rows, parameters)); the
             cable and its standard deviation, (times, points, 2), m
    """
    space, q = candidate.space, candidate.q
    step = space.difference_steps(q, candidate.covariance)
    lanes = [space.model(row) for row in difference_points(q, step)]
    markers, cable = _predicted(prepared, trial, lanes)
    root = covariance_root(candidate.covariance)
    rows = whitener(markers)
    uncertain = ((rows[1:] - rows[0]).T / step) @ root
    moves = np.tensordot(root.T / step, cable[1:] - cable[0], axes=1)
    return (rows[0], uncertain), cable[0], np.sqrt(np.sum(moves**2, axis=0))


def _separation(
    first: tuple[FloatArray, FloatArray], second: tuple[FloatArray, FloatArray]
) -> float:
    """χ² between the predictions of two candidates, given their uncertainties."""
    return marginal_chi2(first[0] - second[0], np.hstack([first[1], second[1]]))[0]


def _rival(model: FittedModel) -> Rival:
    name = " + ".join(e.name for e in model.effects) or "baseline"
    return Rival(name, model.fit.space, model.fit.q, model.fit.covariance)


def split_effects(effects: Sequence[str]) -> tuple[list[str], list[str]]:
    """Effects to design a motion for, and files of effects to try with the library.

    effects  NAME, NAME=SIZE, file.py=SIZE: of the first kind; file.py: of the second
    raises   ValueError: effects of both kinds
    """
    tried = [effect for effect in effects if effect.endswith(".py")]
    queried = [effect for effect in effects if not effect.endswith(".py")]
    if queried and tried:
        raise ValueError(
            f"--try {tried[0]}: is tried with the library, but {queried[0]} asks for a motion "
            f"that shows it; give {tried[0]}=SIZE for a motion that shows both, or leave one out"
        )
    return queried, tried


def showing_motion(
    fits: FitCache, queries: Sequence[EffectQuery], surroundings: Surroundings
) -> Suggestion:
    """The safe motion with the largest change by these effects that the model cannot imitate.

    An effect without a size has its typical one.
    raises  ValueError: the study cannot be fitted, no motion within the limits, or none shows them
    """
    base = fits.base
    check_model(fits)
    without = _rival(base)
    models = [without, *(_with(without, query) for query in queries)]
    suggestion = distinguishing_motions(fits.prepared, models, surroundings, fits.progress)
    return worth_a_cable(suggestion, fits.prepared)


def _with(rival: Rival, query: EffectQuery) -> Rival:
    """The rival with an effect of known size: only the cable's parameters are uncertain."""
    parameter = query.parameter
    size = query.typical if query.size is None else query.size
    name = f"{query.effect.name} ({parameter.name} {size:.3g}{after_number(parameter.unit)})"
    names = (f"{query.effect.name}.{p.name}" for p in query.effect.parameters)
    held = tuple(zip(names, query.at(size).values, strict=True))
    effects, exact = (*rival.space.effects, query.effect), (*rival.space.exact, *held)
    return replace(rival, name=name, space=replace(rival.space, effects=effects, exact=exact))
