"""A gripper that is told by an encoder or an accelerometer: proposed, imported, or refused."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.study.data import Study
from cell.study.folder import read_study
from tests.cell.study.imports.corpus.swing import BEGINS_S, ENDS_S, RATE_HZ, Swing, stroke, swing
from tests.cell.study.imports.corpus.swing import MARKERS as NAMES
from tests.cell.study.imports.corpus.text import saved
from tests.cell.study.imports.made import (
    CABLE,
    NOISE_M,
    check_same,
    digits,
    filled,
    made,
    run,
    text,
)

AXLE_M, RADIUS_M, COUNTS = (0.05, 0.1), 0.12, 65536
MOVED_S = ENDS_S - BEGINS_S
SENSOR = "hand.acceleration"


def on_arm() -> tuple[Swing, np.ndarray]:
    """The cable on an arm that turns down by 0.4 rad, the clamp 0.1 rad steeper; its turn."""
    t = np.arange(0.0, 1.8, 1.0 / RATE_HZ)
    turn = 0.1 + 0.4 * stroke(t)
    hand = np.array(AXLE_M) - RADIUS_M * np.column_stack([np.cos(turn), np.sin(turn)])
    return swing("arm", hand, turn + 0.1, 1, t, NOISE_M), turn


def straight(rate_hz: float = 1000.0) -> tuple[Swing, np.ndarray, np.ndarray, np.ndarray]:
    """The cable on a gripper that goes down and turns; its fine times, acceleration and angle."""
    t = np.arange(0.0, 1.8, 1.0 / rate_hz)
    u = np.clip((t - BEGINS_S) / MOVED_S, 0.0, 1.0)
    done = stroke(t)
    bent = (60 * u - 180 * u**2 + 120 * u**3) / MOVED_S**2
    every = slice(None, None, round(rate_hz / RATE_HZ))
    way_m = np.array([0.01, -0.05])
    hand, angle = done[:, None] * way_m, 0.2 + 0.15 * done
    m = swing("down", hand[every], angle[every], 1, t[every], NOISE_M)
    return m, t, bent[:, None] * way_m, angle


def wide(m: Swing, columns: dict[str, np.ndarray], file: Path) -> Path:
    """A table of markers in mm, with other columns in place of the gripper's."""
    names = ["t_s", *columns, *(f"{n}_{a}_mm" for n in NAMES for a in "xy")]
    markers = m.markers_m.reshape(len(m.t_s), -1) * 1e3
    values = np.column_stack([m.t_s, *columns.values(), markers])
    file.write_text(text([names, *digits(values, 9)]))
    return file


def sensor_file(
    folder: Path, t: np.ndarray, acceleration: np.ndarray, angle: np.ndarray, unit: str = "g"
) -> Path:
    """A log of a sensor that turns with the clamp: noise of 0.02 m/s², an offset of 0.1 m/s²."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = (acceleration - [0.0, -9.81]).T
    shown = np.column_stack([c * x + s * y, c * y - s * x])
    shown += np.array([0.1, -0.1]) + 0.02 * np.random.default_rng(5).normal(size=shown.shape)
    values = np.column_stack([t, shown / (9.80665 if unit == "g" else 1.0), np.degrees(angle)])
    names = ["time [s]", f"acc_x [{unit}]", f"acc_y [{unit}]", "clamp_angle [deg]"]
    return saved(folder / "sensor.csv", text([names, *digits(values, 9)]))


def hand_of(study: Study) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    grip = study.trials[0].grip
    return grip.t_s, np.column_stack([grip.x_m, grip.y_m]), grip.angle_rad


def test_an_encoder_of_an_axle_is_proposed_and_imported(tmp_path: Path) -> None:
    m, turn = on_arm()
    counts = (np.round((turn + 2.0) * COUNTS / (2 * np.pi)) + COUNTS - 22000) % COUNTS
    assert counts[-1] < counts[0], "it begins anew as it turns"
    file, folder = wide(m, {"arm_encoder": counts}, tmp_path / "trial.csv"), tmp_path / "s"
    said = run(str(file), "-o", str(folder), *CABLE, code=1)
    assert "'arm_encoder' tells how its arm turns" in said
    assert "give hand.turns.axle_m" in said
    mapping = folder / "import.yaml"
    said = run(str(mapping), code=2)
    for key in ("axle_m", "radius_m", "radians_per_unit"):
        assert re.search(rf"import\.yaml:\d+:\d+: hand\.turns\.{key}: is not known", said), said
    offset = -2.0 + 22000 * 2 * np.pi / COUNTS
    turns = {"axle_m": list(AXLE_M), "radius_m": RADIUS_M, "radians_per_unit": 2 * np.pi / COUNTS}
    filled(mapping, {f"hand.turns.{k}": v for k, v in turns.items()})
    filled(mapping, {"hand.turns.offset_rad": offset, "hand.angle.offset_rad": 0.1})
    run(str(mapping))
    t_s, xy_m, angle_rad = hand_of(read_study(folder))
    np.testing.assert_allclose(t_s, m.t_s, atol=1e-9)
    count_rad = 2.0 * np.pi / COUNTS  # half by the encoder, half by its dither
    np.testing.assert_allclose(xy_m, m.gripper_m, atol=RADIUS_M * count_rad)
    np.testing.assert_allclose(angle_rad, m.angle_rad, atol=count_rad)
    drift = read_study(folder).trials[0].hand_drift
    assert drift is not None
    assert drift.turn_std_rad == pytest.approx(count_rad / np.sqrt(12.0))
    assert (drift.from_s, drift.to_s) == pytest.approx((BEGINS_S, BEGINS_S + MOVED_S), abs=0.03)
    assert (drift.axle_m, drift.clamp_turns) == (AXLE_M, True)


def test_too_few_counts_are_refused(tmp_path: Path) -> None:
    m, turn = on_arm()
    file = wide(m, {"encoder": np.round(turn * 200 / (2 * np.pi))}, tmp_path / "trial.csv")
    run(str(file), "-o", str(tmp_path / "s"), *CABLE, code=1)
    turns = {"axle_m": list(AXLE_M), "radius_m": RADIUS_M, "radians_per_unit": 2 * np.pi / 200}
    filled(tmp_path / "s" / "import.yaml", {f"hand.turns.{k}": v for k, v in turns.items()})
    said = run(str(tmp_path / "s" / "import.yaml"), code=2)
    assert "one count moves the cable by 6.9 mm, limit 2 mm" in said


def test_a_clamp_on_its_axle_stays_there_and_turns(tmp_path: Path) -> None:
    m, turn = on_arm()
    places_m = m.markers_m - m.gripper_m[:, None]
    still = replace(m, gripper_m=0.0 * m.gripper_m, angle_rad=turn, markers_m=places_m)
    file = wide(still, {"encoder_deg": -np.degrees(turn)}, tmp_path / "trial.csv")
    run(str(file), "-o", str(tmp_path / "s"), *CABLE, code=1)
    mapping = tmp_path / "s" / "import.yaml"
    turns = {"axle_m": [0, 0], "radius_m": 0, "radians_per_unit": -np.pi / 180}
    filled(mapping, {f"hand.turns.{k}": v for k, v in turns.items()})
    run(str(mapping))
    _, xy_m, angle_rad = hand_of(read_study(tmp_path / "s"))
    assert not xy_m.any()
    np.testing.assert_allclose(angle_rad, turn, atol=1e-9)
    assert read_study(tmp_path / "s").trials[0].hand_drift is None, "nothing is rounded"


@pytest.fixture(scope="module")
def proposal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an accelerometer's log, with the mapping as proposed."""
    folder = tmp_path_factory.mktemp("proposal")
    m, t, acceleration, angle = straight()
    markers, log = wide(m, {}, folder / "film.csv"), sensor_file(folder, t, acceleration, angle)
    said = run(str(markers), "--hand", str(log), "-o", str(folder / "s"), *CABLE, code=1)
    assert "it is integrated from acceleration" in said
    assert "give hand.acceleration.starts_at_m" in said
    assert "starts_at_m: is not known" in run(str(folder / "s" / "import.yaml"), code=2)
    return folder


@pytest.fixture
def mapping(proposal: Path, tmp_path: Path) -> Path:
    """The same, of the test's own, filled in."""
    shutil.copytree(proposal, tmp_path, dirs_exist_ok=True)
    mapping = tmp_path / "s" / "import.yaml"
    filled(mapping, {"hand.acceleration.starts_at_m": [0, 0]})
    return mapping


def test_an_accelerometer_is_proposed_and_integrated(mapping: Path, tmp_path: Path) -> None:
    said = run(str(mapping))
    stated = re.search(r"standard deviation is at most ([\d.e-]+) mm", said)
    assert stated, said
    _, t, _, angle = straight()
    study = read_study(tmp_path / "s")
    t_s, xy_m, angle_rad = hand_of(study)
    np.testing.assert_allclose(angle_rad, np.interp(t_s, t, angle), atol=1e-6)
    path_m = stroke(t_s)[:, None] * [0.01, -0.05]
    limit_m = 4e-3 * float(stated[1])
    assert 2e-5 < limit_m < 4e-4
    np.testing.assert_allclose(xy_m, path_m, atol=limit_m)
    drift = study.trials[0].hand_drift
    assert drift is not None
    assert drift.from_s == pytest.approx(BEGINS_S, abs=0.03)


def test_where_the_hand_ends_is_met(mapping: Path, tmp_path: Path) -> None:
    filled(mapping, {"trials.0.hand_ends_at_m": [0.01, -0.05]})
    run(str(mapping))
    study = read_study(tmp_path / "s")
    np.testing.assert_allclose(hand_of(study)[1][-1], [0.01, -0.05], atol=1e-9)
    drift = study.trials[0].hand_drift
    assert drift is not None
    assert drift.ends_known


@pytest.mark.parametrize(
    ("entries", "place", "remedy"),
    [
        ({f"{SENSOR}.m_per_s2_per_unit": 1.0}, f"{SENSOR}.m_per_s2_per_unit", "give 9.81 for g"),
        ({f"{SENSOR}.m_per_s2_per_unit": -9.81}, "m_per_s2_per_unit", "the sensor shows g − a"),
        ({"hand.angle.radians_per_unit": -0.0174533}, f"{SENSOR}.columns", "offset_rad of hand"),
        ({f"{SENSOR}.along": "study"}, "hand.acceleration.columns", "correct hand.axes"),
        ({"hand.angle.offset_rad": 0.05}, "sensor.csv:", "give its angle"),
    ],
)  # fmt: skip
def test_a_mapping_that_contradicts_the_sensor_is_refused(
    entries: dict[str, Any], place: str, remedy: str, mapping: Path
) -> None:
    filled(mapping, entries)
    said = run(str(mapping), code=2)
    assert place in said
    assert remedy in said


def test_an_angle_may_be_logged_less_often(mapping: Path, tmp_path: Path) -> None:
    run(str(mapping))
    whole = hand_of(read_study(tmp_path / "s"))
    log = tmp_path / "sensor.csv"
    rows = [line.split(",") for line in log.read_text().splitlines()]
    for k, row in enumerate(rows[1:-1]):
        row[3] = row[3] if k % 10 == 0 else ""
    log.write_text(text(rows))
    run(str(mapping), "--force")
    t_s, xy_m, _ = hand_of(read_study(tmp_path / "s"))
    np.testing.assert_array_equal(t_s[::10], whole[0][::10][: len(t_s[::10])])
    np.testing.assert_allclose(xy_m[-1], whole[1][-1], atol=2e-5)


def test_where_the_hand_ends_is_of_no_use_to_an_encoder(mapping: Path) -> None:
    turns = {"column": "acc_x [g]", "radians_per_unit": 1, "axle_m": [0, 0], "radius_m": 0}
    hand = {"turns": turns, "angle": {"follows": True}}
    drift = {"from_s": 1.0, "to_s": 0.5}
    filled(mapping, {"hand": hand, "trials.0.hand_ends_at_m": [0, 0], "trials.0.hand_drift": drift})
    said = run(str(mapping), code=2)
    assert (
        "trials[0].hand_ends_at_m: is only for a gripper that is told by its acceleration" in said
    )
    assert "trials[0].hand_drift.to_s: 0.5 s is not after from_s, 1 s" in said


def test_a_sensor_that_is_lost_in_the_motion_is_refused_with_its_line(
    mapping: Path, tmp_path: Path
) -> None:
    log = tmp_path / "sensor.csv"
    lines = log.read_text().splitlines()
    log.write_text("\n".join(lines[:500] + lines[520:]) + "\n")
    said = run(str(mapping), code=2)
    assert "sensor.csv:501" in said
    assert "without gaps" in said


@pytest.mark.parametrize(
    ("hand", "remedy"),
    [
        ({}, "turns by an encoder of its axle, acceleration by"),
        ({"fixed_m": [0, 0], "angle": {"follows": True}}, "is only for a gripper that `turns`"),
        ({"columns": [None, None]}, "are all null"),
    ],
)
def test_a_hand_that_is_told_in_no_way_is_refused_with_the_ways(
    hand: dict[str, Any], remedy: str, mapping: Path
) -> None:
    filled(mapping, {"hand": {"angle": {"constant_rad": 0}} | hand})
    assert remedy in run(str(mapping), code=2)


def test_sensors_of_other_things_are_no_hand_s(tmp_path: Path) -> None:
    """An accelerometer at the tip is not the gripper's; where a gripper is seen, nor is an
    encoder."""
    m, _ = on_arm()
    still = np.zeros_like(m.t_s)
    hand = {"hand_x_mm": 1e3 * m.gripper_m[:, 0], "hand_y_mm": 1e3 * m.gripper_m[:, 1]}
    encoder = {"encoder_deg": np.degrees(m.angle_rad)}
    of_tip = wide(m, {"tip_acc_x": still, "tip_acc_y": still}, tmp_path / "tip.csv")
    said = run(str(of_tip), "-o", str(tmp_path / "s"), *CABLE, code=1)
    assert "'m1', the end of the chain that moves least, swings" in said
    of_arm = wide(m, {**encoder, **hand}, tmp_path / "arm.csv")
    said = run(str(of_arm), "-o", str(tmp_path / "s"), "--force", *CABLE)
    assert "the clamp angle is column 'encoder_deg'" in said


def test_without_a_hand_its_sensors_are_asked_for(tmp_path: Path) -> None:
    m, turn = on_arm()
    log = tmp_path / "robot.csv"
    log.write_text(text([["time_s", "voltage"], *digits(np.column_stack([m.t_s, turn]))]))
    file = wide(m, {}, tmp_path / "film.csv")
    study = tmp_path / "s"
    said = run(str(file), "--hand", str(log), "-o", str(study), *CABLE, code=1)
    assert "accelerometer on it in hand.acceleration" in said
    assert "columns of robot.csv: time_s, voltage" in said
    refused = run(str(study / "import.yaml"), code=2)  # it is there, to be filled in
    assert "give one of: columns of the gripping point" in refused


@pytest.mark.parametrize(
    ("name", "scale", "way_m"),
    [
        ("Position (m) Run #1", 1.0, (0.0, -0.05)),
        ("distance [mm]", -1e3, (0.0, -0.05)),
        ("Laser x [mm]", -1e3, (0.06, 0.0)),
    ],
)
def test_a_sensor_of_one_coordinate_is_a_hand_with_clock_origin_and_axes(
    name: str, scale: float, way_m: tuple[float, float], tmp_path: Path
) -> None:
    """Its columns were asked for, and then nothing else was proposed."""
    t = np.arange(0.0, 1.8, 1.0 / RATE_HZ)
    hand_m = stroke(t)[:, None] * np.array(way_m)
    m = swing("one", hand_m, np.zeros(len(t)), 1, t, NOISE_M)
    file = wide(m, {}, tmp_path / "trial.csv")
    along = int(way_m[0] == 0.0)
    shown = 0.8 * abs(scale) + scale * hand_m[:, along]
    rows = np.column_stack([t + 0.3, shown, 0.0 * t])
    header = ["Time (s) Run #1", name, "Velocity (m/s) Run #1"]
    log = saved(tmp_path / "sensor.csv", text([header, *digits(rows, 6)]))
    said = run(file, "--hand", log, "--clamp-angle", "0", "-o", tmp_path / "s", *CABLE)
    assert f"{name!r} is the gripper's place along {('right', 'up')[along]}" in said
    run(tmp_path / "s" / "import.yaml")
    t_s, xy_m, _ = hand_of(read_study(tmp_path / "s"))
    np.testing.assert_allclose(t_s, m.t_s, atol=0.01)
    moved_m = xy_m - xy_m[0] + m.gripper_m[0]
    np.testing.assert_allclose(moved_m, m.gripper_m, atol=2e-6)
    np.testing.assert_allclose(xy_m[0], m.gripper_m[0], atol=1e-3)


def test_of_two_lengths_none_is_chosen(tmp_path: Path) -> None:
    m, _, _, _ = straight()
    file = wide(m, {}, tmp_path / "trial.csv")
    rows = np.column_stack([m.t_s, m.gripper_m])
    log = saved(tmp_path / "s.csv", text([["t [s]", "left [m]", "top [m]"], *digits(rows, 6)]))
    said = run(file, "--hand", log, "-o", tmp_path / "s", *CABLE, code=1)
    assert "no place of the gripper is known in s.csv: name two columns of it" in said


def test_groups_of_columns_with_a_rate_each_are_asked_for_with_a_remedy_that_works(
    tmp_path: Path,
) -> None:
    """Markers at 200 Hz and a gripper at 500 Hz in one table, as npTDMS writes them."""
    m = made()
    hand_s = np.arange(round(2.5 * len(m.t_s))) / 500.0
    hand = np.column_stack([1e3 * m.gripper_m, np.degrees(m.angle_rad)])
    rows: list[list[object]] = [["", *(f"{n}_{a}_mm" for n in NAMES for a in "xy")]]
    rows[0] += ["robot_x_mm", "robot_y_mm", "robot_pitch_deg"]
    markers = digits(1e3 * m.markers_m.reshape(len(m.t_s), -1), 7)
    blank = [""] * len(markers[0])
    path = [np.interp(hand_s, m.t_s, column) for column in hand.T]
    for k, row in enumerate(digits(np.column_stack(path), 7)):
        rows.append([k, *(markers[k] if k < len(markers) else blank), *row])
    file, rate = saved(tmp_path / "run.csv", text(rows)), ("--rate", "200")
    said = run(file, "-o", tmp_path / "s", *CABLE, *rate, code=1)
    assert "if each has its own rate, give --hand run.csv for its gripper, too" in said
    said = run(file, "--hand", file, "-o", tmp_path / "t", *CABLE, *rate, code=1)
    assert "give hand.time.seconds_per_unit" in said and "or --rate" not in said
    filled(tmp_path / "t" / "import.yaml", {"hand.time.seconds_per_unit": 0.002})
    run(tmp_path / "t" / "import.yaml")
    check_same(read_study(tmp_path / "t"), m, place_m=2e-4, angle_rad=2e-3)
