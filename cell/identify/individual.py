"""Identification of one cable from its filmed hold: an accepted model, or a rejection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.cable.geometry import GRAVITY_M_PER_S2, Cable, Motion, moves_from_s
from cell.identify.fit import FitError, FitOptions, fit, still_noise
from cell.identify.gripper_errors import GripperLogErrors, align_motion
from cell.identify.identified import Identified
from cell.identify.model_class import ModelClass
from cell.identify.paper import fit_as_paper
from cell.identify.predicted_frames import PredictedFrames, simulate_frames
from cell.study.data import Markers, Trial

#: Least share of the swing's frames in which the cable is detected, and least range of the tip's
#: motion relative to the gripper, m, of a cable that is to be identified.
MIN_DETECTED, LEAST_SWING_M = 0.7, 0.002


class Reason(StrEnum):
    """Reasons for the rejection of a cable."""

    UNSEEN_FRAMES = "unseen_frames"
    LITTLE_SWING = "little_swing"
    NO_STILL_FRAMES = "no_still_frames"
    NO_FIT = "no_fit"


class CableRejectedError(Exception):
    """A cable that cannot be identified.  Scenario: the camera lost it during the swing."""

    def __init__(self, reason: Reason, detail: str) -> None:
        super().__init__(f"{reason.value.replace('_', ' ')}: {detail}")
        self.reason = reason


@dataclass(frozen=True)
class IdentifyOptions:
    """Options of identification.

    kind          what all cables have in common
    bias_m        constant error across the cable of every node: vision's and the mesh's
    """

    method: Literal["map", "paper"] = "map"
    kind: ModelClass = ModelClass()  # noqa: RUF009
    fit: FitOptions = FitOptions(gripper_errors=GripperLogErrors(offset_m=2e-6, offset_rad=2e-5))  # noqa: RUF009

    bias_m: float = 6e-6


def with_effects(options: IdentifyOptions, effects: Sequence[type[Effect]]) -> IdentifyOptions:
    """The options with further effects in the model.

    raises  ValueError: an effect is in it already, or the method knows none
    """
    if not effects:
        return options
    if options.method == "paper":
        raise ValueError("--with: the paper's method knows no effects; leave it out")
    there = {e.name for e in options.kind.effects}
    for effect in effects:
        if effect.name in there:
            raise ValueError(f"--with: {effect.name} is in the settings' model already")
    kind = replace(options.kind, effects=(*options.kind.effects, *effects))
    return replace(options, kind=kind)


def hold_trial(
    grip: Motion,
    t_s: FloatArray,
    nodes_m: FloatArray,
    grip_m: FloatArray,
    clamp_angle_rad: FloatArray,
) -> Trial:
    """A filmed hold as a trial, with the logged motion shifted to the detected jaw.

    grip             logged motion of the gripper, on the camera's clock
    t_s              (T,) times of the frames, s
    nodes_m          (T, nodes, 2), tip first, m; nan where unseen
    grip_m, clamp_angle_rad   (T, 2), (T,) of the jaw in the frames; nan where not detected
    """
    motion = align_motion(grip, t_s, grip_m, clamp_angle_rad)
    return Trial("identify", "fit", "equilibrium", motion, Markers(t_s, nodes_m))


def identify(
    trial: Trial,
    arc_length_m: FloatArray,
    cable: Cable,
    *,
    gravity_m_per_s2: tuple[float, float] = GRAVITY_M_PER_S2,
    pull_m_per_s2: float | None = None,
    previous: Identified | None = None,
    predicted: PredictedFrames | None = None,
    options: IdentifyOptions = IdentifyOptions(),
) -> Identified:
    """Parameters of the cable in `trial`.

    While a hold is still being filmed, call this with the frames so far; pass the result as
    `previous` to the next call, which then needs one or two passes instead of a search, and
    simulates nothing if `predict_frames` has done so.

    pull_m_per_s2  in place of gravity where that is weak, see `ParameterSpace`
    raises  CableRejectedError
    """
    _accept_frames(trial)
    # the node at the gripping point belongs to the jaw, not to the cable
    hangs = arc_length_m > 0.0
    markers = Markers(trial.markers.t_s, trial.markers.xy_m[:, hangs])
    free = replace(trial, markers=markers)
    try:
        noise = still_noise([free], bias_m=options.bias_m, across_only=True)
    except FitError as error:
        raise CableRejectedError(Reason.NO_STILL_FRAMES, str(error)) from error
    try:
        if options.method == "paper":
            return fit_as_paper(
                trial,
                arc_length_m,
                cable,
                gravity_m_per_s2,
                noise=noise,
                options=options.fit,
            )
        return fit(
            [free],
            arc_length_m[hangs],
            options.kind.space(cable, gravity_m_per_s2, pull_m_per_s2),
            noise=noise,
            previous=previous,
            predicted=predicted,
            options=options.fit,
        )
    except FitError as error:
        raise CableRejectedError(Reason.NO_FIT, str(error)) from error


def predict_frames(
    trial: Trial,
    t_s: FloatArray,
    arc_length_m: FloatArray,
    identified: Identified,
    options: IdentifyOptions = IdentifyOptions(),
) -> PredictedFrames:
    """Predicted frames of a hold, which `identify` uses when the last frame has arrived.

    trial       the frames filmed so far, from which `identified` was estimated
    t_s         (T,) of all frames, those to come included
    raises      as the engine
    """
    return simulate_frames(
        trial,
        t_s,
        arc_length_m[arc_length_m > 0.0],
        identified.space,
        identified.mean,
        solver=options.fit.solver,
        hand=options.fit.gripper_errors,
    )


def _accept_frames(trial: Trial) -> None:
    """Raise CableRejectedError: the cable is hidden, or it hardly swings.

    The model's misfit is no condition: it widens the forecast, and the probability of passing
    decides.
    """
    after = trial.markers.t_s >= moves_from_s(trial.grip)
    detected = np.asarray(np.isfinite(trial.markers.xy_m).all(axis=(1, 2)), dtype=np.bool_)
    moving = int(after.sum())
    share = float(detected[after].mean()) if moving else 0.0
    if share < MIN_DETECTED:
        raise CableRejectedError(
            Reason.UNSEEN_FRAMES,
            f"the cable is seen in {int(detected[after].sum())} of {moving} frames of the swing "
            f"({share:.0%}), needs {MIN_DETECTED:.0%}",
        )
    tip = trial.markers.xy_m[after & detected, 0]
    t_s = trial.markers.t_s[after & detected]
    places = trial.grip.x_m, trial.grip.y_m
    grip = np.column_stack([np.interp(t_s, trial.grip.t_s, v) for v in places])
    swing_m = float(np.ptp(tip - grip, axis=0).max())
    if swing_m < LEAST_SWING_M:
        raise CableRejectedError(
            Reason.LITTLE_SWING,
            f"the tip swings by {swing_m * 1e3:.2f} mm, needs {LEAST_SWING_M * 1e3:.2f}",
        )
