"""Takes the measurements of each calibration: shows the board, moves and films the gripper."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import Protocol

import numpy as np

from calib.board import Board, BoardView, find_board
from calib.camera import picture_grid
from calib.cell import CellFit
from calib.errors import CalibrationError
from calib.hand_eye import choose_poses, in_picture
from calib.jaw_marks import JawObservation
from calib.plane import PlaneView
from calib.plate import find_plate
from cell.cable.arrays import FloatArray
from cell.calibration.assistants import BOARD_VIEWS, THREADS, Assistant, OnCoverage
from cell.calibration.raw import DetectedMove, NamedImage, ShownCell, ShownPose
from cell.calibration.session import CalibrationSession, FilmedMove
from cell.plan.measuring import Move, least_duration_s, measuring_path
from cell.settings import Settings
from cell.settings.translate import vision_of
from cell.vision.marks import JawMarks, find_jaw
from drivers.interfaces import Pose, Trajectory


class Say(Protocol):
    """Reports progress to a person: `done` of `total` pieces are complete; 0 of 0 = not counted."""

    def __call__(self, text: str, done: int = 0, total: int = 0) -> None:
        """Must return at once."""


#: Numbers of fixed first poses, of chosen informative poses, and of held-out poses.
FIRST_POSES, CHOSEN_POSES, HELD_OUT_POSES = 9, 15, 6
#: Share of the limits that is used, and of the cell's kinematic limits in the timing motion.
_SHARE, _BRISK = 0.95, 0.8
_TURN_RAD = 0.35  # larger clamp angles add little information, and take time
#: Share of the limits for the first poses, when the picture's edges are not known yet.
_FIRST_SHARE = 0.75
_COARSE = 4  # columns and rows of the picture in the hint where corners are lacking


def marks_m(marks: JawMarks) -> FloatArray:
    """(M, 2) centres of the jaw's marks, m."""
    return np.array(marks.centres_m)


def show_board(
    session: CalibrationSession,
    assistant: Assistant,
    board: Board,
    say: Say,
    look: OnCoverage | None = None,
) -> list[NamedImage]:
    """Take pictures of the board in many poses, with hints where corners are still lacking.

    look  called with every picture and the views so far
    """
    pictures: list[NamedImage] = []
    views: list[BoardView] = []
    for number in range(1, BOARD_VIEWS + 1):
        assistant.board(number, lacking(views))
        picture = NamedImage(f"board_{number:02d}.png", session.picture())
        pictures.append(picture)
        try:
            view = find_board(picture.image, board, picture.name)
        except CalibrationError as error:
            say(str(error))
            continue
        if view is not None:
            views.append(view)
        corners = 0 if view is None else len(view.ids)
        if look is not None:
            look(views, picture.image)
        say(f"view {number}: {corners} of {len(board.corners_m)} corners", number, BOARD_VIEWS)
    assistant.clear()
    return pictures


def lacking(views: Sequence[BoardView]) -> str:
    """Hint where in the picture few corners were detected: " further up and left", or ""."""
    if len(views) < 3:
        return ""
    width, height = views[0].size_px
    pixels = np.concatenate([v.pixels for v in views])
    counts, _, _ = np.histogram2d(
        pixels[:, 1], pixels[:, 0], bins=_COARSE, range=[[0, height], [0, width]]
    )
    row, column = np.unravel_index(int(np.argmin(counts)), counts.shape)
    if counts[row, column] > 0.25 * counts.mean():
        return ""
    up = "up" if row < _COARSE / 2 else "down"
    return f" further {up} and {'left' if column < _COARSE / 2 else 'right'}, tilted"


# --- poses of the gripper ------------------------------------------------------------------------


def film_plate(
    session: CalibrationSession, assistant: Assistant, fit: Callable[[ShownCell], CellFit], say: Say
) -> ShownCell:
    """Picture the plate at rest in fixed and in informative poses, and a plumb line."""
    assistant.clear()
    settings = session.settings
    marks = vision_of(settings).marks
    rng = np.random.default_rng(len(settings.cable.model_dump()))
    poses: list[ShownPose] = []
    total = FIRST_POSES + CHOSEN_POSES + HELD_OUT_POSES

    def show(goal: Pose, role: str) -> None:
        rest = session.rest_at(goal)
        name = f"pose_{len(poses) + 1:02d}.png"
        poses.append(ShownPose(role, rest.pose, NamedImage(name, rest.image)))
        say(f"pose {len(poses)}", len(poses), total)

    for goal in first_poses(settings):
        show(goal, "fit")
    rough = fit(ShownCell(tuple(poses)))
    size = (settings.camera.width_px, settings.camera.height_px)
    candidates = candidate_poses(settings)
    field = picture_grid(size)[::2, ::2].reshape(-1, 2)
    chosen = choose_poses(
        rough, [matrix_of(p) for p in candidates], marks_m(marks), field, size, CHOSEN_POSES
    )
    for k in _in_short_ways([candidates[k] for k in chosen]):
        show(k, "fit")
    others = [
        Pose(*(float(v) for v in values))
        for values in rng.uniform(*within_limits(settings), (60, 3))
    ]
    visible = in_picture(rough, [matrix_of(p) for p in others], marks_m(marks), size)
    for goal in [others[k] for k in np.flatnonzero(visible)[:HELD_OUT_POSES]]:
        show(goal, "held_out")
    session.go_to(session.home)
    without, threads = session.picture(4), []
    for number in range(1, THREADS + 1):
        if not assistant.thread(number):
            break
        threads.append(session.picture(4))
    assistant.clear()
    return ShownCell(tuple(poses), tuple(threads), without if threads else None)


def first_poses(settings: Settings) -> list[Pose]:
    """Corners and middles of a box well within the limits, with alternating clamp angles."""
    low, high = within_limits(settings)
    middle, half = 0.5 * (low + high), 0.5 * _FIRST_SHARE * (high - low)
    low, high = middle - half, middle + half
    places = list(product((low[0], middle[0], high[0]), (high[1], middle[1], low[1])))
    turns = [low[2], high[2], middle[2]]
    return [Pose(float(x), float(y), float(turns[k % 3])) for k, (x, y) in enumerate(places)]


def candidate_poses(settings: Settings) -> list[Pose]:
    """Grid of poses over the limits."""
    low, high = within_limits(settings)
    axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, (6, 6, 3), strict=True)]
    return [Pose(*(float(v) for v in values)) for values in product(*axes)]


def within_limits(settings: Settings, most_rad: float = _TURN_RAD) -> tuple[FloatArray, FloatArray]:
    """Least and greatest x, y, angle, well within the limits; angle by at most `most_rad`."""
    limits = settings.limits
    edges = np.array([limits.x_m, limits.y_m, limits.angle_rad])
    middle, half = edges.mean(axis=1), 0.5 * _SHARE * np.ptp(edges, axis=1)
    half[2] = min(half[2], most_rad)
    return middle - half, middle + half


def _in_short_ways(poses: Sequence[Pose]) -> list[Pose]:
    """The poses in an order with short distances, each next to the one before."""
    remaining, order = list(poses), []
    here = remaining[0] if remaining else Pose(0.0, 0.0)
    while remaining:
        near = min(remaining, key=lambda p: abs(p.x_m - here.x_m) + abs(p.y_m - here.y_m))
        remaining.remove(near)
        order.append(near)
        here = near
    return order


def matrix_of(pose: Pose) -> FloatArray:
    """(4, 4) of a pose in the arm's plane; its third axis is the plane's normal."""
    c, s = np.cos(pose.angle_rad), np.sin(pose.angle_rad)
    X = np.eye(4)
    X[:2, :2] = [[c, -s], [s, c]]
    X[:2, 3] = pose.x_m, pose.y_m
    return X


def detect_marks(shown: Sequence[ShownPose], marks: JawMarks) -> list[JawObservation]:
    """The jaw's marks in the picture of each pose in which the plate was detected."""
    views = []
    for p in shown:
        plate = find_plate(p.picture.image, marks_m(marks), marks.radius_m)
        if plate is not None:
            pose = matrix_of(p.pose)
            views.append(JawObservation(p.picture.name, pose, plate.pixels, plate.smear_px))
    return views


# --- a motion ---------------------------------------------------------------------------------


def timing_path(settings: Settings, start: Pose, rate_hz: float) -> Trajectory:
    """Fast path down and up, twice, within the limits."""
    limits, motion = settings.limits, settings.motion
    way_m = min(motion.lower_m, start.y_m - limits.y_m[0])
    brisk = motion.lowering
    bounds = (
        _BRISK * brisk.velocity_m_per_s,
        _BRISK * brisk.acceleration_m_per_s2,
        _BRISK * brisk.jerk_m_per_s3,
    )
    low = Pose(start.x_m, start.y_m - way_m, start.angle_rad)
    lasts_s = max(0.25, least_duration_s(way_m, bounds))
    return measuring_path(start, [Move(p, lasts_s) for p in (low, start, low, start)], rate_hz)


def detect_move(filmed: FilmedMove, view: PlaneView, marks: JawMarks) -> DetectedMove:
    """Detect the gripping point in each frame of a motion; nan where the jaw was not detected."""
    grip_m = np.full((len(filmed.frames), 2), np.nan)
    previous_m: FloatArray | None = None
    for k, frame in enumerate(filmed.frames):
        jaw = find_jaw(frame.image, view, marks, previous_m)
        previous_m = None if jaw is None else jaw.grip_m
        if jaw is not None:
            grip_m[k] = jaw.grip_m
    stamps_s = np.array([frame.t_s for frame in filmed.frames])
    return DetectedMove(filmed.commanded, filmed.gripper_log, stamps_s, grip_m)
