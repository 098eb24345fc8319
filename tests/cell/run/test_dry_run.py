"""What arm and camera are wrong by is found, and named with its remedy, and nothing else is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from cell.plan.paths import MotionLimits, identification_path, insertion_path
from cell.records.result import AgreementCheck
from cell.run.dry_run import agreement
from cell.run.findings import JawFilm, RehearsedMotion
from drivers.interfaces import Frame, Pose, Trajectory
from drivers.servo import servo_response

RATE_HZ, FRAME_HZ, NOISE_M = 500.0, 200.0, 2e-5


@dataclass(frozen=True)
class Faults:
    """Of an arm and a camera; `unseen` is the share of pictures without a jaw."""

    lag_s: float = 0.03
    bulge_m: float = 0.0
    late_s: float = 0.0
    beside_m: complex = 0.0
    scale: float = 1.0
    turned_rad: float = 0.0
    bent: float = 0.0
    unseen: float = 0.0
    frame_hz: float = FRAME_HZ


def made(
    path: Trajectory, began_s: float, rng: np.random.Generator, faults: Faults
) -> RehearsedMotion:
    """A motion as an arm and a camera with these faults would have made it."""
    told = Trajectory(path.t_s + began_s, path.x_m, path.y_m, path.angle_rad)
    true = servo_response(told, faults.lag_s)
    t_s = np.arange(began_s - 0.2, true.t_s[-1] + 0.2, 1.0 / RATE_HZ)
    place = np.interp(t_s, true.t_s, true.x_m) + 1j * np.interp(t_s, true.t_s, true.y_m)
    share = np.clip((t_s - began_s) / (path.t_s[-1]), 0.0, 1.0)
    place = place + faults.bulge_m * np.sin(np.pi * share) * 1j * (place[-1] - place[0]) / abs(
        place[-1] - place[0]
    )
    noise = rng.normal(scale=1e-5, size=(2, len(t_s)))
    hand = Trajectory(t_s, place.real + noise[0], place.imag + noise[1], np.zeros(len(t_s)))
    frame_s = np.arange(t_s[0] + 0.01, t_s[-1] - 0.01, 1.0 / faults.frame_hz)
    seen = np.interp(frame_s - faults.late_s, t_s, place.real) + 1j * np.interp(
        frame_s - faults.late_s, t_s, place.imag
    )
    seen = (
        seen * faults.scale * np.exp(1j * faults.turned_rad)
        + faults.beside_m
        + faults.bent * np.abs(seen) ** 2
    )
    seen = seen + rng.normal(scale=NOISE_M, size=(2, len(seen))).T @ [1.0, 1j]
    jaw_m = np.column_stack([seen.real, seen.imag])
    jaw_m[rng.random(len(jaw_m)) < faults.unseen] = np.nan
    frame = Frame(0, 0.0, np.zeros((4, 4), dtype=np.uint8))
    return RehearsedMotion(
        "leg", path, began_s, hand, JawFilm(frame_s, frame_s, jaw_m, (frame, frame))
    )


def checks(speed: float = 1.0, seed: int = 1, **faults: Any) -> dict[str, AgreementCheck]:
    rng = np.random.default_rng(seed)
    brisk, gentle = (m.slowed(1.0 / speed) for m in (MotionLimits(), MotionLimits(0.2, 1.0, 10.0)))
    low = Pose(0.0, -0.05)
    down = identification_path(Pose(0.0, 0.0), 0.05, brisk, RATE_HZ, hold_s=0.0)
    left = insertion_path(low, 0.0, 0.05, gentle, RATE_HZ)
    followed = [made(*m, rng, Faults(**faults)) for m in ((down, 10.0), (left, 30.0))]
    found = agreement(followed, lag_s=0.03, frame_rate_hz=FRAME_HZ)
    return {check.what: check for check in found}


def wrong(found: dict[str, AgreementCheck]) -> set[str]:
    return {what for what, check in found.items() if not check.right}


@pytest.mark.parametrize("speed", [1.0, 0.1])
def test_a_cell_in_order_is_right_at_any_speed(speed: float) -> None:
    found = checks(speed)
    assert wrong(found) == set()
    assert found["camera: jaw detected in"].found == 1.0
    fastest = 0.465 if speed == 1.0 else 0.05
    assert found["gripper: largest speed"].found <= fastest


FAULTS = {
    "arm: lag": ({"lag_s": 0.05}, 0.05, "set arm.lag_s to 0.050"),
    "arm: off its path": ({"bulge_m": 0.001}, 0.001, "arm.gain"),
    "camera: frame rate": ({"frame_hz": 150.0}, 150.0, "camera.frame_rate_hz"),
    "camera: jaw detected in": ({"unseen": 0.5}, 0.5, "look at the pictures"),
    "camera: timestamps late by": ({"late_s": 0.012}, 0.012, "add 0.01"),
    "camera: jaw away from the arm": ({"beside_m": 0.003 - 0.004j}, 0.005, "by 3.0, -4.0 mm"),
    "camera: scale": ({"scale": 1.02}, 1.02, "metres_per_pixel by 1.02"),
    "camera: direction": ({"turned_rad": 0.01}, 0.01, "turn the camera level"),
}


@pytest.mark.parametrize("what", FAULTS)
@pytest.mark.parametrize("speed", [1.0, 0.1])
def test_each_fault_is_found_by_name_and_size_and_alone(what: str, speed: float) -> None:
    faults, size, remedy = FAULTS[what]
    found = checks(speed, **faults)
    assert wrong(found) == {what}
    assert found[what].found == pytest.approx(size, rel=0.1)
    assert remedy in found[what].remedy


def test_a_camera_that_is_not_square_leaves_something_over() -> None:
    assert "camera: residual, rms" in wrong(checks(bent=0.8))


@settings(max_examples=10, deadline=None, phases=(Phase.explicit, Phase.generate))
@given(
    st.floats(0.002, 0.1), st.floats(-0.1, 0.1), st.floats(0.9, 1.1), st.floats(-0.2, 0.2),
    st.complex_numbers(max_magnitude=0.05), st.integers(0, 99),
)  # fmt: skip
def test_all_of_them_together_are_told_apart(
    lag_s: float, late_s: float, scale: float, turned_rad: float, beside_m: complex, seed: int
) -> None:
    found = checks(
        seed=seed, lag_s=lag_s, late_s=late_s, scale=scale, turned_rad=turned_rad, beside_m=beside_m
    )
    assert found["arm: lag"].found == pytest.approx(lag_s, abs=5e-4)
    assert found["camera: timestamps late by"].found == pytest.approx(late_s, abs=5e-4)
    assert found["camera: scale"].found == pytest.approx(scale, abs=1e-3)
    assert found["camera: direction"].found == pytest.approx(turned_rad, abs=1e-3)
    assert found["camera: jaw away from the arm"].found == pytest.approx(abs(beside_m), abs=1e-4)


def test_a_jaw_that_is_never_found_says_so_and_no_more() -> None:
    found = checks(unseen=1.0)
    assert wrong(found) == {"camera: jaw detected in"}
    assert "camera: scale" not in found
