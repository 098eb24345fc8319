"""A robot's log of a turning gripper, in its own frame and on its own clock."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cell.files.input_error import InputError
from cell.files.yaml_document import Document
from cell.study.imports.body_orientation import forms_of_four
from cell.study.imports.cable_root import CURVE_STD, root_of_shape
from cell.study.imports.capture import Capture, CapturedColumn, Sure
from cell.study.imports.convert import study_of
from cell.study.imports.gripper_section import AngleSection
from cell.study.imports.mapping import ReadMapping
from cell.study.imports.places import clamp_angle_rad
from cell.study.imports.robot_poses import with_quaternions
from cell.study.imports.understand import Files, Stated, Understanding, understand
from tests.cell.study.imports.corpus.swing import LENGTH_M, MARKERS, stroke, swing

T_S, LOG_S = np.arange(0.0, 1.6, 0.005), np.arange(-0.2, 1.6, 0.004)
#: Greatest error of an angle whose axis is exact.
EXACT_RAD = np.radians(0.05)
#: Names of the numbers of an orientation, and the order of its turns; a quaternion has none.
FORMS = {
    "mecademic": ([f"RtCartPos_{a}" for a in ("Alpha", "Beta", "Gamma")], "XYZ"),
    "kuka": (["C", "B", "A"], "ZYX"),
    "vector": ([f"tcp r{a}" for a in "xyz"], "vector"),
    "roll": ([f"tcp {a}" for a in ("roll", "pitch", "yaw")], "ZYX"),
    "quaternion": ([f"tcp q{a}" for a in "xyzw"], ""),
    "abb": ([f"q{k}" for k in "1234"], "w first"),
}
PLACES = {"mecademic": "RtCartPos_{}", "kuka": "{}", "abb": "{}"}


def numbers_of(turned: Rotation, order: str) -> np.ndarray:
    """Numbers of the orientations, as a program writes them."""
    if order == "vector":
        return turned.as_rotvec()
    if order in ("", "w first"):
        return np.roll(turned.as_quat(), 1 if order else 0, axis=1)
    angles = turned.as_euler(order, degrees=True)
    return angles[:, [order.index(axis) for axis in "XYZ"]]


class Log:
    """A made trial: markers in a plane of the room, and a log of the gripper."""

    def __init__(self, form: str, seed: int, turn_rad: float, mount: Rotation | None = None):
        rng = np.random.default_rng(seed)
        names, order = FORMS[form]
        names = [f"{n} [deg]" for n in names] if form == "roll" else names
        angle_rad = 0.0 + turn_rad * stroke(T_S)
        self.angle_rad = turn_rad * stroke(LOG_S)
        m = swing("a", np.outer(stroke(T_S), [0.0, -0.04]), angle_rad, seed, T_S, 3e-5)
        points = np.concatenate([m.gripper_m[:, None], m.markers_m], axis=1)
        spatial = 1e3 * points @ np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        heads = [f"{n} {a} [mm]" for n in ("clamp", *MARKERS) for a in "XYZ"]
        self.markers = captured("m.csv", heads, T_S, spatial.reshape(len(T_S), -1))
        azimuth = rng.uniform(-np.pi, np.pi)
        right = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        normal = np.cross(right, [0.0, 0.0, 1.0])
        xyz = np.array([0.4, -0.1, 0.6]) + np.outer(stroke(LOG_S), [0.0, 0.0, -0.04])
        body = Rotation.from_matrix(np.column_stack([right, [0.0, 0.0, 1.0], normal]))
        level = [g for g in Rotation.create_group("O") if abs((body * g).as_matrix()[2, 0]) < 0.5]
        body = body * (mount or level[rng.integers(len(level))])
        turned = Rotation.from_rotvec(np.outer(self.angle_rad, normal)) * body
        place = PLACES.get(form, "tcp {}")
        heads = [f"{place.format(a)} [mm]" for a in "XYZ"] + names
        rows = np.column_stack([1e3 * xyz, numbers_of(turned, order)])
        self.log = captured("log.csv", heads, LOG_S + 312.5, rows)

    def understood(self, stated_rad: float | None = None) -> Understanding:
        """The proposed mapping."""
        files = Files("a", "m.csv", self.markers, "log.csv", self.log)
        stated = Stated("a", LENGTH_M, 0.0074, 0.016, 1e-4, clamp_angle_rad=stated_rad)
        return understand([files], stated)

    def error_rad(self, found: Understanding) -> float:
        """Greatest error of the clamp angle."""
        hand = found.mapping.hand
        angle_rad = clamp_angle_rad(self.log, hand.angle, hand.axes or found.mapping.axes)
        assert angle_rad is not None
        return float(np.abs(angle_rad - self.angle_rad).max())


def captured(name: str, heads: list[str], t_s: np.ndarray, rows: np.ndarray) -> Capture:
    columns = (CapturedColumn("time [s]"), *(CapturedColumn(h) for h in heads))
    values = np.column_stack([t_s, rows])
    return with_quaternions(Capture(Path(name), columns, values, np.arange(len(values)) + 2))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("turn_rad", [0.35, -0.35])
@pytest.mark.parametrize("seed", range(3))
def test_the_turn_shows_the_plane_in_which_a_robot_moves_up_and_down(
    form: str, turn_rad: float, seed: int
) -> None:
    """Right was the first of the robot's axes: the angle was wrong by up to the whole turn."""
    log = Log(form, seed, turn_rad)
    found = log.understood()
    assert log.error_rad(found) < EXACT_RAD, (found.mapping.hand, found.findings)


@pytest.mark.parametrize("turn_rad", [0.35, -0.35, 0.0])
@pytest.mark.parametrize("order", ["XYZ", "ZYX", "ZXY"])
def test_three_angles_are_one_rotation_whatever_their_order(
    order: str, turn_rad: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of them alone was taken as the clamp angle, for it was 0 throughout."""
    names = [f"tcp {a} [deg]" for a in ("alpha", "beta", "gamma")]
    monkeypatch.setitem(FORMS, "any", (names, order))
    log = Log("any", 1, turn_rad, Rotation.from_euler("XYZ", [40, 30, 50], degrees=True))
    found = log.understood()
    assert len(found.mapping.hand.angle.rotation or ()) == len("xyz")
    assert log.error_rad(found) < CURVE_STD


def test_an_angle_of_the_log_that_changes_is_not_left_out_without_a_word() -> None:
    log = Log("quaternion", 1, 0.35)
    heads = ["tool tilt angle", "tool other angle"]
    values = np.column_stack([np.zeros(len(LOG_S)), np.degrees(log.angle_rad)])
    log.log = log.log.with_columns([CapturedColumn(h) for h in heads], values)
    unused = [f.sentence for f in log.understood().findings if f.entry == "unused"]
    assert "tool other angle" in unused[-1]
    assert "tool tilt angle" not in unused[-1]


@pytest.mark.parametrize("form", ["quaternion", "vector", "kuka"])
@pytest.mark.parametrize("stated_rad", [0.0, 0.1])
def test_a_stated_angle_fixes_the_offset_of_a_gripper_that_does_not_turn(
    form: str, stated_rad: float
) -> None:
    """It was refused, for the log has the orientation."""
    log = Log(form, 2, 0.0, Rotation.from_euler("z", 25, degrees=True))
    found = log.understood(stated_rad)
    log.angle_rad = np.full(len(LOG_S), stated_rad)
    assert log.error_rad(found) < 1e-6
    about = [f for f in found.findings if f.entry.startswith("hand.angle")]
    assert [f.sure for f in about] == [Sure.STATED]
    assert "as --clamp-angle says" in about[0].sentence


def test_a_stated_angle_of_a_gripper_that_turns_is_refused() -> None:
    with pytest.raises(InputError, match="but the gripper turns as"):
        Log("quaternion", 2, 0.35).understood(0.0)


def test_a_quaternion_that_states_its_letters_is_not_reordered() -> None:
    """Or one that is computed from a matrix; letters of unnamed columns state nothing."""

    def forms(names: list[str], computed: bool = False) -> list[AngleSection]:
        columns = tuple(CapturedColumn(name, computed=computed) for name in names)
        return forms_of_four(Capture(Path("a.csv"), columns, np.ones((3, 4)), np.arange(3)), names)

    assert forms([f"ee q{a}" for a in "xyzw"]) == [
        AngleSection(quaternion=[f"ee q{a}" for a in "xyzw"])
    ]
    assert forms([f"ee quaternion {a}" for a in "xyzw"], computed=True) == [
        AngleSection(quaternion=[f"ee quaternion {a}" for a in "xyzw"])
    ]
    assert len(forms([f"ee quaternion {a}" for a in "xyzw"])) == 2
    assert len(forms([f"quat[{k}]" for k in range(4)])) == 2


@pytest.mark.parametrize("arcs", [(0.1, 0.07, 0.04), (0.1, 0.06, 0.02), (0.1, 0.08, 0.05, 0.03)])
@pytest.mark.parametrize("weight", [1.0, 3.0])
def test_the_error_of_the_root_is_within_its_estimate(
    arcs: tuple[float, ...], weight: float
) -> None:
    """An exact axis of the body was turned by the error of a curve through three markers.

    The cable is a level cantilever under its own weight, whose deflection is known.
    """
    s = np.array([0.0, *arcs[::-1]])
    sag = 0.02 * weight * (6.0 * s**2 / 0.01 - 4.0 * s**3 / 0.001 + s**4 / 0.0001)
    root = root_of_shape(np.column_stack([-s, -sag / 6.0]), arcs[::-1], from_gripper=True)
    assert abs(root.rest_rad) < root.std_rad
    assert root.offset_rad(0.0) == 0.0


def refusal(log: Log, found: Understanding, change: dict[str, object]) -> str:
    """What the second call says of a mapping whose gripper has been edited; empty = nothing."""
    hand = found.mapping.hand
    angle = hand.angle.model_copy(update={k: v for k, v in change.items() if k != "axes"})
    hand = hand.model_copy(update={"angle": angle, "origin_m": None})
    if "axes" in change:
        hand = hand.model_copy(update={"axes": change["axes"]})
    mapping = found.mapping.model_copy(update={"hand": hand})
    read = ReadMapping(mapping, Document(Path("import.yaml"), {}, {(): (1, 1)}))
    try:
        study_of(read, {"m.csv": log.markers, "log.csv": log.log})
    except InputError as error:
        return str(error)
    return ""


def test_the_second_call_refuses_an_angle_that_the_cable_contradicts() -> None:
    """An angle 45° off was written without a word, and the remedy for a wrong axis did not help."""
    log = Log("quaternion", 1, 0.35)
    found = log.understood()
    angle, axes = found.mapping.hand.angle, found.mapping.hand.axes
    assert axes is not None
    other = str(angle.body_axis).translate(str.maketrans("+-", "-+"))
    mirrored = axes.model_copy(update={"right": [-v for v in axes.right]})
    assert refusal(log, found, {}) == ""
    said = refusal(log, found, {"offset_rad": 0.8})
    assert f"limit 20° apart; give body_axis: {angle.body_axis}, without offset_rad" in said
    constant = AngleSection(constant_rad=0.8).model_dump()
    assert "hand.angle.constant_rad: makes the clamp angle" in refusal(log, found, constant)
    assert f"give body_axis: {other}" in refusal(log, found, {"axes": mirrored})
    said = refusal(log, found, {"axes": mirrored, "body_axis": other})
    assert "reverse both body_axis and `right` of the gripper's axes" in said
