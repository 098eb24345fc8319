"""Whether arm and camera agree on a dry run's motions: delays, scale, direction, what is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.identify.golden_section import where_least
from cell.records.result import AgreementCheck
from cell.run.findings import RehearsedMotion
from drivers.interfaces import Trajectory
from drivers.servo import servo_response

#: What a cycle bears of an unknown delay: at 0.2 m/s it moves the tip by 0.4 mm, s.
DELAY_TOLERANCE_S = 0.002
#: The arm beside its path once the lag is allowed for, and the jaw as seen beside the jaw as
#: reported once constants are: a forecast of the tip bears about this much, m.
PATH_TOLERANCE_M = 0.0003
#: A constant distance between the two: destination and limits are in the arm's plane, m.
BESIDE_TOLERANCE_M = 0.002
#: Scale and direction of the camera's plane: 0.25 mm over 50 mm.
SCALE_TOLERANCE, DIRECTION_TOLERANCE_RAD = 0.005, 0.005
RATE_TOLERANCE = 0.01
#: Share of the pictures in which the jaw's marks must be found.
LEAST_FOUND = 0.9
#: Delays are looked for up to this, either way, s.
LONGEST_DELAY_S = 0.3

_COARSE = 61
_VIEW = "correct camera.view, or arm.plane_…"


def agreement(
    followed: Sequence[RehearsedMotion], *, lag_s: float, frame_rate_hz: float
) -> tuple[AgreementCheck, ...]:
    """What the motions of a dry run say of arm and camera.

    lag_s          as in the settings
    frame_rate_hz  as the camera says
    """
    filmed = [f for f in followed if f.film is not None]
    speeds = [float(np.max(_speed_m_per_s(f.hand))) for f in followed]
    return (
        AgreementCheck("hand: greatest speed", max(speeds, default=0.0), "m/s"),
        *_arm(filmed, lag_s),
        *_frames(filmed, frame_rate_hz),
        *_camera(filmed),
    )


def _arm(filmed: Sequence[RehearsedMotion], lag_s: float) -> list[AgreementCheck]:
    """Lag of the arm behind its commands, and how far it then is beside its path."""

    def left_over(lag_s: float) -> FloatArray:
        parts = []
        for one in filmed:
            hand, begun = one.hand, one.path
            told = Trajectory(begun.t_s + one.began_s, begun.x_m, begun.y_m, begun.angle_rad)
            meant = servo_response(told, lag_s, start=hand.at(one.began_s))
            x_m = np.interp(hand.t_s, meant.t_s, meant.x_m)
            y_m = np.interp(hand.t_s, meant.t_s, meant.y_m)
            parts.append(np.hypot(hand.x_m - x_m, hand.y_m - y_m))
        return np.concatenate(parts)

    found_s = _least(lambda s: float(np.mean(left_over(s) ** 2)), 0.0, LONGEST_DELAY_S)
    return [
        AgreementCheck(
            "arm: lag",
            found_s,
            "s",
            lag_s - DELAY_TOLERANCE_S,
            lag_s + DELAY_TOLERANCE_S,
            f"set arm.lag_s to {found_s:.4f}",
        ),
        AgreementCheck(
            "arm: beside its path",
            float(left_over(found_s).max()),
            "m",
            high=PATH_TOLERANCE_M,
            remedy="check payload, mounting, arm.gain and arm.lookahead_s",
        ),
    ]


def _frames(filmed: Sequence[RehearsedMotion], frame_rate_hz: float) -> list[AgreementCheck]:
    films = [f.film for f in filmed if f.film is not None]
    steps_s = np.concatenate([np.diff(film.frame_s) for film in films])
    found = np.concatenate([np.isfinite(film.jaw_m[:, 0]) for film in films])
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
            "camera: jaw found in",
            float(np.mean(found)),
            "",
            LEAST_FOUND,
            remedy="look at the pictures: light, focus, marks, and whether the jaw is in view",
        ),
    ]


def _camera(filmed: Sequence[RehearsedMotion]) -> list[AgreementCheck]:
    """The jaw as the camera sees it against the jaw as the arm reports it.

    seen = shift + scale · turned(reported a delay earlier): for each delay the rest is linear in
    complex numbers.  The shift is that at the plane's origin, where cables are gripped.
    """
    looks = [_seen_jaw(f) for f in filmed]
    if sum(len(t_s) for t_s, _, _ in looks) < 3:
        return []

    def fit(delay_s: float) -> tuple[FloatArray, complex, complex]:
        said = np.concatenate([_said(hand, t_s - delay_s) for t_s, _, hand in looks])
        seen = np.concatenate([z for _, z, _ in looks])
        middle = said.mean()
        columns = np.column_stack([said - middle, np.ones(len(said))])
        (turn, shift), *_ = np.linalg.lstsq(columns, seen, rcond=None)
        return np.abs(seen - columns @ [turn, shift]), turn, shift - turn * middle

    delay_s = _least(lambda s: float(np.mean(fit(s)[0] ** 2)), -LONGEST_DELAY_S, LONGEST_DELAY_S)
    left_m, turn, shift_m = fit(delay_s)
    return [
        AgreementCheck(
            "camera: stamps late by",
            delay_s,
            "s",
            -DELAY_TOLERANCE_S,
            DELAY_TOLERANCE_S,
            f"add {delay_s:.4f} to camera.latency_s",
        ),
        AgreementCheck(
            "camera: jaw beside the arm",
            abs(shift_m),
            "m",
            high=BESIDE_TOLERANCE_M,
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
            "camera: what remains, rms",
            float(np.sqrt(np.mean(left_m**2))),
            "m",
            high=PATH_TOLERANCE_M,
            remedy="check that the camera is square to the plane, its lens and its focus",
        ),
    ]


def _seen_jaw(followed: RehearsedMotion) -> tuple[FloatArray, NDArray[np.complex128], Trajectory]:
    """Times and places, x + iy, at which the jaw was found; and the arm's own."""
    film = followed.film
    assert film is not None
    found = np.isfinite(film.jaw_m[:, 0])
    jaw_m = film.jaw_m[found]
    return film.looked_s[found], jaw_m[:, 0] + 1j * jaw_m[:, 1], followed.hand


def _said(hand: Trajectory, t_s: FloatArray) -> NDArray[np.complex128]:
    return np.interp(t_s, hand.t_s, hand.x_m) + 1j * np.interp(t_s, hand.t_s, hand.y_m)


def _least(cost: Callable[[float], float], low: float, high: float) -> float:
    """Where `cost` is least: on a coarse grid first, then between its neighbours."""
    grid = np.linspace(low, high, _COARSE)
    at = int(np.argmin([cost(float(s)) for s in grid]))
    near = grid[max(0, at - 1) : at + 2]
    return where_least(cost, float(near[0]), float(near[-1]), within=1e-6)


def _speed_m_per_s(hand: Trajectory) -> FloatArray:
    """(n,) over 20 ms, so that the noise of single samples is not taken for speed."""
    t_s = np.arange(hand.t_s[0], hand.t_s[-1], 0.02)
    x_m, y_m = (np.interp(t_s, hand.t_s, v) for v in (hand.x_m, hand.y_m))
    if len(t_s) < 2:
        return np.zeros(1)
    return np.asarray(np.hypot(np.diff(x_m), np.diff(y_m)) / 0.02, dtype=np.float64)
