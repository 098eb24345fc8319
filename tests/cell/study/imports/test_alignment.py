"""A gripper with a file of its own: its clock, origin and scale by what both files show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cell.study.folder import read_study
from cell.study.imports.alignment import GripperTrack, align, align_root, turned_as
from cell.study.imports.mapping import Mapping, read_mapping
from cell.study.imports.places import find_axes
from tests.cell.study.imports.corpus.swing import ARCS_M, Swing, straight_study, stroke, swing
from tests.cell.study.imports.corpus.text import cells as digits
from tests.cell.study.imports.corpus.text import lines as text
from tests.cell.study.imports.corpus.text import saved
from tests.cell.study.imports.made import CABLE, filled, run

#: The robot's clock is behind by this, and its base is here, in the markers' frame.
BEHIND_S, BASE_M = 8569.0312, np.array([0.4, -0.2])


def camera(s: Swing, folder: Path, unit: str, per_m: float, *, clamp: bool) -> Path:
    """Markers in the camera's frame, whose rows count down if no unit is stated."""
    points = np.concatenate([s.gripper_m[:, None], s.markers_m], axis=1)[:, not clamp :]
    names = [*(["clamp"] if clamp else []), *(f"p{i}" for i in range(1, 6))]
    down = np.array([1.0, 1.0 if unit else -1.0])
    values = (points * down + [0.3, 0.3]) * per_m
    table = np.column_stack([s.t_s, values.reshape(len(s.t_s), -1)])
    columns = ["t [s]", *(f"{n}_{a}{unit}" for n in names for a in "xy")]
    return saved(folder / "camera.csv", text([columns, *digits(table, 7)]))


def robot(s: Swing, folder: Path, unit: str, per_m: float, behind_s: float) -> Path:
    """The gripper at 250 rows a second, from 0.2 s before the markers to 0.2 s after."""
    t_s = np.arange(s.t_s[0] - 0.2, s.t_s[-1] + 0.2, 0.004)
    path = np.column_stack([np.interp(t_s, s.t_s, v) for v in (s.gripper_m - BASE_M).T])
    values = np.column_stack([t_s + behind_s, path[:, 0], 0.0 * t_s, path[:, 1]])
    values[:, 1:] *= per_m
    columns = ["time [s]", *(f"tcp_{a}{unit}" for a in "xyz")]
    return saved(folder / "robot.csv", text([columns, *digits(values, 7)]))


def proposed(folder: Path, markers: Path, hand: Path, *more: str) -> tuple[str, Mapping]:
    said = run(markers, "--hand", hand, "-o", folder / "s", *CABLE, *more)
    return said, read_mapping(folder / "s" / "import.yaml").mapping


def test_a_point_of_the_gripper_shows_clock_and_origin(tmp_path: Path) -> None:
    """The clamp's columns were not used, and the clock was 2.8 ms early."""
    s = straight_study()[0]
    files = camera(s, tmp_path, "_mm", 1e3, clamp=True), robot(s, tmp_path, "_m", 1.0, -BEHIND_S)
    said, mapping = proposed(tmp_path, *files)
    assert "'clamp' of camera.csv is on the gripper" in said
    assert mapping.trials[0].clock_offset_s == pytest.approx(BEHIND_S, abs=2e-4)
    assert f"+{mapping.trials[0].clock_offset_s:.4f} s ± 0.0" in said
    assert mapping.hand.origin_m == pytest.approx(BASE_M + 0.3, abs=5e-5)
    assert [m.arc_length_m for m in mapping.markers] == pytest.approx(ARCS_M, abs=3e-4)


def test_the_strokes_unit_fixes_the_scale_of_pixels(tmp_path: Path) -> None:
    """The markers, which end 20 mm from the clamp, were stretched over the free length."""
    s = straight_study()[0]
    files = camera(s, tmp_path, "", 4000.0, clamp=False), robot(s, tmp_path, "", 1e3, -BEHIND_S)
    said, mapping = proposed(tmp_path, *files)
    assert "by the gripper's stroke in its own file" in said
    assert "in mm it moves by 0.05 m" in said
    assert mapping.metres_per_unit == pytest.approx(1.0 / 4000.0, rel=0.01)
    assert mapping.hand.metres_per_unit == 1e-3
    assert [m.arc_length_m for m in mapping.markers] == pytest.approx(ARCS_M, abs=1e-3)
    error_mm = float(said.partition("begins at the gripper, ± ")[2].split()[0])
    origin_m, shown_m = mapping.hand.origin_m, np.add(BASE_M, [0.3, -0.3])
    assert np.linalg.norm(np.subtract(origin_m, shown_m)) * 1e3 < error_mm
    assert mapping.trials[0].start == "equilibrium"
    assert mapping.trials[0].clock_offset_s == pytest.approx(BEHIND_S, abs=2e-3)


def test_a_stale_origin_is_refused_and_null_estimates_it(tmp_path: Path) -> None:
    """With corrected arc lengths, the gripper was 28 mm beside the cable; no remedy was taken."""
    s = straight_study()[0]
    files = camera(s, tmp_path, "_mm", 1e3, clamp=False), robot(s, tmp_path, "_m", 1.0, 0.0)
    _, mapping = proposed(tmp_path, *files)
    right = np.array(mapping.hand.origin_m)
    file = tmp_path / "s" / "import.yaml"
    for stale in ((right + np.array([-0.019, 0.004])).tolist(), [0.0, 0.0]):
        filled(file, {"hand.origin_m": stale})
        said = run(file, code=2)
        assert "hand.origin_m: puts the gripper of camera at [" in said
        assert "give null to have it estimated" in said
    filled(file, {"hand.origin_m": None})
    assert "hand.origin_m is estimated as [" in run(file)
    grip = read_study(tmp_path / "s").trials[0].grip
    np.testing.assert_allclose([grip.x_m[0], grip.y_m[0]], [0.3, 0.3], atol=2e-3)


@pytest.mark.parametrize("turns", [0.0, 0.3])
def test_the_clamped_root_shows_the_clock_within_its_uncertainty(turns: float) -> None:
    """Without the clamp's slope the cable's inertia made the gripper's clock early."""
    t_s = np.arange(0.0, 1.8, 1.0 / 90.0)
    way, errors = stroke(t_s), []
    for seed in range(6):
        s = swing("s", np.outer(way, [0.0, -0.05]), 0.2 + turns * way, seed, t_s, 1e-4)
        leaves = -np.column_stack([np.cos(s.angle_rad), np.sin(s.angle_rad)])
        hand = GripperTrack(t_s + 1.7e9, s.gripper_m, leaves)
        aligned = align_root(hand, t_s, s.markers_m, ARCS_M.tolist())
        assert aligned is not None
        error_s = aligned.shift_s + 1.7e9
        assert abs(error_s) < 4.0 * aligned.std_s < 4e-3
        errors.append(error_s)
        scaled = align_root(hand, t_s, s.markers_m, ARCS_M.tolist(), free_gain=True)
        assert scaled is not None
        assert scaled.gain == pytest.approx(1.0, rel=0.01)
    assert abs(np.mean(errors)) < 5e-4


def test_one_point_in_two_files_is_aligned_to_a_fraction_of_a_row() -> None:
    t_s = np.arange(0.0, 2.0, 1.0 / 90.0)
    path = np.outer(stroke(t_s), [0.01, -0.05])
    fine_s = np.arange(-0.5, 2.5, 0.002)
    fine = np.outer(stroke(fine_s), [0.01, -0.05])
    noise = np.random.default_rng(3).normal(0.0, 1.5e-4, path.shape)
    aligned = align(fine_s + 1.7e9 + 0.0123, fine, t_s, path + noise + [1.0, 2.0])
    assert aligned is not None
    assert aligned.shift_s + 1.7e9 + 0.0123 == pytest.approx(0.0, abs=4.0 * aligned.std_s)
    assert aligned.std_s < 3e-4
    np.testing.assert_allclose(aligned.offset_m, [1.0, 2.0], atol=1e-4)


@pytest.mark.parametrize("turn", [[[-1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, -1], [1, 0]]])
@pytest.mark.parametrize("way", [[0.0, -0.05], [0.02, -0.03]])
def test_the_clock_does_not_depend_on_axes(turn: list[list[int]], way: list[float]) -> None:
    """With an axis reversed, a vertical stroke was said to hardly move the gripper."""
    t_s = np.arange(0.0, 1.8, 1.0 / 90.0)
    s = swing("s", np.outer(stroke(t_s), way), np.full(len(t_s), 0.2), 1, t_s, 1e-4)
    hand = GripperTrack(t_s - 77.3, s.gripper_m @ np.array(turn), np.zeros_like(s.gripper_m))
    track = turned_as(hand, t_s, s.markers_m[:, 0])
    assert track is not None
    np.testing.assert_allclose(track.xy_m, s.gripper_m, atol=3e-3)
    aligned = align_root(track, t_s, s.markers_m, ARCS_M.tolist())
    assert aligned is not None
    assert abs(aligned.shift_s - 77.3) < 4.0 * aligned.std_s < 6e-3


@pytest.mark.parametrize("way", [[0.0, -0.05], [-0.05, 0.0], [0.02, -0.03]])
def test_one_marker_shows_the_clock_within_its_uncertainty(way: list[float]) -> None:
    """The cable's inertia was no part of it: the error was up to six standard deviations."""
    t_s = np.arange(0.0, 1.8, 1.0 / 120.0)
    s = swing("s", np.outer(stroke(t_s), way), np.full(len(t_s), 0.2), 1, t_s, 3e-5)
    hand = GripperTrack(t_s + 5.0, s.gripper_m, np.zeros_like(s.gripper_m))
    aligned = align_root(hand, t_s, s.markers_m[:, 1:2], [float(ARCS_M[1])])
    assert aligned is not None
    assert abs(aligned.shift_s + 5.0) < 2.0 * aligned.std_s


def test_what_is_null_repeats_the_estimate_of_the_proposal(tmp_path: Path) -> None:
    """A null clock was refused as empty; a null origin ignored the marker `clamp`."""
    s = straight_study()[0]
    files = camera(s, tmp_path, "_mm", 1e3, clamp=True), robot(s, tmp_path, "_m", 1.0, -BEHIND_S)
    _, mapping = proposed(tmp_path, *files)
    file, right_s = tmp_path / "s" / "import.yaml", mapping.trials[0].clock_offset_s
    assert right_s is not None
    filled(file, {"hand.origin_m": None, "trials.0.clock_offset_s": None})
    said = run(file)
    x_m, y_m = mapping.hand.origin_m or (0.0, 0.0)
    assert (
        f"hand.origin_m is estimated as [{x_m:g}, {y_m:g}], so that the gripper is 'clamp'" in said
    )
    assert f"clock_offset_s is estimated as {right_s:.4f} ± " in said
    filled(file, {"hand.origin_m": [x_m, y_m], "trials.0.clock_offset_s": right_s})
    assert "clock_offset_s" not in run(file, "--force")


@pytest.mark.parametrize("clamp", [False, True])
@pytest.mark.parametrize("off_s", [-0.012, 0.01])
def test_a_stated_clock_that_the_data_contradict_is_told(
    clamp: bool, off_s: float, tmp_path: Path
) -> None:
    """Read by eye it was wrong by 10 to 17 ms, and the study was written without a word."""
    s = straight_study()[0]
    files = camera(s, tmp_path, "_mm", 1e3, clamp=clamp), robot(s, tmp_path, "_m", 1.0, -BEHIND_S)
    proposed(tmp_path, *files)
    filled(tmp_path / "s" / "import.yaml", {"trials.0.clock_offset_s": BEHIND_S + off_s})
    said = run(tmp_path / "s" / "import.yaml")
    assert f"clock_offset_s is {BEHIND_S + off_s:.4f} s, yet gripper and cable move at once" in said


@pytest.mark.parametrize("along", [0, 2])
@pytest.mark.parametrize("down", [1.0, -1.0])
def test_a_slight_bend_shows_up_as_a_guess(along: int, down: float) -> None:
    """A level cable with a sagitta of 2.4 mm over 75 mm was straight: it hung along its length."""
    s_m = np.linspace(0.025, 0.1, 4)
    shape = np.zeros((4, 3))
    shape[:, along], shape[:, 1] = s_m, down * (0.2 * s_m + 0.6 * s_m**2)
    moves = np.outer(stroke(np.arange(0.0, 2.0, 0.01)), [0.0, 0.05, 0.0])
    places = shape + moves[:, None] + np.random.default_rng(0).normal(0.0, 3e-5, (200, 4, 3))
    axes, findings = find_axes(places, shape)
    assert axes.up == [0.0, -down, 0.0]
    assert any("as gravity does it, if only by 0.0" in f.sentence for f in findings)


def test_a_cable_that_turns_towards_its_direction_hangs() -> None:
    """A clamp 4° off the vertical bends it sideways."""
    angle = np.radians([4.0, 2.0, 0.5])
    steps = 0.03 * np.column_stack([np.sin(angle), np.zeros(3), -np.cos(angle)])
    shape = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    moves = np.outer(stroke(np.arange(0.0, 2.0, 0.01)), [0.05, 0.0, 0.0])
    places = shape + moves[:, None] + np.random.default_rng(0).normal(0.0, 3e-5, (200, 4, 3))
    assert find_axes(places, shape)[0].up == [0.0, 0.0, 1.0]


def test_the_order_is_that_of_the_points_left_over(tmp_path: Path) -> None:
    """A marker fixed beyond the tip rests first: the order from it on began with the tip."""
    s = straight_study()[0]
    table_m = s.markers_m[0, -1] + [-0.03, -0.07]
    table = table_m + np.random.default_rng(0).normal(0.0, 1e-4, (len(s.t_s), 2))
    points = np.concatenate([s.markers_m, table[:, None]], axis=1) * 1e3
    columns = ["t [s]", *(f"p{i}_{a}_mm" for i in range(1, 7) for a in "xy")]
    rows = digits(np.column_stack([s.t_s, points.reshape(len(s.t_s), -1)]), 7)
    markers = saved(tmp_path / "camera.csv", text([columns, *rows]))
    _, mapping = proposed(tmp_path, markers, robot(s, tmp_path, "_m", 1.0, -BEHIND_S))
    assert [m.name for m in mapping.markers] == ["p1", "p2", "p3", "p4", "p5"]
    assert mapping.trials[0].clock_offset_s == pytest.approx(BEHIND_S, abs=2e-3)
