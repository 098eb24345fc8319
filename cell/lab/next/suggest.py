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
from cell.lab.fit.heldout import predict_whole_cable
from cell.lab.next.asked import AskedEffect
from cell.lab.next.planned import planned_trials
from cell.lab.next.suggestion import TURN_RAD, Option, Stroke, Suggestion, strokes
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel
from cell.lab.verdict.conclusion import Examination
from cell.lab.verdict.doubts import check_model
from cell.settings.surroundings import Surroundings, Swept
from cell.study.data import Markers, Trial

#: χ² by which one candidate must beat the other to be believed; as `Rules.tie_delta_chi2`.
DECIDED = 9.0
#: A motion that decides no oftener than this is not suggested: cable and time are better spent.
NO_POWER = 0.05
#: Repetitions of a motion that are worth naming, at most.
MOST_REPEATED = 100
#: Motions that a line is asked for, one after another, at most; and how likely one must decide, to
#: be worth a cable.
MOST_ASKED, WORTH_ASKING_POWER = 2, 0.5
#: More candidates than these are not told apart by one motion.
MOST_CANDIDATES = 4
#: The cable is taken to be within so many standard deviations of its prediction.
SURELY = 3.0
#: Error of a prediction beyond its standard deviation: what the candidates lack, m.
MODEL_ERROR_M = 0.001
#: The cable is looked at this often at least, s, however slow the camera: between two looks it
#: turns back within a fifth of `MODEL_ERROR_M`.
LOOK_S = 1.0 / 60.0


def suggest_motion(examination: Examination, surroundings: Surroundings) -> Suggestion:
    """The safe motion at which the remaining candidates differ most, given their free parameters.

    Each candidate may move within what the trials so far leave uncertain of it; what then still
    separates their markers, in standard deviations squared, is the separation.
    raises  ValueError: nothing is left to tell apart, no motion keeps the limits, or none tells
    """
    fits = examination.fits
    open_to = [_rival(model) for model in rivals(examination)]
    found = distinguishing_motions(fits.prepared, open_to, surroundings, fits.progress)
    return worth_a_cable(found, fits.prepared)


def worth_a_cable(found: Suggestion, prepared: PreparedStudy) -> Suggestion:
    """The suggestion, if a motion is likely to decide.  Raises ValueError with a remedy."""
    if max(option.power for option in found.options) < NO_POWER:
        raise ValueError(_what_would_help(found, prepared))
    return found


def worth_measuring(suggestion: Suggestion) -> Option | None:
    """The motion to request from a line; None = no motion is likely to decide."""
    best = suggestion.options[0]
    return best if best.power >= WORTH_ASKING_POWER else None


def _what_would_help(found: Suggestion, prepared: PreparedStudy) -> str:
    """That no motion tells the candidates apart, how far the best is from it, and what helps.

    Separation grows with the number of repetitions, and with the inverse square of the noise.
    """
    best = found.options[0]
    lacking = DECIDED / max(best.separation, 1e-12)
    noise_mm = prepared.noise.std_m * 1e3
    helps = []
    if lacking <= MOST_REPEATED:
        helps.append(f"the best one {counted(int(np.ceil(lacking)), 'time')} over, each as a trial")
    if lacking <= MOST_REPEATED**2:
        helps.append(f"noise of {noise_mm / np.sqrt(lacking):.2g} mm instead of {noise_mm:.2g} mm")
    if refused := sum(found.refused.values()):
        wider = ", ".join(f"{count} for the {why}" for why, count in found.refused.items())
        helps.append(
            f"room for the {counted(refused, 'motion that was', 'motions that were')} "
            f"refused, {wider}"
        )
    helps.append(
        "measuring what sets them apart in another way (weigh the cable, look at the jaws)"
    )
    first, *others = found.candidates
    return (
        f"study {prepared.study.name}: no safe motion tells {first} from {' or '.join(others)}; "
        f"the best, {best.motion.describe()}, decides with probability {best.power:.2f} "
        f"(separation χ² {best.separation:.2g}, {DECIDED:g} are needed). "
        f"What would help: {'; '.join(helps)}"
    )


def distinguishing_motions(
    prepared: PreparedStudy,
    open_to: Sequence[Rival],
    surroundings: Surroundings,
    progress: Progress = no_progress,
) -> Suggestion:
    """The safe motions at which these models differ most, given their free parameters.

    Interrupted, it has the best of those that were looked at.

    prepared  noise and markers of what will be measured
    raises    ValueError: no motion keeps the limits; KeyboardInterrupt: before there was one
    """
    models = [c.model for c in open_to]
    options, refused = [], Counter[str]()
    rest: dict[float, float] = {}
    offered = strokes(surroundings)
    try:
        for done, stroke in enumerate(offered):
            progress("looking for a motion", done, len(offered))
            angle = stroke.angle_rad
            if angle not in rest:
                rest[angle] = _rest_low_m(prepared, models, surroundings, angle)
            option = _weighed(prepared, open_to, stroke, surroundings, rest[angle])
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
    names = tuple(c.name for c in open_to)
    return Suggestion(names, tuple(options), surroundings, dict(refused))


def rivals(examination: Examination) -> list[FittedModel]:
    """The likeliest set of effects, and those that the trials cannot distinguish from it.

    If it has no equal, the next likeliest that is not the same with more: one, or several where
    nothing could be confirmed on held-out trials.
    raises  ValueError: there is nothing to tell apart
    """
    diagnosis, fits, final = examination.diagnosis, examination.fits, examination.path[-1]
    if diagnosis.verdict == "complete":
        raise ValueError(
            f"study {fits.prepared.study.name}: the model explains these trials to their "
            "noise, use it as it is; nothing to tell apart"
        )
    known = {c.names: c for c in (*fits.known(), *examination.singles, *examination.path)}
    tied = [
        known[names]
        for found in diagnosis.missing
        for other in found.tied_with
        if (names := final.names - {found.effect} | {other}) in known
    ]
    if tied:
        return [final, *tied[: MOST_CANDIDATES - 1]]
    best = sorted(known.values(), key=lambda c: -c.evidence)
    if diagnosis.missing:
        best = [final, *(c for c in best if not c.names >= final.names)]
    if len(best) < 2:
        raise ValueError(
            f"study {fits.prepared.study.name}: there is only one candidate, give more with "
            "--try; nothing to tell apart"
        )
    return best[: MOST_CANDIDATES if diagnosis.verdict == "cannot_tell" else 2]


def _weighed(
    prepared: PreparedStudy,
    candidates: Sequence[Rival],
    stroke: Stroke,
    surroundings: Surroundings,
    rest_low_m: float,
) -> Option | str:
    """A stroke from where it is safe, and what it tells; or what it is refused for."""
    # The likeliest cable shows quickly where the stroke could begin, if anywhere.
    known, trial = _trial(prepared, stroke, surroundings)
    (shown,), cable = _looked_at(known, trial, [candidates[0].model])
    start = _start(stroke, cable, np.zeros_like(cable), surroundings, rest_low_m)
    if isinstance(start, str):
        return start
    whitener = whitener_of_planned(known, trial, shown)
    trial = replace(trial, grip=start.motion())
    views, cables, spreads = [], [], []
    for candidate in candidates:
        view, cable, spread = _open(known, candidate, trial, whitener)
        views.append(view)
        cables.append(cable)
        spreads.append(SURELY * spread + MODEL_ERROR_M)
    if not all(np.isfinite(v).all() for view in views for v in view):
        return "simulation"
    sure = _start(start, np.stack(cables), np.stack(spreads), surroundings, rest_low_m)
    if isinstance(sure, str):
        return sure
    apart = [_separation(views[0], other) for other in views[1:]]
    missed = [normal_cdf((DECIDED - s) / (2.0 * np.sqrt(max(s, 1e-12)))) for s in apart]
    hardest = int(np.argmin(apart))
    return Option(
        sure, apart[hardest], candidates[1 + hardest].name, float(max(0.0, 1.0 - sum(missed)))
    )


def _start(
    stroke: Stroke,
    cable_m: FloatArray,
    spread_m: FloatArray,
    surroundings: Surroundings,
    rest_low_m: float,
) -> Stroke | str:
    """The stroke from the place nearest to home at which all of it is safe; or what forbids it.

    cable_m, spread_m  (models, times, points, 2) of the cable, and by which it may be elsewhere
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
            rest_m = predict_whole_cable(prepared, trial, [model])[1][..., 0]
            if not np.isfinite(rest_m).all():  # where it rests is not known: as far as it reaches
                return -prepared.study.cable.length_m
            low = min(low, float(rest_m.min()))
    return low - MODEL_ERROR_M


def _trial(
    prepared: PreparedStudy, stroke: Stroke, surroundings: Surroundings
) -> tuple[PreparedStudy, Trial]:
    """A stroke as a trial that is not recorded yet, and the study that knows of it."""
    rate_hz = surroundings.frame_rate_hz
    frame_s = None if rate_hz is None else 1.0 / rate_hz
    known, (trial,) = planned_trials(prepared, [("stroke", stroke.motion())], frame_s)
    return known, trial


def _looked_at(
    prepared: PreparedStudy, trial: Trial, models: Sequence[CableModel]
) -> tuple[FloatArray, FloatArray]:
    """What models show in the trial's frames, and their cables, as often as is safe.

    returns  (models, times, markers, 2) and (models, more times, points, 2), m
    """
    shown, cable = predict_whole_cable(prepared, trial, models)
    t_s, hand_s = trial.markers.t_s, trial.grip.t_s
    if np.diff(t_s).max(initial=0.0) <= LOOK_S * (1.0 + 1e-9):
        return shown, cable
    count = int(np.ceil((hand_s[-1] - hand_s[0]) / LOOK_S)) + 1
    often_s = np.union1d(t_s, np.linspace(hand_s[0], hand_s[-1], count))
    blank = Markers(often_s, np.zeros((len(often_s), len(prepared.study.arc_length_m), 2)))
    often = replace(trial, markers=blank, row_means=None)
    return shown, predict_whole_cable(prepared, often, models)[1]


def whitener_of_planned(prepared: PreparedStudy, trial: Trial, shown_m: FloatArray) -> Whitener:
    """The whitener of a trial that is not recorded yet.

    shown_m  (times, points, 2) what it will show by and large: where arc lengths move the markers,
             and what a gain changes of a wrench
    """
    xy_m = np.where(np.isfinite(trial.markers.xy_m), shown_m, np.nan)
    shown = replace(trial, markers=replace(trial.markers, xy_m=xy_m))
    study = replace(prepared.study, trials=(shown,))
    return whiteners_of(study, prepared.noise, prepared.gauges)[trial.name]


def _open(
    prepared: PreparedStudy, candidate: Rival, trial: Trial, whitener: Whitener
) -> tuple[tuple[FloatArray, FloatArray], FloatArray, FloatArray]:
    """What a candidate predicts, and how far the trials so far leave that open.

    returns  (whitened markers and wrench (rows,), their open directions (rows, parameters)); the
             cable and its standard deviation, (times, points, 2), m
    """
    space, q = candidate.space, candidate.q
    step = space.difference_steps(q, candidate.covariance)
    lanes = [space.model(row) for row in difference_points(q, step)]
    markers, cable = _looked_at(prepared, trial, lanes)
    root = covariance_root(candidate.covariance)
    rows = whitener(markers)
    open_rows = ((rows[1:] - rows[0]).T / step) @ root
    moves = np.tensordot(root.T / step, cable[1:] - cable[0], axes=1)
    return (rows[0], open_rows), cable[0], np.sqrt(np.sum(moves**2, axis=0))


def _separation(
    first: tuple[FloatArray, FloatArray], second: tuple[FloatArray, FloatArray]
) -> float:
    """χ² between two candidates that neither's open directions can remove."""
    return marginal_chi2(first[0] - second[0], np.hstack([first[1], second[1]]))[0]


def _rival(model: FittedModel) -> Rival:
    name = " + ".join(e.name for e in model.effects) or "baseline"
    return Rival(name, model.fit.space, model.fit.q, model.fit.covariance)


def split_effects(effects: Sequence[str]) -> tuple[list[str], list[str]]:
    """Effects to design a motion for, and files of effects to try with the library.

    effects  NAME, NAME=SIZE, file.py=SIZE: of the first kind; file.py: of the second
    raises   ValueError: both kinds are given
    """
    tried = [given for given in effects if given.endswith(".py")]
    asked = [given for given in effects if not given.endswith(".py")]
    if asked and tried:
        raise ValueError(
            f"--try {tried[0]}: is tried with the library, but {asked[0]} asks for a motion "
            f"that shows it; give {tried[0]}=SIZE for a motion that shows both, or leave one out"
        )
    return asked, tried


def showing_motion(
    fits: FitCache, asked: Sequence[AskedEffect], surroundings: Surroundings
) -> Suggestion:
    """The safe motion with the largest change by these effects that the model cannot imitate.

    An effect of which no size is given has its typical one.
    raises  ValueError: the study cannot be fitted, no motion keeps the limits, or none shows them
    """
    base = fits.base
    check_model(fits)
    without = _rival(base)
    models = [without, *(_with(without, one) for one in asked)]
    found = distinguishing_motions(fits.prepared, models, surroundings, fits.progress)
    return worth_a_cable(found, fits.prepared)


def _with(rival: Rival, asked: AskedEffect) -> Rival:
    """The same with an effect whose size is known, so that only the cable's parameters are open."""
    parameter = asked.parameter
    size = asked.typical if asked.size is None else asked.size
    name = f"{asked.effect.name} ({parameter.name} {size:.3g}{after_number(parameter.unit)})"
    names = (f"{asked.effect.name}.{p.name}" for p in asked.effect.parameters)
    held = tuple(zip(names, asked.at(size).values, strict=True))
    effects, exact = (*rival.space.effects, asked.effect), (*rival.space.exact, *held)
    return replace(rival, name=name, space=replace(rival.space, effects=effects, exact=exact))
