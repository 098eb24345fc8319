"""What stands where a marker was not seen is told from its places, and from those of a gripper."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cell.study.entries import MAX_ARC_STD_FRACTION
from cell.study.imports.capture import Capture, CapturedColumn, ImportFindings
from cell.study.imports.choosing import choose
from cell.study.imports.contents import contents
from cell.study.imports.scales import arc_length_stds
from cell.study.imports.shape import arc_lengths, middle, resting
from tests.cell.study.imports.made import CABLE, made, run, saved, text


def a_file(places_mm: np.ndarray) -> Capture:
    """Time, gripper and markers (rows, points, 2) of a file."""
    names = [f"{n} {a} [mm]" for n in ("hand", "m1", "m2", "m3", "m4", "tip") for a in "xy"]
    values = np.column_stack([np.arange(len(places_mm)) / 200.0, places_mm.reshape(-1, 12)])
    columns = (CapturedColumn("t [s]"), *map(CapturedColumn, names))
    return Capture(Path("a.csv"), columns, values, np.arange(len(values)) + 2)


def places() -> np.ndarray:
    """A gripper that rests at the origin, exactly, and the markers of its cable, mm."""
    m = made()
    return np.concatenate([m.gripper_m[:, None], m.markers_m], axis=1) * 1e3


def lost(*captures: Capture) -> tuple[float, ...]:
    return choose(captures[0], contents(captures[0]), False, ImportFindings(), captures[1:]).lost


@pytest.mark.parametrize("rows", [1, 3, 6, 20])
@pytest.mark.parametrize("point", [1, 3, 5])
def test_zeros_to_which_a_marker_jumps_mean_that_it_was_not_seen(rows: int, point: int) -> None:
    """Six zeros of a marker 20 mm from the origin were kept as its places, without a word."""
    seen = places()
    seen[75 : 75 + rows, point] = 0.0
    assert lost(a_file(seen)) == (0.0,)


def test_zeros_in_the_file_of_another_trial_are_seen_too() -> None:
    other = places()
    other[75:81, 1] = 0.0
    assert lost(a_file(places()), a_file(other)) == (0.0,)


def test_an_origin_at_which_a_point_rests_or_that_it_passes_is_a_place() -> None:
    """The gripper rests at the origin before its motion, or after it, or comes back to it."""
    stays = places()
    assert lost(a_file(stays)) == ()
    returns = stays - stays[:, :1]
    swing = np.sin(np.linspace(0.0, 6.0 * np.pi, len(stays)))[:, None, None]
    for moved in (returns + 40.0 * np.round(swing, 1), stays[::-1], stays - stays[-1, 0]):
        assert lost(a_file(moved)) == ()


@pytest.mark.parametrize("robot_first", [True, False])
def test_of_two_points_at_one_place_of_the_gripper_the_less_noisy_is_taken(
    robot_first: bool, tmp_path: Path
) -> None:
    """A robot's tool point and a camera's dot on the clamp: the dot was taken, the robot's columns
    were not even listed as unused."""
    m, rng = made(), np.random.default_rng(3)
    columns = {"t_s": m.t_s, "b_deg": np.degrees(m.angle_rad)}
    points = {"tcp": m.gripper_m + rng.normal(0.0, 1e-5, m.gripper_m.shape)}
    points["clamp"] = m.gripper_m + rng.normal(0.0, 2e-4, m.gripper_m.shape)
    points = points if robot_first else dict(reversed(points.items()))
    points |= {f"m{i}": m.markers_m[:, i] for i in range(m.markers_m.shape[1])}
    for name, at_m in points.items():
        columns |= {f"{name}_{a}_mm": 1e3 * at_m[:, k] for k, a in enumerate("xz")}
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    file = saved(tmp_path / "run.csv", text([list(columns), *rows]))
    said = run(file, "-o", tmp_path / "s", *CABLE)
    assert "columns: [tcp_x_mm, tcp_z_mm]" in (tmp_path / "s" / "import.yaml").read_text()
    assert "for the other write hand.columns: [clamp_x_mm, clamp_z_mm]" in said
    assert "not used of run.csv: columns clamp_x_mm, clamp_z_mm" in said


LENGTH_M, ROWS, SEEDS = 0.1, 70, 16


def hanging(arcs_m: np.ndarray, bend_1_per_m: float) -> np.ndarray:
    """(points, 2) gripper and markers of a cable that its weight bends: curvature ∝ (1 − s/L)²."""
    fine = np.linspace(0.0, LENGTH_M, 30001)
    turn = bend_1_per_m * LENGTH_M / 3.0 * (1.0 - (1.0 - fine / LENGTH_M) ** 3)
    steps = -np.stack([np.cos(turn), np.sin(turn)], axis=1)
    along = np.cumsum(0.5 * (steps[1:] + steps[:-1]) * (fine[1] - fine[0]), axis=0)
    at = np.searchsorted(fine, np.append(0.0, arcs_m) - 1e-9)
    return np.asarray(np.concatenate([[[0.0, 0.0]], along])[at])


def errors_and_stds(
    arcs_m: np.ndarray, bend_1_per_m: float, noise_m: float, ar1: float = 0.0, hand_m: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """(seeds, markers) of what is guessed from as many rows at rest."""
    shape = hanging(arcs_m, bend_1_per_m)
    errors, stds = [], []
    for seed in range(SEEDS):
        noise = np.random.default_rng(seed).normal(0.0, noise_m, (ROWS, *shape.shape))
        for k in range(1, ROWS):
            noise[k] = ar1 * noise[k - 1] + np.sqrt(1.0 - ar1**2) * noise[k]
        noise[:, 0] *= hand_m / noise_m
        places = shape + noise
        rest = resting(places)
        assert rest is not None
        guess = np.round(arc_lengths(middle(rest)[None])[1:], 5)
        errors.append(guess - arcs_m)
        stds.append(arc_length_stds(places, LENGTH_M, from_hand=True))
    return np.array(errors), np.array(stds)


#: None of them on a step to which arc lengths are rounded.
FIVE, TEN = np.linspace(0.020123, 0.099997, 5), np.linspace(0.010123, 0.099997, 10)


def size(errors: np.ndarray, stds: np.ndarray) -> tuple[float, float]:
    """Errors, and their weighted means over the markers, in standard deviations, rms."""
    together = np.sum(errors / stds**2, axis=1) / np.sqrt(np.sum(1.0 / stds**2, axis=1))
    return float(np.sqrt(np.mean((errors / stds) ** 2))), float(np.sqrt(np.mean(together**2)))


@pytest.mark.parametrize("noise_m", [1e-5, 5e-5, 2e-4])
@pytest.mark.parametrize("arcs_m", [FIVE, TEN, FIVE[[1, 3, 4]], FIVE[[4]]], ids=len)
def test_of_a_stiff_cable_they_are_what_noise_makes_the_guess_miss(
    arcs_m: np.ndarray, noise_m: float
) -> None:
    each, together = size(*errors_and_stds(arcs_m, 2.0, noise_m))
    assert 0.5 < each < 1.5 and together < 1.7


def test_slow_noise_and_a_hand_with_noise_of_its_own_are_allowed_for() -> None:
    for slow, hand_m in ((0.7, 0.0), (0.0, 1e-4)):
        errors, stds = errors_and_stds(FIVE, 2.0, 5e-5, slow, hand_m)
        assert size(errors, stds)[1] < 1.7
        assert np.median(stds) < 4e-5


@pytest.mark.parametrize("bend_1_per_m", [6.0, 12.0])
@pytest.mark.parametrize(
    "arcs_m", [FIVE, FIVE[1:], FIVE[[1, 3, 4]], FIVE[[0, 4]], FIVE[[2, 4]], FIVE[[4]]], ids=str
)
def test_of_few_markers_on_a_bent_cable_they_hold_what_the_curve_misses(
    arcs_m: np.ndarray, bend_1_per_m: float
) -> None:
    errors, stds = errors_and_stds(arcs_m, bend_1_per_m, 1e-5)
    assert size(errors, stds)[1] < 1.7
    assert np.median(stds) < 8.0 * max(np.median(np.abs(errors).max(axis=1)), 3e-6)


def test_rounded_places_are_known_to_their_step_and_none_beyond_what_a_study_may_say() -> None:
    places = np.round(np.repeat(hanging(FIVE, 2.0)[None], ROWS, axis=0), 4)
    places[-1] += 0.05  # at last it moves
    assert np.all(arc_length_stds(places, LENGTH_M, from_hand=True) > 1e-4 / np.sqrt(12.0))
    never_together = np.full((ROWS, 6, 2), np.nan)
    never_together[0] = places[0]
    most_m = MAX_ARC_STD_FRACTION * LENGTH_M
    np.testing.assert_array_equal(arc_length_stds(never_together, LENGTH_M, True), most_m)
