"""The steps of a dry run, which moves the gripper through a whole cycle with empty jaws."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.computer.memory import freeze_loaded_objects
from cell.identify.golden_section import where_least
from cell.records.result import AgreementCheck, Outcome
from cell.run.findings import Findings, JawFilm, RehearsedMotion
from cell.run.movements import Movement
from cell.run.pictures import dry_run_pictures
from cell.run.station import Station
from cell.run.steps import allowed_paths
from cell.run.waiting import AHEAD_S, await_rest, wait_until
from cell.run.warm_up import warm_up_servo, warm_up_vision
from cell.vision.marks import find_jaw
from drivers.interfaces import Frame, GripError, Trajectory
from drivers.servo import servo_response

#: A path is sent this share of its duration earlier before its start, because the arm first checks
#: all of it.
AHEAD_SHARE = 0.03
#: Approximate number of frames of a motion in which the jaw is detected.
JAW_SAMPLES = 300


def warm_up(station: Station, findings: Findings) -> Findings:
    """Load the code that processes pictures and motions, before it is needed."""
    warm_up_vision(station.task.vision)
    warm_up_servo()
    freeze_loaded_objects()
    return findings


def reset(station: Station, findings: Findings) -> Findings:
    """Clear our own stop; the jaws stay as they are, and must be empty.  Raises GripError."""
    station.devices.arm.reset()
    station.commands.check()  # after the reset, so that a stop meanwhile is not lost
    gripper = station.devices.gripper
    state = gripper.state()
    if state.holding:
        raise GripError(gripper.name, "holds something", "a dry run needs empty jaws; empty them")
    return _with_checks(findings, AgreementCheck("gripper: opening", state.opening_m, "m"))


def check_paths(movements: Sequence[Movement], station: Station, findings: Findings) -> Findings:
    """Check every path against limits and reach, before anything moves.  Raises LimitError."""
    paths = allowed_paths(station, movements)
    x_m, y_m = (
        np.concatenate([getattr(path, axis) for _, path in paths]) for axis in ("x_m", "y_m")
    )
    return _with_checks(
        findings,
        AgreementCheck("arm: paths within limits and reach", float(len(paths))),
        AgreementCheck("gripper: smallest x", float(x_m.min()), "m"),
        AgreementCheck("gripper: largest x", float(x_m.max()), "m"),
        AgreementCheck("gripper: smallest y", float(y_m.min()), "m"),
        AgreementCheck("gripper: largest y", float(y_m.max()), "m"),
    )


def follow(movement: Movement, station: Station, findings: Findings) -> Findings:
    """Make a movement, filmed if a cycle films it, unless the gripper is there already."""
    arm, camera, clock = station.devices.arm, station.devices.camera, station.devices.clock
    path = movement.path_from(arm.state().pose, arm.rate_hz)
    if path is None:
        return findings
    lasts_s = float(path.t_s[-1]) + arm.lag_s
    before_s = clock.now_s()
    film = None
    if movement.path is None:
        arm.follow(path)
        began_s = clock.now_s()
    else:
        began_s = before_s + station.task.still_s + AHEAD_S + AHEAD_SHARE * lasts_s
        arm.follow(path, began_s)
        filmed_s = began_s - clock.now_s() + lasts_s + station.task.settle_s
        frame_count = int(np.ceil(filmed_s * camera.frame_rate_hz))
        camera.start(frame_count)
        film = _watch(station, max(1, frame_count // JAW_SAMPLES))
    wait_until(station, began_s + lasts_s)
    await_rest(station)
    hand = arm.log(before_s, clock.now_s())
    made = RehearsedMotion(movement.name, path, began_s, hand, film)
    return replace(findings, followed=(*findings.followed, made))


def _with_checks(findings: Findings, *checks: AgreementCheck) -> Findings:
    return replace(findings, checks=(*findings.checks, *checks))


def _watch(station: Station, look_every: int) -> JawFilm:
    """Read a recording to its end, and detect the jaw in some of its frames."""
    task, camera = station.task, station.devices.camera
    frame_s: list[float] = []
    looked_s: list[float] = []
    jaw_m: list[FloatArray] = []
    pictures: list[Frame] = []
    near: FloatArray | None = None
    while (frame := camera.read()) is not None:
        station.commands.check()
        frame_s.append(frame.t_s)
        pictures = [pictures[0] if pictures else frame, frame]
        if frame.index % look_every == 0:
            jaw = find_jaw(frame.image, task.view, task.vision.marks, near)
            near = None if jaw is None else jaw.grip_m
            looked_s.append(frame.t_s)
            jaw_m.append(np.full(2, np.nan) if near is None else near)
    first, last = pictures
    return JawFilm(np.array(frame_s), np.array(looked_s), np.array(jaw_m), (first, last))


def after_dry_run(station: Station, findings: Findings) -> Findings:
    """Check a dry run: do arm and camera agree, are all limits met?  With pictures."""
    arm, camera = station.devices.arm, station.devices.camera
    checks = findings.checks + agreement(
        findings.followed, lag_s=arm.lag_s, frame_rate_hz=camera.frame_rate_hz
    )
    findings = replace(findings, checks=checks, outcome=Outcome.REHEARSED).with_pictures(
        dry_run_pictures(findings.followed, station.task)
    )
    wrong = [check.what for check in checks if not check.right]
    if wrong:
        reason = f"not as it must be: {', '.join(wrong)}"
        findings = replace(findings, outcome=Outcome.UNFIT, reason=reason)
    return findings


#: Tolerated error of a delay, s: at 0.2 m/s it moves the tip by 0.4 mm.
DELAY_TOLERANCE_S = 0.002
#: Tolerated residual, m: of the arm from its path after the lag, and of the detected jaw from the
#: reported one after the fit.  A forecast of the tip tolerates about this much.
PATH_TOLERANCE_M = 0.0003
#: Tolerated constant offset of the two, m: destination and limits are in the arm's plane.
OFFSET_TOLERANCE_M = 0.002
#: Scale and direction of the camera's plane: 0.25 mm over 50 mm.
SCALE_TOLERANCE, DIRECTION_TOLERANCE_RAD = 0.005, 0.005
RATE_TOLERANCE = 0.01
#: Share of the pictures in which the jaw's marks must be detected.
MIN_DETECTED = 0.9
#: Delays are searched from minus to plus this, s.
LONGEST_DELAY_S = 0.3

_COARSE = 61
_VIEW = "correct camera.view, or arm.plane_…"


def agreement(
    followed: Sequence[RehearsedMotion], *, lag_s: float, frame_rate_hz: float
) -> tuple[AgreementCheck, ...]:
    """Checks of arm and camera from the motions of a dry run.

    lag_s          as in the settings
    frame_rate_hz  as the camera reports
    """
    filmed = [f for f in followed if f.film is not None]
    speeds = [float(np.max(_speed_m_per_s(f.gripper_log))) for f in followed]
    return (
        AgreementCheck("gripper: largest speed", max(speeds, default=0.0), "m/s"),
        *_arm(filmed, lag_s),
        *_frames(filmed, frame_rate_hz),
        *_camera(filmed),
    )


def _arm(filmed: Sequence[RehearsedMotion], lag_s: float) -> list[AgreementCheck]:
    """Lag of the arm behind its commands, and residual distance from its path."""

    def residual_m(lag_s: float) -> FloatArray:
        parts = []
        for motion in filmed:
            hand, path = motion.gripper_log, motion.path
            commanded = Trajectory(path.t_s + motion.start_s, path.x_m, path.y_m, path.angle_rad)
            expected = servo_response(commanded, lag_s, start=hand.at(motion.start_s))
            x_m = np.interp(hand.t_s, expected.t_s, expected.x_m)
            y_m = np.interp(hand.t_s, expected.t_s, expected.y_m)
            parts.append(np.hypot(hand.x_m - x_m, hand.y_m - y_m))
        return np.concatenate(parts)

    estimate_s = _least(lambda s: float(np.mean(residual_m(s) ** 2)), 0.0, LONGEST_DELAY_S)
    return [
        AgreementCheck(
            "arm: lag",
            estimate_s,
            "s",
            lag_s - DELAY_TOLERANCE_S,
            lag_s + DELAY_TOLERANCE_S,
            f"set arm.lag_s to {estimate_s:.4f}",
        ),
        AgreementCheck(
            "arm: off its path",
            float(residual_m(estimate_s).max()),
            "m",
            high=PATH_TOLERANCE_M,
            remedy="check payload, mounting, arm.gain and arm.lookahead_s",
        ),
    ]


def _frames(filmed: Sequence[RehearsedMotion], frame_rate_hz: float) -> list[AgreementCheck]:
    films = [f.film for f in filmed if f.film is not None]
    steps_s = np.concatenate([np.diff(film.frame_s) for film in films])
    detected = np.concatenate([np.isfinite(film.jaw_m[:, 0]) for film in films])
    tolerance_hz = RATE_TOLERANCE * frame_rate_hz
    return [
        AgreementCheck("camera: pictures", float(sum(len(film.frame_s) for film in films))),
        AgreementCheck(
            "camera: frame rate",
            float(1.0 / np.mean(steps_s)),
            "Hz",
            frame_rate_hz - tolerance_hz,
            frame_rate_hz + tolerance_hz,
            "shorten the exposure, or lower camera.frame_rate_hz",
        ),
        AgreementCheck(
            "camera: jaw detected in",
            float(np.mean(detected)),
            "",
            MIN_DETECTED,
            remedy="look at the pictures: light, focus, marks, and whether the jaw is in view",
        ),
    ]


def _camera(filmed: Sequence[RehearsedMotion]) -> list[AgreementCheck]:
    """The jaw as detected by the camera, compared with the jaw as reported by the arm.

    observed = shift + scale · turned(reported a delay earlier): linear in complex numbers for a
    fixed delay.  The shift is that at the plane's origin, where cables are gripped.
    """
    detections = [_detected_jaw(f) for f in filmed]
    if sum(len(t_s) for t_s, _, _ in detections) < 3:
        return []

    def fit(delay_s: float) -> tuple[FloatArray, complex, complex]:
        reported = np.concatenate([_reported(hand, t_s - delay_s) for t_s, _, hand in detections])
        observed = np.concatenate([z for _, z, _ in detections])
        middle = reported.mean()
        columns = np.column_stack([reported - middle, np.ones(len(reported))])
        (turn, shift), *_ = np.linalg.lstsq(columns, observed, rcond=None)
        return np.abs(observed - columns @ [turn, shift]), turn, shift - turn * middle

    delay_s = _least(lambda s: float(np.mean(fit(s)[0] ** 2)), -LONGEST_DELAY_S, LONGEST_DELAY_S)
    residual_m, turn, shift_m = fit(delay_s)
    return [
        AgreementCheck(
            "camera: timestamps late by",
            delay_s,
            "s",
            -DELAY_TOLERANCE_S,
            DELAY_TOLERANCE_S,
            f"add {delay_s:.4f} to camera.latency_s",
        ),
        AgreementCheck(
            "camera: jaw away from the arm",
            abs(shift_m),
            "m",
            high=OFFSET_TOLERANCE_M,
            remedy=f"by {shift_m.real * 1e3:.1f}, {shift_m.imag * 1e3:.1f} mm: {_VIEW}",
        ),
        AgreementCheck(
            "camera: scale",
            abs(turn),
            "",
            1.0 - SCALE_TOLERANCE,
            1.0 + SCALE_TOLERANCE,
            f"divide camera.view.metres_per_pixel by {abs(turn):.4f}",
        ),
        AgreementCheck(
            "camera: direction",
            float(np.angle(turn)),
            "rad",
            -DIRECTION_TOLERANCE_RAD,
            DIRECTION_TOLERANCE_RAD,
            "turn the camera level, or correct arm.plane_x_axis and arm.plane_y_axis",
        ),
        AgreementCheck(
            "camera: residual, rms",
            float(np.sqrt(np.mean(residual_m**2))),
            "m",
            high=PATH_TOLERANCE_M,
            remedy="check that the camera is square to the plane, its lens and its focus",
        ),
    ]


def _detected_jaw(
    followed: RehearsedMotion,
) -> tuple[FloatArray, NDArray[np.complex128], Trajectory]:
    """Times and positions, x + iy, of the detected jaw; and the arm's own log."""
    film = followed.film
    assert film is not None
    detected = np.isfinite(film.jaw_m[:, 0])
    jaw_m = film.jaw_m[detected]
    return film.sampled_s[detected], jaw_m[:, 0] + 1j * jaw_m[:, 1], followed.gripper_log


def _reported(hand: Trajectory, t_s: FloatArray) -> NDArray[np.complex128]:
    return np.interp(t_s, hand.t_s, hand.x_m) + 1j * np.interp(t_s, hand.t_s, hand.y_m)


def _least(cost: Callable[[float], float], low: float, high: float) -> float:
    """Argument of the least `cost`: on a coarse grid, then refined between its neighbours."""
    grid = np.linspace(low, high, _COARSE)
    at = int(np.argmin([cost(float(s)) for s in grid]))
    near = grid[max(0, at - 1) : at + 2]
    return where_least(cost, float(near[0]), float(near[-1]), within=1e-6)


def _speed_m_per_s(hand: Trajectory) -> FloatArray:
    """(n,) over 20 ms, so that the noise of single samples does not count as speed."""
    t_s = np.arange(hand.t_s[0], hand.t_s[-1], 0.02)
    x_m, y_m = (np.interp(t_s, hand.t_s, v) for v in (hand.x_m, hand.y_m))
    if len(t_s) < 2:
        return np.zeros(1)
    return np.asarray(np.hypot(np.diff(x_m), np.diff(y_m)) / 0.02, dtype=np.float64)
