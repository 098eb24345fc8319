"""Input that cannot give a calibration: each kind is a named error, none a quietly bad result."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.board import Board
from calib.camera import fit_camera, lens_difference
from calib.errors import (
    BlurredError,
    CalibrationError,
    MisfitError,
    OneSidedError,
    TooFewError,
    WrongBoardError,
    WrongScaleError,
)
from calib.plane import PlaneView
from calib.store import StoredCalibration
from cell.calibration.conclude import camera_from, cell_from, doubts_about
from cell.calibration.grip import views_of as grip_views
from cell.calibration.raw import NamedImage, ShownCell, ShownPose
from cell.settings import load_settings
from cell.wiring.simulated_assistant import board_patches, board_poses, photograph_board
from drivers.interfaces import Image, Pose
from drivers.sim.render import JAW_MARKS_M, Patches, RenderOptions, render
from tests.calib.conftest import BOARD, SIZE_PX, lens_of, middle_m, standing, views_of

EYE = standing()
LOOK = RenderOptions()
RNG = np.random.default_rng(17)
CIRCLE = np.stack([f(np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)) for f in (np.cos, np.sin)])


def level_poses(count: int) -> list[np.ndarray]:
    """A board held square to the camera, to 1°."""
    centre = 0.5 * np.array([*BOARD.size_m, 0.0])
    poses = []
    for X in board_poses(BOARD, count, RNG, middle_m(), 0.08):
        level = X.copy()
        level[:3, :3] = cv2.Rodrigues(RNG.normal(0.0, 0.02, 3))[0] @ np.diag([1.0, -1.0, -1.0])
        level[:3, 3] += (X[:3, :3] - level[:3, :3]) @ centre
        poses.append(level)
    return poses


def from_board(board: Board = BOARD, change: Callable[[Image], Image] = np.asarray) -> object:
    """A lens from pictures of a board, each changed."""
    X = board_poses(board, 1, np.random.default_rng(3), middle_m(), 0.02)[0]
    image = change(photograph_board(EYE, [board_patches(board, X)], LOOK, RNG))
    return camera_from([NamedImage(f"{k}.png", image) for k in range(8)], BOARD)


def from_hand(
    change: Callable[[Image], Image] = np.asarray,
    *,
    marks: int = 4,
    size: float = 1.0,
    bend_m: float = 0.0,
    y_m: tuple[float, float] = (-0.1, 0.02),
) -> object:
    """A cell from pictures of the gripper, each changed, with a plate that is as told.

    bend_m  how far the plate's end stands out of its plane
    """
    shown = []
    for k in range(14):
        hand = Pose(RNG.uniform(-0.06, 0.02), RNG.uniform(*y_m), RNG.uniform(-0.3, 0.3))
        image = change(photograph_board(EYE, plate(hand, marks, size, bend_m), LOOK, RNG))
        shown.append(ShownPose("fit", hand, NamedImage(f"{k:02d}.png", image)))
    numbers = lens_of(EYE).numbers
    covariance = np.diag([1.0] * 4 + [1e-4, 1e-4, 1e-8, 1e-8, 1e-4])
    lens = StoredCalibration("camera", datetime.now(UTC), {}, {}, {}, {"lens": numbers}, covariance)
    return cell_from(ShownCell(tuple(shown)), lens, load_settings(Path("config/fake.yaml")))


def plate(hand: Pose, marks: int, size: float, bend_m: float) -> list[Patches]:
    """The first marks of a plate of a size, and what is behind them."""
    c, s = np.cos(hand.angle_rad), np.sin(hand.angle_rad)

    def placed(points: np.ndarray) -> np.ndarray:
        height = bend_m * ((points[..., 0] - 0.019) / 0.013) ** 2
        flat = size * points @ np.array([[c, s], [-s, c]]) + [hand.x_m, hand.y_m]
        return np.concatenate([flat, height[..., None]], axis=-1)

    x0, y0, x1, y1 = LOOK.plate_m
    edge = placed(np.array([[[x0, y0], [x1, y0], [x1, y1], [x0, y1]]]))
    discs = np.stack([placed(np.array([x, y]) + r * CIRCLE.T) for x, y, r in JAW_MARKS_M[:marks]])
    return [
        Patches(edge, np.array([LOOK.plate_level]), np.ones(1)),
        Patches(discs, np.full(marks, LOOK.mark_level - LOOK.plate_level), np.zeros(marks)),
    ]


@pytest.fixture(autouse=True)
def noise_of_its_own() -> None:
    """Whatever other tests this process has run before."""
    RNG.bit_generator.state = np.random.default_rng(17).bit_generator.state


def from_cable(*, cable: bool = True, second: bool = False, y_m: float = 0.0) -> object:
    """A grip from pictures of a cable at rest, drawn as an arc."""
    view, bow, s = PlaneView.from_pose(lens_of(EYE), EYE.X_CP), 8.0, np.linspace(0.1, 0.0, 121)
    shown = []
    for k, turn in enumerate(np.linspace(0.4, 1.0, 6)):
        heading = turn + 0.5 * bow * s
        line = s[:, None] * -np.stack([np.cos(heading), np.sin(heading)], axis=1) + [0.0, y_m]
        image = render(
            line if cable else None, (0.0, y_m, float(turn)), EYE, LOOK, RNG,
            second_cable_m=line + np.array([0.004, 0.004]) if second else None,
        )  # fmt: skip
        shown.append(ShownPose("fit", Pose(0.0, y_m, float(turn)), NamedImage(f"{k}.png", image)))
    return grip_views(ShownCell(tuple(shown)), view, load_settings(Path("config/fake.yaml")))


def blurred(image: Image) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 4.0), dtype=np.uint8)


def mirrored(image: Image) -> Image:
    return np.ascontiguousarray(image[:, ::-1])


def smeared(image: Image) -> Image:
    """Exposed while what is seen moved by 6 px."""
    return np.asarray(cv2.filter2D(image, -1, np.full((1, 6), 1.0 / 6.0)), dtype=np.uint8)


@pytest.mark.parametrize(
    ("attempt", "error", "words"),
    [
        pytest.param(
            lambda: fit_camera(views_of(EYE, RNG, poses=level_poses(10)), BOARD),
            OneSidedError, r"tilted by \d° at most.*tilt it 30°", id="one-sided views",
        ),
        pytest.param(
            lambda: fit_camera(views_of(EYE, RNG, count=3), BOARD),
            TooFewError, "in 3 of at least 8 pictures that differ; take more", id="three images",
        ),
        pytest.param(
            lambda: from_board(change=blurred),
            BlurredError, "8 of 8 pictures are blurred.*focus", id="blurred",
        ),
        pytest.param(
            lambda: from_board(Board(10, 7)),
            WrongBoardError, "35 markers, but no corners of this board; describe",
            id="wrong board",
        ),
        pytest.param(
            lambda: from_hand(size=1.02),
            WrongScaleError, r"\+[12].\d\d % larger than stated.*measure",
            id="marks at wrong scale",
        ),
        pytest.param(
            lambda: from_board(change=mirrored),
            WrongBoardError, "the picture is mirrored; switch", id="mirrored board",
        ),
        pytest.param(
            lambda: from_hand(mirrored),
            WrongBoardError, "the picture is mirrored; switch", id="mirrored gripper",
        ),
        pytest.param(
            lambda: from_hand(marks=3),
            TooFewError, "found in 0 of 14 poses; see that all 4 are lit", id="marker hidden",
        ),
        pytest.param(
            lambda: from_hand(y_m=(-0.05, -0.0499)),
            OneSidedError, "poses lie on a line; let it move", id="poses on a line",
        ),
        pytest.param(
            lambda: from_hand(smeared),
            BlurredError, r"moved during exposure: in 1\d of 1\d.*come to rest", id="gripper moved",
        ),
        pytest.param(
            lambda: from_hand(bend_m=5e-4),
            MisfitError, "plate on the jaw is bent: mark 4 .*glue it flat", id="plate bent",
        ),
        pytest.param(
            lambda: from_cable(cable=False),
            TooFewError, "in 0 of 6 pictures, .*no cable in 6; grip a cable", id="no cable",
        ),
        pytest.param(
            lambda: from_cable(second=True),
            TooFewError, r"two cables in \d.*; take the second", id="two cables",
        ),
        pytest.param(
            lambda: from_cable(y_m=-0.11),
            TooFewError, "leaves picture in 6; narrow `limits`", id="cable out of the picture",
        ),
    ],
)  # fmt: skip
def test_each_is_named_with_its_remedy(
    attempt: Callable[[], object], error: type[CalibrationError], words: str
) -> None:
    with pytest.raises(error, match=words):
        attempt()


def test_the_same_cable_without_a_fault_is_measured_in_all_pictures() -> None:
    views, troubles = from_cable()
    assert (len(views), troubles) == (6, ())


def test_the_same_hand_without_a_fault_gives_a_cell() -> None:
    """Otherwise those above would prove nothing."""
    off = from_hand().view.to_plane(EYE.to_pixels(np.array([[-0.1, -0.1], [0.0, 0.0]])))
    assert np.max(abs(off - [[-0.1, -0.1], [0.0, 0.0]])) < 1e-4


def test_a_board_printed_at_another_scale_is_harmless_and_a_stretched_one_is_told() -> None:
    """Stretched by 0.2 %, as a printer does it, it bent the map by 0.46 mm, bound 0.13 mm."""
    poses = board_poses(BOARD, 14, RNG, middle_m(), 0.08)
    for factor, told in ((1.02, False), (np.array([1.002, 1.0, 1.0]), True)):
        fit = fit_camera(views_of(EYE, RNG, poses=poses, square=factor), BOARD)
        away = lens_difference(fit.lens, lens_of(EYE), SIZE_PX)
        assert np.sqrt(np.mean(away**2)) < 0.1
        assert fit.lens.fx_px / fit.lens.fy_px == pytest.approx(1.0, abs=3e-4)
        doubts = doubts_about(fit)
        assert bool(doubts) is told
        if told:
            assert "+0.20 % longer across" in doubts[0]
            assert "print it at 100 %" in doubts[0]
