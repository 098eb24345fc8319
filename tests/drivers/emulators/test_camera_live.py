from __future__ import annotations

import importlib
import inspect
import time
from dataclasses import replace

import numpy as np
import pytest

from drivers.clock import RealClock
from drivers.emulators.camera import CameraEmulatorOptions, EmulatedCamera
from drivers.emulators.camera_live import ArmScene, LiveScene
from drivers.emulators.camera_poses import RtdePoses
from drivers.emulators.launch import EmulatedController, EmulatorError
from drivers.interfaces import FloatArray, Trajectory
from drivers.opencv_camera import OpenCvCamera, OpenCvOptions
from drivers.plane_mount import PlaneMount
from drivers.sim import render
from drivers.sim.camera import CameraTwinOptions, Staging
from drivers.sim.render import Patches, RenderOptions
from drivers.ur_kinematics import UR5E

PICTURE = RenderOptions(
    width_px=200,
    height_px=200,
    thickness_m=0.002,
    read_noise=0.0,
    shot_noise=0.0,
    texture_level=0.0,
    illumination_drop=0.0,
    bright_object=False,
)
SCALE_M = 0.001
CAMERA = CameraTwinOptions(
    np.array([[SCALE_M, 0.0, -0.14], [0.0, -SCALE_M, 0.1], [0.0, 0.0, 1.0]]), PICTURE
)


class Feed:
    """A gripper that moves along a parabola, told in small portions."""

    def __init__(self) -> None:
        self.known_s = 0.0
        self.until_s = 0.0

    @staticmethod
    def y_m(t_s: FloatArray) -> FloatArray:
        return -0.5 * t_s**2

    def __call__(self) -> Trajectory | None:
        count = round((self.until_s - self.known_s) / 0.002)
        if count < 1:
            return None
        t_s = self.known_s + 0.002 * np.arange(1, count + 1)
        self.known_s = float(t_s[-1])
        return Trajectory(t_s, 0.0 * t_s, self.y_m(t_s), 0.0 * t_s)


class Rod:
    """A cable that stays straight; knows what it was told."""

    def __init__(self) -> None:
        self.told_s = np.empty(0)

    def advance(self, grip: Trajectory) -> FloatArray:
        self.told_s = np.concatenate([self.told_s, grip.t_s])
        back = np.stack([-np.linspace(0.1, 0.0, 61), np.zeros(61)], axis=-1)
        return np.stack([grip.x_m, grip.y_m], axis=-1)[:, None] + back


def row_of_cable(image: np.ndarray) -> float:
    """Sub-pixel row of the dark rod, left of the jaw."""
    darkness = image[:, 60:130].astype(float).mean(axis=1)
    darkness = np.clip(np.median(darkness) - darkness - 10.0, 0.0, None)
    return float(np.sum(darkness * np.arange(len(darkness))) / np.sum(darkness))


def test_jaw_and_cable_are_where_the_poses_say_also_between_them() -> None:
    feed, rod = Feed(), Rod()
    scene = LiveScene(feed, CAMERA)
    feed.until_s = 0.002
    scene.keep_up()
    scene.notify(lambda: rod)
    for t_s in (0.1013, 0.2507, 0.3021):
        feed.until_s = t_s + 0.006
        row = row_of_cable(scene.picture(t_s))
        expected = (0.1 - feed.y_m(np.array(t_s))) / SCALE_M
        assert row == pytest.approx(expected, abs=0.1)
    assert np.allclose(np.diff(rod.told_s), 0.002)  # nothing twice, nothing left out


def test_the_cable_is_seen_from_the_grip_until_it_is_let_go() -> None:
    feed = Feed()
    scene = LiveScene(feed, CAMERA)

    def dark_px() -> int:
        feed.until_s += 0.02
        return int(np.sum(scene.picture(feed.until_s - 0.01)[95:106, 60:120] < 100))

    assert dark_px() == 0
    scene.notify(Rod)
    assert dark_px() > 50
    scene.notify(None)
    assert dark_px() == 0


class LateFeed(Feed):
    """Poses that come 10 ms late, in real time."""

    def __call__(self) -> Trajectory | None:
        self.until_s = time.monotonic() - 0.010
        if self.known_s == 0.0:
            self.known_s = self.until_s - 0.02
        path = super().__call__()
        return (
            None if path is None else Trajectory(path.t_s, 0 * path.t_s, 0 * path.t_s, 0 * path.t_s)
        )


def test_what_is_shown_is_drawn_once_and_each_picture_has_its_own_noise(monkeypatch) -> None:
    """A board of a thousand polygons, drawn 60 times a second, left a busy computer no pictures."""
    drawn: list[int] = []
    gather = render.gather
    monkeypatch.setattr(
        render,
        "gather",
        lambda corners, *rest: (drawn.append(len(corners)), gather(corners, *rest)),
    )
    feed = Feed()
    feed.until_s = 0.1
    noisy = replace(CAMERA, picture=replace(PICTURE, read_noise=2.0))
    scene = LiveScene(feed, noisy)
    empty = scene.picture(0.09)
    corner_m = np.array([[-0.04, -0.04], [0.04, -0.04], [0.04, 0.04], [-0.04, 0.04]])
    board = Patches(np.tile(corner_m, (1000, 1, 1)), np.full(1000, -0.1), np.zeros(1000))
    scene.notify(Staging((board,), jaw=False))
    first, second = scene.picture(0.09), scene.picture(0.09)
    assert drawn.count(1000) == 1
    darker = np.median(empty[60:140, 100:180]) - np.median(first[60:140, 100:180])
    assert darker == pytest.approx(100.0, abs=1.0)
    assert np.std(first.astype(float) - second) == pytest.approx(2.0 * np.sqrt(2.0), rel=0.1)
    scene.notify(Staging())
    assert abs(float(np.mean(empty)) - float(np.mean(scene.picture(0.09)))) < 0.5


def test_a_picture_waits_for_a_pose_that_is_under_way_but_not_for_an_arm_without_power() -> None:
    scene = LiveScene(LateFeed(), CAMERA)
    scene.keep_up()
    asked_s = time.monotonic()
    scene.picture(asked_s - 0.002)
    assert time.monotonic() - asked_s > 0.005
    still = Feed()
    still.until_s = 0.1
    dark = LiveScene(still, CAMERA)
    dark.keep_up()
    asked_s = time.monotonic()
    for k in range(20):
        dark.picture(asked_s + 0.01 * k)
    assert time.monotonic() - asked_s < 20 * 0.03


def test_without_any_pose_it_says_so_and_nonsense_is_refused() -> None:
    scene = LiveScene(lambda: None, CAMERA)
    with pytest.raises(RuntimeError, match="no pose is known"):
        scene.picture(0.0)
    with pytest.raises(RuntimeError, match=r"within 0\.01 s: does the arm run"):
        scene.wait_for_pose(0.01)
    with pytest.raises(TypeError, match="'cable' is neither"):
        scene.notify("cable")


@pytest.fixture
def controller(loopback):
    with EmulatedController(loopback) as it:
        yield it


def test_poses_are_those_of_the_controller_on_this_computers_clock(controller) -> None:
    X_BT = UR5E.forward(np.array(controller.request("state")["q_rad"]))
    mount = PlaneMount(tuple(X_BT[:3, 3] - [0.1, 0.0, -0.2]), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    poses = RtdePoses(controller.host, mount, UR5E, np.eye(4))
    time.sleep(0.3)
    path = poses()
    assert path is not None and len(path.t_s) > 80
    assert np.median(np.diff(path.t_s)) == pytest.approx(0.002, abs=1e-6)
    assert -0.1 < path.t_s[-1] - time.monotonic() <= 0.0
    assert path.x_m == pytest.approx(0.1) and path.y_m == pytest.approx(-0.2)


@pytest.fixture
def rod(tmp_path, monkeypatch):
    """The rod in a module that the camera's process can import."""
    source = inspect.getsource(Rod)
    header = "from __future__ import annotations\nimport numpy as np\n"
    (tmp_path / "rod_of_a_test.py").write_text(header + source)
    monkeypatch.syspath_prepend(tmp_path)
    return importlib.import_module("rod_of_a_test").Rod


def test_a_camera_films_an_emulated_arm(controller, rod) -> None:
    X_BT = UR5E.forward(np.array(controller.request("state")["q_rad"]))
    mount = PlaneMount(tuple(X_BT[:3, 3]), tuple(X_BT[:3, 0]), tuple(X_BT[:3, 1]))
    clock = RealClock()
    size = CameraEmulatorOptions(width_px=200, height_px=200, frame_rate_hz=100.0)
    with EmulatedCamera(ArmScene(controller.host, mount, camera=CAMERA), size) as stream:
        with pytest.raises(EmulatorError, match="'cable' is neither"):
            stream.notify("cable")
        stream.notify(rod)
        options = OpenCvOptions(stream.url, 200, 200, 100.0, exposure_s=None)
        camera = OpenCvCamera(options, clock)
        camera.connect()
        camera.start(1)
        frame = camera.read()
        camera.close()
    assert frame is not None
    # noiseless pictures of an arm at rest repeat: one is enough, and it is the one of the scene
    feed = Feed()
    feed.until_s = 0.002
    expected = LiveScene(feed, CAMERA)
    expected.notify(Rod)
    difference = frame.image.astype(int) - expected.picture(0.002)
    assert np.abs(difference).max() <= 3 < np.ptp(frame.image)
