"""Clamp angles, however a file counts a turn; a gripper and its cable in files of their own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cell.files.input_error import InputError
from cell.files.yaml_document import Document
from cell.study.imports.capture import Capture, CapturedColumn
from cell.study.imports.gripper_path import count_of, gripper_path, place_m, turn_of
from cell.study.imports.gripper_proposal import gripper_file
from cell.study.imports.gripper_section import AxesSection, TurnsSection
from cell.study.imports.mapping import Mapping, ReadMapping
from cell.study.imports.places import angle_towards, clamp_angle_rad, continuous, places_m
from cell.study.imports.understand import Files, Stated, Understanding, understand
from tests.cell.study.imports.corpus.swing import ARCS_M, LENGTH_M, Swing, stroke, swing
from tests.cell.study.imports.corpus.swing import MARKERS as NAMES
from tests.cell.study.imports.made import NOISE_M

T_S = np.arange(0.0, 1.2, 0.005)
AT_REST = (T_S < 0.4).sum()
SIDES = AxesSection(right=[1.0, 0.0], up=[0.0, 1.0])


def trial(angle_rad: np.ndarray) -> Swing:
    hand = np.outer(stroke(T_S), [0.01, -0.05])
    return swing("a", hand, angle_rad, 1, T_S, NOISE_M)


def captured(name: str, **columns: np.ndarray) -> Capture:
    values = np.column_stack([T_S[: len(next(iter(columns.values())))], *columns.values()])
    named = (CapturedColumn("time", "s"), *(CapturedColumn(c) for c in columns))
    return Capture(Path(name), named, values, np.arange(len(values)) + 2)


def markers_of(m: Swing, count: int = 5, scale: float = 1e3) -> dict[str, np.ndarray]:
    return {
        f"{n} {a}": m.markers_m[:, i, k] * scale
        for i, n in enumerate(NAMES[:count])
        for k, a in enumerate("xy")
    }


def hand_of(m: Swing) -> dict[str, np.ndarray]:
    return {f"hand {a}": m.gripper_m[:, k] * 1e3 for k, a in enumerate("xy")}


def understood(
    capture: Capture, hand: Capture | None = None, angle_rad: float | None = None
) -> Understanding:
    files = Files("a", "a.csv", capture, None if hand is None else "hand.csv", hand)
    stated = Stated("a", LENGTH_M, 0.0074, 0.016, 1e-4, clamp_angle_rad=angle_rad)
    return understand([files], stated)


def said(found: Understanding, entry: str) -> list[str]:
    return [f.sentence for f in found.findings if f.entry == entry]


def noise(seed: int, rad: float = 1e-3) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, rad, len(T_S))


def from_0_to_360(angle_rad: np.ndarray) -> np.ndarray:
    return np.degrees(angle_rad) % 360.0


def half_a_turn_off(angle_rad: np.ndarray) -> np.ndarray:
    return (np.degrees(angle_rad) + 360.0) % 360.0 - 180.0


@pytest.mark.parametrize("counted", [from_0_to_360, half_a_turn_off])
@pytest.mark.parametrize("turn_rad", [0.0, 0.7])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_angle_is_the_same_however_a_turn_is_counted(
    counted: Callable[[np.ndarray], np.ndarray], turn_rad: float, sign: float
) -> None:
    """A level clamp's noise went over the cut: half a turn was lost, or jumps were written."""
    s = np.clip((T_S - 0.4) / 0.3, 0.0, 1.0)
    angle_rad = noise(5) - 0.5 * turn_rad + turn_rad * s
    m = trial(angle_rad)
    angles = {"hand angle [deg]": counted(sign * angle_rad if turn_rad else angle_rad)}
    capture = captured("a.csv", **hand_of(m), **angles, **markers_of(m))
    mapping = understood(capture).mapping
    found = clamp_angle_rad(capture, mapping.hand.angle, mapping.axes)
    assert found is not None
    np.testing.assert_allclose(found, angle_rad, atol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("unit", ["", " [deg]"])
def test_unit_and_sign_are_those_of_all_trials(sign: float, unit: str) -> None:
    """The level clamp of a first trial tells neither; the second is turned up by 60°."""
    swings = [trial(np.full(len(T_S), angle_rad)) for angle_rad in (0.0, -1.05)]
    trials = []
    for name, m in zip("ab", swings, strict=True):
        angle = {f"hand angle{unit}": sign * np.degrees(m.angle_rad)}
        capture = captured(f"{name}.csv", **hand_of(m), **angle, **markers_of(m))
        trials.append(Files(name, f"{name}.csv", capture))
    mapping = understand(trials, Stated("a", LENGTH_M, 0.0074, 0.016, 1e-4)).mapping
    for files, m in zip(trials, swings, strict=True):
        found = clamp_angle_rad(files.capture, mapping.hand.angle, mapping.axes)
        np.testing.assert_allclose(found, m.angle_rad, atol=1e-6)


def test_axes_of_a_hand_s_own_are_those_in_which_it_moves_in_any_trial() -> None:
    """The first stroke goes down alone; the third axis of the robot is up, the second to the right,
    its clock began long before, and counts milliseconds."""
    trials = []
    for name, stroke_m in (("a", [0.0, -0.05]), ("b", [0.04, 0.0])):
        hand_m = np.outer(stroke(T_S), stroke_m)
        m = swing(name, hand_m, np.zeros(len(T_S)), 1, T_S, NOISE_M)
        markers = captured(f"{name}.csv", **markers_of(m, scale=-2000.0))
        way = stroke(np.arange(1200) / 1000.0)
        xyz_m = np.array([0.4, 0.1, 0.0]) + np.outer(way, [0.0, -stroke_m[0], stroke_m[1]])
        named = tuple(CapturedColumn(n) for n in ("time", "tcp x", "tcp y", "tcp z"))
        rows = np.column_stack([5000.0 + np.arange(1200), xyz_m])
        hand = Capture(Path("h.csv"), named, rows, np.arange(1200) + 2)
        trials.append(Files(name, f"{name}.csv", markers, f"hand_{name}.csv", hand))
    found = understand(trials, Stated("a", LENGTH_M, 0.0074, 0.016, 1e-4))
    hand = found.mapping.hand
    assert hand.axes is not None
    assert (hand.axes.right, hand.axes.up) == ([0.0, -1.0, 0.0], [0.0, 0.0, 1.0])
    assert hand.time is not None
    assert hand.time.seconds_per_unit == 1e-3
    assert "lasts as long as the markers' file" in " ".join(said(found, "time"))


@pytest.mark.parametrize("angle_rad", [0.0, -0.2, 0.2])
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", ["gripper", "gripb"])
def test_two_points_on_the_hand_make_its_angle_whatever_their_noise(
    name: str, angle_rad: float, seed: int
) -> None:
    """With a level clamp it was a matter of the first row's noise whether it was 2π too large."""
    m = trial(np.full(len(T_S), angle_rad))
    leaves = np.array([np.cos(angle_rad), np.sin(angle_rad)])
    behind_mm = (m.gripper_m + 0.03 * leaves) * 1e3 + np.column_stack(
        [noise(seed), noise(seed + 9)]
    )
    points = {f"{name} {a}": behind_mm[:, k] for k, a in enumerate("xy")}
    capture = captured("a.csv", **hand_of(m), **points, **markers_of(m))
    mapping: Mapping = understood(capture).mapping
    angle = mapping.hand.angle
    assert angle.towards is not None
    places = [
        places_m(capture, c, mapping.axes, 1e-3) for c in (mapping.hand.columns, angle.towards)
    ]
    np.testing.assert_allclose(angle_towards(*places, angle.offset_rad), angle_rad, atol=1e-3)


def test_what_is_no_count_of_a_turn_stays_as_it_is() -> None:
    """An angle within ±225° comes back to the last bit; ten degrees taken as radians show."""
    for angles_rad in (np.array([3.3, 3.34, np.nan, 3.2]), np.array([10.0, 10.1])):
        np.testing.assert_array_equal(continuous(angles_rad), angles_rad)
    np.testing.assert_allclose(continuous(np.array([6.28, 0.01, np.nan, 0.02]))[3], 0.02)


def of_hand_file(m: Swing, unit: str = " [mm]", at: tuple[float, float] = (0.0, 0.0)) -> Capture:
    places = {f"tcp {a}{unit}": (m.gripper_m[:, k] + at[k]) * 1e3 for k, a in enumerate("xy")}
    return captured("hand.csv", **places)


@pytest.mark.parametrize(("count", "unit"), [(3, " [mm]"), (4, " [mm]"), (4, ""), (5, "")])
def test_a_hand_in_its_own_file_begins_the_chain(count: int, unit: str) -> None:
    """The last marker was taken for the tip, and the line between markers for the clamp."""
    m = trial(np.full(len(T_S), 0.2))
    seen = {n + unit: v for n, v in markers_of(m, count).items()}
    found = understood(captured("a.csv", **seen), of_hand_file(m, unit))
    arcs = [entry.arc_length_m for entry in found.mapping.markers]
    np.testing.assert_allclose(arcs, ARCS_M[:count], atol=5e-5)
    assert found.mapping.metres_per_unit == 1e-3
    assert found.mapping.hand.angle.constant_rad == pytest.approx(0.2, abs=0.02)
    assert "from the gripper's place at rest on" in " ".join(said(found, "markers"))


def test_a_hand_in_another_frame_begins_no_chain_and_the_tip_is_told() -> None:
    m = trial(np.full(len(T_S), 0.2))
    seen = {f"{n} [mm]": v for n, v in markers_of(m, 4).items()}
    found = understood(captured("a.csv", **seen), of_hand_file(m, at=(0.5, 0.1)))
    assert [entry.arc_length_m for entry in found.mapping.markers][-1] == LENGTH_M
    assert "'m4' taken as the cable's tip, for no place of the gripper" in " ".join(
        said(found, "markers")
    )


def test_one_marker_beside_a_hand_in_its_own_file_is_taken_for_the_tip() -> None:
    """The straight line to it is shorter than the cable, which droops."""
    m = trial(np.full(len(T_S), 0.2))
    tip = {f"tip {a} [mm]": m.markers_m[:, -1, k] * 1e3 for k, a in enumerate("xy")}
    found = understood(captured("a.csv", **tip), of_hand_file(m))
    assert [entry.arc_length_m for entry in found.mapping.markers] == [LENGTH_M]
    assert "for one marker shows no curve from the gripper on" in " ".join(said(found, "markers"))
    assert "from which a cable droops" in said(found, "hand.angle")[-1]


def test_a_hand_that_moves_from_its_first_row_on_begins_no_chain() -> None:
    m = trial(np.full(len(T_S), 0.2))
    late = gripper_file(captured("hand.csv", **{n: v[90:] for n, v in hand_of(m).items()}))
    assert late.initial is None


@pytest.mark.parametrize("jumps", [False, True])
def test_of_a_lost_marker_s_value_the_hand_is_left_out_only_where_it_jumps(jumps: bool) -> None:
    """Zeros meant a lost tip: all of the gripper's rest at (0, 0) was left out, and nobody told."""
    m = trial(np.full(len(T_S), 0.2))
    columns = {**hand_of(m), **markers_of(m)}
    for name in ("tip x", "tip y"):
        columns[name][80:84] = 0.0
    for axis in "xy" if jumps else "":
        columns[f"hand {axis}"][200:203] = 0.0
    capture = captured("a.csv", **columns)
    mapping = understood(capture).mapping
    assert mapping.lost == (0.0,)
    read = ReadMapping(mapping, Document(Path("import.yaml"), {}, {}))
    path = gripper_path(read, mapping.trials[0], capture, T_S)
    left_out = np.flatnonzero(np.isnan(path.xy_m[:, 0])).tolist()
    assert left_out == ([200, 201, 202] if jumps else [])
    assert path.note.startswith("a: the gripper is taken as not seen in 3 rows") == jumps


@pytest.mark.parametrize("dot", [True, False])
def test_a_first_marker_that_rests_while_the_tip_swings_is_at_the_clamp(dot: bool) -> None:
    """The last marker is not the tip then; without the dot it is, for all that is known."""
    m = swing("a", trial(np.zeros(240)).gripper_m, np.full(len(T_S), 0.2), 1, T_S, NOISE_M)
    dots_m = m.gripper_m + np.random.default_rng(2).normal(0.0, NOISE_M, m.gripper_m.shape)
    places_m = [*([dots_m] if dot else []), *m.markers_m[:, :4].transpose(1, 0, 2)]
    columns = {f"point {i} {a} [mm]": place[:, k] * 1e3 + 500.0
               for i, place in enumerate(places_m) for k, a in enumerate("xy")}  # fmt: skip
    found = understood(captured("a.csv", **columns), of_hand_file(m))
    arcs = [entry.arc_length_m for entry in found.mapping.markers]
    np.testing.assert_allclose(arcs, ARCS_M[:4] if dot else ARCS_M[1:], atol=1e-3)
    assert ("rests while the tip swings" in " ".join(said(found, "markers"))) == dot


@pytest.mark.parametrize("count", [1, 4])
def test_arcs_from_a_hand_in_its_own_file_state_how_well_they_are_known(count: int) -> None:
    """Of one marker that is taken for the tip nothing tells that; it once broke the proposal."""
    m = trial(np.full(len(T_S), 0.2))
    names = NAMES[:count] if count > 1 else NAMES[-1:]
    seen = {
        f"{n} {a} [mm]": m.markers_m[:, NAMES.index(n), k] * 1e3
        for n in names
        for k, a in enumerate("xy")
    }
    entries = understood(captured("a.csv", **seen), of_hand_file(m)).mapping.markers
    assert len(entries) == count
    stds = [entry.arc_length_std_m for entry in entries]
    assert stds == [None] if count == 1 else all(s is not None and 0.0 < s < 1e-3 for s in stds)


UNIT = 2.0 * np.pi / 4096
TURNS = TurnsSection(
    column="enc", radians_per_unit=UNIT, axle_m=(0.1, 0.2), radius_m=0.5, offset_rad=0.3
)


def capture(values: np.ndarray) -> Capture:
    return Capture(
        Path("a.csv"), (CapturedColumn("enc"),), values[:, None], np.arange(len(values)) + 2
    )


@pytest.mark.parametrize(
    ("values", "count"),
    [
        ([3.0, 3.0, 4.0, 6.0, 9.0], 1.0),
        ([0.25, 0.5, 1.75, np.nan], 0.25),
        ([10.0, 14.0, 22.0], 4.0),
        ([0.0, 7.0, 15.0, 22.0], 1.0),
        ([0.1, 0.2734, 0.5, 0.61], 0.0),
        ([3.0, 4.0, 3.0], 0.0),
    ],
)
def test_counts_are_whole_multiples_of_a_step(values: list[float], count: float) -> None:
    assert count_of(np.array(values)) == pytest.approx(count)


def test_a_turn_is_followed_over_a_whole_one_within_its_counts() -> None:
    true = np.concatenate([np.zeros(50), np.linspace(0.0, 700.0, 100), np.full(50, 700.0)]) + 3900.0
    found = turn_of(capture(np.round(true) % 4096), TURNS)
    wanted = (true - 4096.0) * UNIT + 0.3
    np.testing.assert_allclose(found.angle_rad, wanted, atol=1.01 * UNIT)
    assert found.count_rad == pytest.approx(UNIT)
    assert np.std(found.angle_rad[:50]) == pytest.approx(UNIT / np.sqrt(12.0), rel=0.2)
    assert found.moves is not None
    assert 50 <= found.moves[0] < 55
    assert 145 < found.moves[1] < 150


def test_an_arm_that_does_not_move_stays() -> None:
    found = turn_of(capture(np.full(30, 100.0)), TURNS)
    assert found.moves is None
    assert np.ptp(found.angle_rad) == 0.0


def test_the_arm_points_to_the_left_and_turns_down() -> None:
    places = place_m(np.array([0.0, np.pi / 2.0]), TURNS)
    np.testing.assert_allclose(places, [[-0.4, 0.2], [0.1, -0.3]], atol=1e-12)


def test_a_stated_angle_takes_the_place_of_the_estimate() -> None:
    m = trial(np.full(len(T_S), 0.02))
    found = understood(captured("a.csv", **hand_of(m), **markers_of(m)), angle_rad=0.0)
    assert found.mapping.hand.angle.constant_rad == 0.0
    (sentence,) = said(found, "hand.angle")
    assert sentence == "the clamp angle is 0.00°, constant, as --clamp-angle says"


def test_an_angle_that_the_cable_or_a_column_contradicts_is_refused() -> None:
    m = trial(np.full(len(T_S), 0.5))
    columns = hand_of(m) | markers_of(m)
    with pytest.raises(InputError, match=r"states 0\.0°, but at rest .* at 2\d\.\d°, limit 20°"):
        understood(captured("a.csv", **columns), angle_rad=0.0)
    columns["hand angle_deg"] = np.degrees(m.angle_rad) + np.degrees(noise(1))
    with pytest.raises(InputError, match=r"'hand angle_deg' in deg.* give offset_rad: -0\.1\d*"):
        understood(captured("a.csv", **columns), angle_rad=0.4)
    found = understood(captured("a.csv", **columns), angle_rad=0.5)
    assert found.mapping.hand.angle.column == "hand angle_deg"
    assert said(found, "hand.angle")[-1] == "at rest it is 28.65°, as --clamp-angle says"


def headings_of(m: Swing) -> dict[str, np.ndarray]:
    """Directions in which the markers move, degrees, as trackers list them for every track."""
    places_m = np.concatenate([m.gripper_m[:, None], m.markers_m], axis=1)
    places_m = places_m + np.random.default_rng(1).normal(0.0, NOISE_M, places_m.shape)
    steps_m = np.diff(places_m, axis=0)
    angle = np.degrees(np.arctan2(steps_m[..., 1], steps_m[..., 0]))
    angle = np.concatenate([np.full((1, angle.shape[1]), np.nan), angle])
    columns = {}
    for i in range(len(ARCS_M) + 1):
        columns |= {f"marker {i} {a}": places_m[:, i, k] * 1e3 for k, a in enumerate("xy")}
        columns[f"marker {i} angle [deg]"] = angle[:, i]
    return columns


@pytest.mark.parametrize("stated_rad", [None, 0.0])
@pytest.mark.parametrize("first_row", [True, False])
def test_a_direction_of_motion_is_no_clamp_angle(stated_rad: float | None, first_row: bool) -> None:
    """It was taken for it, and a stated angle was refused for it."""
    columns = headings_of(trial(np.zeros(len(T_S))))
    columns = {n: v if first_row else v[1:] for n, v in columns.items()}
    angle = understood(captured("a.csv", **columns), angle_rad=stated_rad).mapping.hand.angle
    assert angle.constant_rad == pytest.approx(0.0, abs=0.0 if stated_rad == 0.0 else 0.05)


def test_a_stated_angle_outranks_a_column_that_is_only_guessed() -> None:
    m = trial(np.zeros(len(T_S)))
    columns = hand_of(m) | {"angle [deg]": np.degrees(noise(1) + 0.1)} | markers_of(m)
    assert understood(captured("a.csv", **columns)).mapping.hand.angle.column == "angle [deg]"
    found = understood(captured("a.csv", **columns), angle_rad=0.0)
    assert found.mapping.hand.angle.constant_rad == 0.0
    assert "angle [deg]" in " ".join(said(found, "unused"))


@pytest.mark.parametrize(("off_deg", "is_near"), [(5.0, True), (30.0, False)])
def test_an_offset_near_a_quarter_turn_says_the_other_choice(off_deg: float, is_near: bool) -> None:
    m = trial(0.2 * stroke(T_S))
    line_rad = m.angle_rad + np.radians(off_deg)
    behind_m = m.gripper_m + 0.03 * np.column_stack([np.cos(line_rad), np.sin(line_rad)])
    points = {f"gripb {a}": behind_m[:, k] * 1e3 for k, a in enumerate("xy")}
    (sentence,) = said(
        understood(captured("a.csv", **hand_of(m), **points, **markers_of(m))), "hand.angle"
    )
    assert "± 3.0° as the cable shows at rest" in sentence
    assert ("give offset_rad: 3.14159 if the jaws are parallel" in sentence) is is_near
