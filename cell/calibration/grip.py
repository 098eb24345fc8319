"""Grip calibration: how the jaws hold a cable, from pictures of it at rest in several poses."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from itertools import product

import numpy as np

from calib.cable_line import measure_line
from calib.errors import MisfitError, TooFewError
from calib.grip import LEAST_POSES, GripFit, GripView, fit_grip
from calib.plane import PlaneView
from calib.store import StoredCalibration
from cell.calibration.assistants import Assistant
from cell.calibration.measure import Say, within_limits
from cell.calibration.raw import NamedImage, ShownCell, ShownPose
from cell.calibration.session import CalibrationSession, RestingView
from cell.settings import Settings
from cell.settings.calibrated import devices_of
from cell.settings.translate import vision_of
from cell.vision.detect import VisionOptions, detect
from drivers.interfaces import Pose

#: Number of clamp angles with a cable, their range, rad, and largest relative error of the stated
#: length.
_CABLE_TURNS, _TURN_RAD, _ROUGHLY = 4, 0.6, 0.2
#: Largest motion of a node at rest between two pictures, m; most pictures; s between them.
_CALM_M, _PICTURES, _BETWEEN_S = 4e-5, 40, 0.2
#: Remedies by the reason why the cable is not detected in a picture.
_REMEDIES = {
    "no_jaw": "light the jaw's marks, and see that they are in the picture",
    "no_cable": "grip a cable, light it, focus; check vision.cable_is and vision.min_contrast",
    "two_cables": "take the second cable, or what looks like one, out of the picture",
    "leaves_picture": "narrow `limits`, or let the camera see more",
    "wrong_length": "see that nothing hides the cable; correct cable.free_length_m to 20 %",
    "saturated": "shorten the exposure",
    "empty": "take the lens cap off, lengthen the exposure",
}


def show_cable(
    session: CalibrationSession, assistant: Assistant, view: PlaneView, say: Say
) -> ShownCell | None:
    """A cable gripped as in a cycle, at rest in poses of the gripper, then released at home.

    returns  None = there is no cable
    raises   TooFewError: the picture is too small; MisfitError: it does not rest; DeviceError
    """
    goals = grip_poses(session.settings, view)
    session.go_to(session.home)
    if not assistant.cable():
        return None
    poses: list[ShownPose] = []
    with session.holding_cable():
        assistant.clear()  # whoever held the cable has their hands between the jaws
        for number, goal in enumerate(goals, 1):
            rest = _at_rest(session, goal, view)
            picture = NamedImage(f"grip_{number:02d}.png", rest.image)
            poses.append(ShownPose("fit", rest.pose, picture))
            say(f"pose {number}", number, len(goals))
        session.go_to(session.home)
    return ShownCell(tuple(poses))


def grip_poses(settings: Settings, view: PlaneView) -> list[Pose]:
    """Poses in which a cable is shown: the steepest within limits, where gravity bends it least.

    raises  TooFewError: too few of them are in the picture
    """
    low, high = within_limits(settings, most_rad=1.0)
    motion, home = settings.motion, settings.motion.home
    turns = np.linspace(max(low[2], high[2] - _TURN_RAD), high[2], _CABLE_TURNS)
    down, left = 0.5 * motion.lower_m, 0.5 * motion.advance_m
    places = np.array([[0.0, 0.0], [0.0, -1.0], [-1.0, -0.4]]) * [left, down]
    size = np.array([settings.camera.width_px, settings.camera.height_px])
    goals = []
    for (x, y), turn in product(places + np.array([home.x_m, home.y_m]), turns):
        x, y = np.clip([x, y], low[:2], high[:2])
        ahead = -settings.cable.free_length_m * np.array([[np.cos(turn), np.sin(turn)], [0.0, 1.0]])
        ends = view.to_pixels(np.concatenate([[[0.0, 0.0]], ahead]) + np.array([x, y]))
        if np.all((ends > 0.02 * size) & (ends < 0.98 * size)):
            goals.append(Pose(float(x), float(y), float(turn)))
    if len(goals) < LEAST_POSES:
        raise TooFewError(
            f"a cable is wholly in the picture in {len(goals)} of {_CABLE_TURNS * len(places)} "
            f"poses, at least {LEAST_POSES} are needed",
            "widen `limits`, or let the camera see more",
        )
    return goals


def _at_rest(session: CalibrationSession, goal: Pose, view: PlaneView) -> RestingView:
    """A cable at rest, or one that is not detected.  Raises MisfitError: it keeps swinging."""
    options = rough_vision_options(session.settings)
    session.go_to(goal)
    session.wait_s(session.settings.motion.calm_s)
    previous_m = None
    for _ in range(_PICTURES):
        rest = session.rest_at(goal)
        sighting = detect(rest.image, 0.0, view, options)
        if not sighting.seen:
            return rest
        if previous_m is not None and np.max(np.abs(sighting.nodes_m - previous_m)) < _CALM_M:
            return rest
        previous_m = sighting.nodes_m
        session.wait_s(_BETWEEN_S)
    raise MisfitError(
        "the cable does not come to rest", "keep draughts and vibration away, allow motion.calm_s"
    )


def rough_vision_options(settings: Settings) -> VisionOptions:
    """Vision options for a cable whose length is only approximately known."""
    vision = vision_of(settings)
    return replace(
        vision, length_tolerance_m=max(vision.length_tolerance_m, _ROUGHLY * vision.free_length_m)
    )


def views_of(
    shown: ShownCell, view: PlaneView, settings: Settings
) -> tuple[tuple[GripView, ...], tuple[str, ...]]:
    """The cable as measured in each picture, and the reasons why not in the others.

    raises  TooFewError, with the most frequent reasons and the first remedy
    """
    options = rough_vision_options(settings)
    views, reasons = [], []
    for pose in shown.poses:
        sighting = detect(pose.picture.image, 0.0, view, options)
        if sighting.unseen is not None:
            reasons.append(sighting.unseen.value)
            continue
        line = measure_line(
            pose.picture.image,
            view,
            sighting.nodes_m[::-1],
            sighting.clamp_angle_rad,
            options.line_width_px,
            dark=options.cable_is == "dark",
        )
        marks = np.array([*sighting.grip_m, sighting.clamp_angle_rad])
        views.append(GripView(pose.picture.name, marks, line))
    counts = {why: reasons.count(why) for why in reasons}
    if len(views) < LEAST_POSES:
        most = max(counts, key=lambda why: counts[why], default="no_cable")
        # a second cable also causes a wrong length, or hides the end
        most = "two_cables" if "two_cables" in counts else most
        why = ", ".join(f"{w.replace('_', ' ')} in {n}" for w, n in counts.items()) or "no pictures"
        raise TooFewError(
            f"the cable was measured in {len(views)} of {len(shown.poses)} pictures, at least "
            f"{LEAST_POSES} are needed: {why}",
            _REMEDIES[most],
        )
    return tuple(views), tuple(f"{why.replace('_', ' ')} in {n}" for why, n in counts.items())


def grip_from(views: tuple[GripView, ...], cell: StoredCalibration) -> GripFit:
    """Gripping point, clamp angle and free length.  Raises CalibrationError."""
    return fit_grip(views, float(cell.error.get("map_rms_m", 0.0)))


def stored_grip(fit: GripFit, settings: Settings, troubles: tuple[str, ...]) -> StoredCalibration:
    """Calibration file content of a fitted grip."""
    x, y, angle, length = (float(v) for v in fit.half_95)
    spread = fit.repeatability
    devices = devices_of(settings)
    return StoredCalibration(
        "grip",
        datetime.now(UTC),
        {
            "poses": len(fit.by_pose),
            "set_aside": int(np.count_nonzero(~fit.used)),
            "not_measured": ", ".join(troubles) or "none",
        },
        {name: devices[name] for name in ("camera", "width_px", "height_px", "arm")},
        {
            "point_95_m": float(np.hypot(x, y)),
            "angle_95_rad": angle,
            "length_95_m": length,
            "point_between_poses_m": float(np.hypot(spread[0], spread[1])),
            "angle_between_poses_rad": float(spread[2]),
            "length_between_poses_m": float(spread[3]),
        },
        {"point_m": fit.mean[:2], "angle_rad": float(fit.mean[2]), "length_m": float(fit.mean[3])},
        fit.covariance,
    )
