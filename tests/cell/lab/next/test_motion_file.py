"""Motions from files: places from home, every mistake with its place, nothing too fast."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cell.files.input_error import InputError
from cell.lab.next.motion_file import hand_motion, load_motion
from cell.settings import Settings, load_settings
from cell.settings.model import HandPose
from drivers.interfaces import Pose

CONFIG = Path(__file__).parents[4] / "config" / "fake.yaml"

RIGHT = """\
format: cell-motion/1
purpose: tell air_drag from baseline
start: {x_m: 0.0, y_m: 0.0, angle_rad: 0.05}
still_s: 0.2
moves:
  - {x_m: 0.0, y_m: -0.05, angle_rad: 0.05, duration_s: 0.27}
  - {x_m: -0.02, y_m: -0.05, angle_rad: 0.0, duration_s: 0.4}
hold_s: 1.0
"""


@pytest.fixture(scope="module")
def settings() -> Settings:
    return load_settings(CONFIG)


def written(tmp_path: Path, text: str, name: str = "tilted.yaml") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_places_count_from_home_and_angles_from_level(settings: Settings, tmp_path: Path) -> None:
    home = HandPose(x_m=0.01, y_m=-0.01, angle_rad=0.02)
    moved = settings.motion.model_copy(update={"home": home})
    it = load_motion(written(tmp_path, RIGHT), settings.model_copy(update={"motion": moved}))
    assert it.name == "tilted"
    assert it.start == Pose(0.01, -0.01, 0.05)
    assert [m.duration_s for m in it.moves] == [0.27, 0.4]
    goals = [(m.goal.x_m, m.goal.y_m, m.goal.angle_rad) for m in it.moves]
    assert goals[0] == pytest.approx((0.01, -0.06, 0.05))
    assert goals[1] == pytest.approx((-0.01, -0.06, 0.0))
    assert (it.still_s, it.hold_s) == (0.2, 1.0)


def test_a_pose_on_its_limit_is_not_refused_for_its_rounding(
    settings: Settings, tmp_path: Path
) -> None:
    """Sums of floating-point numbers exceed a limit that their decimals keep; 2 µm are refused."""
    up = RIGHT.replace("y_m: -0.05, angle_rad: 0.05", "y_m: 0.0200000001, angle_rad: 0.05")
    assert load_motion(written(tmp_path, up), settings).moves[0].goal.y_m > 0.02
    with pytest.raises(InputError, match=r"outside limits.y_m"):
        load_motion(written(tmp_path, up.replace("0.0200000001", "0.020002")), settings)


MISTAKES = [
    ("cell-motion/1", "cell-motion/2", ":1:1: format:"),
    ("still_s: 0.2", "still: 0.2", ":4:1: still: unknown key; did you mean 'still_s'?"),
    ("hold_s: 1.0\n", "", ":1:1: hold_s: is missing"),
    ("y_m: -0.05, angle_rad: 0.05", "y_m: .nan, angle_rad: 0.05", ":6:16: moves[0].y_m:"),
    (
        "y_m: -0.05, angle_rad: 0.05",
        "y_m: -0.15, angle_rad: 0.05",
        ":6:16: moves[0].y_m: takes the gripper to y_m = -0.15, outside limits.y_m = [-0.1, 0.02]",
    ),
    (
        "angle_rad: 0.05}\nstill",
        "angle_rad: 3.0}\nstill",
        ":3:29: start.angle_rad: takes the gripper",
    ),
    ("duration_s: 0.27", "duration_s: 0.1", ":6:45: moves[0].duration_s: 0.1 s is too short"),
    ("angle_rad: 0.0, duration_s: 0.4", "angle_rad: -0.5, duration_s: 0.4", "0.55 rad"),
]


@pytest.mark.parametrize(("right", "wrong", "said"), MISTAKES, ids=[m[2] for m in MISTAKES])
def test_a_mistake_is_said_with_its_place(
    settings: Settings, tmp_path: Path, right: str, wrong: str, said: str
) -> None:
    assert RIGHT.count(right) == 1
    with pytest.raises(InputError) as raised:
        load_motion(written(tmp_path, RIGHT.replace(right, wrong)), settings)
    assert said in str(raised.value)


def test_a_file_whose_name_cannot_name_a_trial_is_refused(
    settings: Settings, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="'my motion' is no name; rename the file"):
        load_motion(written(tmp_path, RIGHT, "my motion.yaml"), settings)


def test_a_file_that_is_not_there_is_said(settings: Settings, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_motion(tmp_path / "absent.yaml", settings)


def test_the_hand_rests_moves_as_the_file_says_and_is_held(tmp_path: Path) -> None:
    path = tmp_path / "down.yaml"
    path.write_text(
        "format: cell-motion/1\n"
        "start: {x_m: 0.01, y_m: 0.0, angle_rad: 0.1}\n"
        "still_s: 0.2\n"
        "moves:\n"
        "- {x_m: 0.01, y_m: -0.05, angle_rad: 0.1, duration_s: 0.3}\n"
        "- {x_m: 0.01, y_m: 0.0, angle_rad: 0.4, duration_s: 0.5}\n"
        "hold_s: 0.4\n"
    )
    name, hand = hand_motion(path, (1.0, 2.0))
    assert name == "down"
    assert hand.t_s[-1] == pytest.approx(1.4, abs=0.01)
    assert np.all(np.diff(hand.t_s) > 0.0)
    np.testing.assert_allclose(hand.x_m, 1.01)
    assert np.interp(0.2, hand.t_s, hand.y_m) == pytest.approx(2.0)
    assert np.interp(0.35, hand.t_s, hand.y_m) == pytest.approx(1.975, abs=1e-3)
    assert np.interp(0.5, hand.t_s, hand.y_m) == pytest.approx(1.95, abs=1e-4)
    assert (hand.y_m[-1], hand.angle_rad[-1]) == (2.0, 0.4)
