"""True errors of calibrations on rendered pictures, compared with stated bounds and with OpenCV.

    python -m tools.studies.calibration_study --setups 20 -o study.csv
    python -m tools.studies.calibration_study --setups 100 --time
    python -m tools.studies.calibration_study --setups 40 --grip

Every set-up has its own camera (k1 −0.3 … 0.1, tilt to 30°, pan, roll, focal length, blur, noise),
robot base, jaw and board, all known; its pictures are rendered and then calibrated like live ones,
with the gripper turned out of the plane as well.  Peers: `cv2.calibrateCamera` with
`cv2.calibrateHandEye` (Park, Daniilidis), on the same pictures.

With `--time` latency and lag instead: the motion of a calibration in cells with random arm, rates,
noise and delays, filmed by a camera with a small error of its map.

With `--grip` gripping point, clamp angle and free length: hidden cables with their own rest
curvature, displaced and rotated marks, in twelve poses, filmed through a map with an error of
`MAP_M`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from calib.board import Board, BoardView
from calib.camera import picture_grid
from calib.cell import CellFit, camera_roll, fit_cell
from calib.errors import CalibrationError
from calib.grip import fit_grip
from calib.jaw_marks import Gravity, JawObservation, Plate
from calib.lens import Lens, pose
from calib.plane import PlaneView, fit_homography
from calib.plate import find_plate
from calib.thread import find_thread
from calib.timing import arm_lag, camera_latency
from cell.calibration.conclude import camera_from
from cell.calibration.grip import grip_poses, views_of
from cell.calibration.measure import timing_path
from cell.calibration.raw import NamedImage, ShownCell, ShownPose
from cell.settings import load_settings
from cell.settings.calibrated import CIRCLE_95
from cell.settings.translate import pose_of
from cell.wiring.simulated_assistant import board_patches, board_poses, photograph_board, plumb_line
from cell.wiring.twins import cable_shape, hidden_cable
from drivers.interfaces import Trajectory
from drivers.servo import servo_response
from drivers.sim.pinhole import Pinhole
from drivers.sim.render import JAW_MARKS_M, RenderOptions, render

SIZE = (1280, 1024)
BOARD = Board()
MARKS_M = np.array(JAW_MARKS_M)[:, :2]
RADIUS_M = JAW_MARKS_M[0][2]
POSES, HELD_OUT, VIEWS = 30, 6, 20
LEVEL_RAD = 0.002
THREADS_M = (-0.14, 0.0)
ARM_M = 1e-5
MAP_M = 8e-6  # of the map with which a grip is measured, at the picture's corners, along each axis
PEERS = {"park": cv2.CALIB_HAND_EYE_PARK, "daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS}
GRIP = ("x_mm", "y_mm", "angle_deg", "length_mm")
SPHERE_95 = 1.61  # 95 % of a ball's normal law, in standard deviations over three axes together


class Setup:
    """A cell whose frames are known, and its pictures."""

    def __init__(self, seed: int) -> None:
        rng = self.rng = np.random.default_rng([seed, 17])
        self.eye = Pinhole.standing(
            metres_per_pixel=2e-4,
            origin_px=(1000.0, 150.0),
            size_px=SIZE,
            focal_px=rng.uniform(2200.0, 3000.0),
            tilt_rad=np.radians(rng.uniform(-30.0, 30.0)),
            pan_rad=np.radians(rng.uniform(-6.0, 6.0)),
            roll_rad=np.radians(rng.uniform(-3.0, 3.0)),
            distortion=(rng.uniform(-0.3, 0.1), rng.uniform(-0.1, 0.1),
                        *rng.normal(0.0, 3e-4, 2), 0.0),
        )  # fmt: skip
        self.look = RenderOptions(
            lens_blur_px=rng.uniform(0.5, 1.0), read_noise=rng.uniform(0.5, 2.0), scene_seed=seed
        )
        # gravity departs from the stated up by the tolerance, in both directions
        off = rng.normal(0.0, LEVEL_RAD, 2)
        self.X_BP = pose(np.array([off[0], rng.normal(0.0, 0.01), off[1], 0.3, -0.1, 0.2]))
        self.X_TM = pose(np.concatenate([rng.normal(0, 0.008, 3), rng.normal(0, 1e-3, 3)]))
        self.home = self.X_BP @ np.linalg.inv(self.X_TM)
        self.warp_m = tuple(rng.normal(0.0, 1e-4, 2))
        self.lens = Lens(self.eye.focal_px, self.eye.focal_px, *self.eye.centre_px,
                         *self.eye.distortion)  # fmt: skip
        self.view = PlaneView.from_pose(self.lens, self.eye.X_CP)

    def board_pictures(self) -> list[NamedImage]:
        middle = np.array([(639.5 - 1000.0) * 2e-4, (150.0 - 511.5) * 2e-4, 0.0])
        poses = board_poses(BOARD, VIEWS, self.rng, middle, 0.08)
        return [
            NamedImage(
                f"{k:02d}.png",
                photograph_board(
                    self.eye, [board_patches(BOARD, X, self.warp_m)], self.look, self.rng
                ),
            )
            for k, X in enumerate(poses)
        ]

    def shown(self, count: int) -> list[JawObservation]:
        """The plate at rest in random poses, turned out of the plane by 20° at most."""
        poses: list[JawObservation] = []
        while len(poses) < count:
            turn = [*self.rng.uniform(-0.35, 0.35, 2), self.rng.uniform(-0.3, 0.3)]
            place = [self.rng.uniform(-0.10, 0.0), self.rng.uniform(-0.11, 0.01)]
            X_PM = pose(np.array([*turn, *place, self.rng.normal(0.0, 0.02)]))
            X_BT = self.X_BP @ X_PM @ np.linalg.inv(self.X_TM)
            image = render(None, X_PM, self.eye, self.look, self.rng)
            plate = find_plate(image, MARKS_M, RADIUS_M)
            if plate is not None:
                X_log = X_BT.copy()
                X_log[:3, 3] += self.rng.normal(0.0, ARM_M, 3)
                poses.append(
                    JawObservation(f"pose {len(poses)}", X_log, plate.pixels, plate.smear_px)
                )
        return poses

    def gravity(self) -> Gravity:
        options, rng = self.look, self.rng
        bare = photograph_board(self.eye, [], options, rng)
        lines = [plumb_line(x_m, (-0.2, 0.1)) for x_m in THREADS_M]
        threads = tuple(
            find_thread(photograph_board(self.eye, [line], options, rng), bare) for line in lines
        )
        return Gravity(np.array([0.0, 1.0, 0.0]), LEVEL_RAD, threads)


def measured(seed: int) -> dict[str, float]:
    """Errors and stated bounds of one set-up's calibration: mm, degrees; and the peers' errors."""
    begun_s = time.process_time()
    setup = Setup(seed)
    camera, views, _ = camera_from(setup.board_pictures(), BOARD)
    shown, held_out = setup.shown(POSES), setup.shown(HELD_OUT)
    fit = fit_cell(
        shown, held_out, Plate(MARKS_M, RADIUS_M), camera.lens, camera.covariance,
        setup.gravity(), setup.home, in_plane=False,
    )  # fmt: skip
    grid = picture_grid(SIZE)
    off = np.linalg.norm(fit.view.to_plane(grid) - setup.view.to_plane(grid), axis=-1)
    bound = CIRCLE_95 * fit.spread_m(grid)
    tilt_deg = float(np.degrees(np.arccos(min(1.0, abs(setup.eye.X_CP[2, 2])))))
    row = {"seed": float(seed), "tilt_deg": tilt_deg, "k1": setup.eye.distortion[0]}
    row |= {"map_rms": 1e3 * rms(off), "map_max": 1e3 * float(off.max())}
    row |= {"map_95": 1e3 * float(bound.max()), "map_inside": float(np.mean(off <= bound))}
    row |= plane_errors(fit, setup)
    row["held_out_rms"] = 1e3 * rms(np.linalg.norm(fit.held_out_m, axis=1))
    for name, method in PEERS.items():
        peer = opencv_view(views, shown, setup, method)
        away = np.linalg.norm(peer.to_plane(grid) - setup.view.to_plane(grid), axis=-1)
        row |= {f"{name}_rms": 1e3 * rms(away), f"{name}_max": 1e3 * float(np.nanmax(away))}
    row["cpu_s"] = time.process_time() - begun_s
    return row


def timed(seed: int) -> dict[str, float]:
    """Errors of latency and lag of one simulated cell, and their stated half widths, ms."""
    rng = np.random.default_rng([seed, 18])
    settings = load_settings(Path("config/fake.yaml"))
    rate_hz, frames_hz = rng.choice([125.0, 500.0]), rng.uniform(60.0, 200.0)
    latency_s, lag_s = rng.uniform(0.0, 0.5), rng.uniform(0.005, 0.1)
    path = timing_path(settings, pose_of(settings.motion.home), rate_hz)
    commanded = Trajectory(path.t_s + 0.4, path.x_m, path.y_m, path.angle_rad)
    true = servo_response(commanded, lag_s)
    t_s = np.arange(0.0, true.t_s[-1] + 0.2, 1.0 / rate_hz)
    arm_m, mark_m = rng.uniform(2e-6, 3e-5), rng.uniform(1e-6, 1e-5)
    x, y = (np.interp(t_s, true.t_s, v) for v in (true.x_m, true.y_m))
    noisy = [v + rng.normal(0.0, arm_m, len(v)) for v in (x, y)]
    hand = Trajectory(t_s, *noisy, np.zeros(len(t_s)))
    exposed_s = np.arange(rng.uniform(0.1, 0.12), t_s[-1], 1.0 / frames_hz)
    observed_m = np.stack([np.interp(exposed_s, t_s, v) for v in (x, y)], axis=1)
    wrong = np.eye(2) + rng.normal(0.0, 3e-4, (2, 2))
    observed_m = observed_m @ wrong + rng.normal(0.0, mark_m, observed_m.shape)
    latency = camera_latency(exposed_s + latency_s, observed_m, hand)
    lag = arm_lag(commanded, hand)
    return {
        "seed": float(seed),
        "latency_ms": 1e3 * abs(latency.value_s - latency_s),
        "latency_95_ms": 1e3 * latency.half_width_s,
        "lag_ms": 1e3 * abs(lag.value_s - lag_s),
        "lag_95_ms": 1e3 * lag.half_width_s,
    }


def gripped(seed: int) -> dict[str, float]:
    """Errors of gripping point, clamp angle and free length, and their half widths: mm, degrees."""
    setup, settings = Setup(seed), load_settings(Path("config/fake.yaml"))
    rng = setup.rng
    displaced_m, askew, longer_m = rng.normal(0, 3e-4, 2), rng.normal(0, 0.01), rng.normal(0, 1e-3)
    effects = {
        "grip_slip": {"length_m": longer_m},
        "natural_curvature": {
            "curvature_1_per_m": rng.normal(0.0, 1.0),
            "gradient_1_per_m2": rng.normal(0.0, 10.0),
        },
    }
    world = settings.world.model_copy(update={"effects": effects})
    hidden = hidden_cable(settings.model_copy(update={"world": world}), seed, 1)
    shape = cable_shape(hidden, 120)
    turn = np.array([[np.cos(askew), -np.sin(askew)], [np.sin(askew), np.cos(askew)]])
    glued = (MARKS_M - displaced_m) @ turn
    look = replace(
        setup.look,
        marks_m=tuple((x, y, RADIUS_M) for x, y in glued.tolist()),
        plate_m=(0.0, -0.017, 0.042, 0.017),  # around the marks, wherever they are glued
    )
    wide, high = SIZE
    pixels = np.array([[0.0, 0.0], [wide, 0.0], [wide, high], [0.0, high]])
    places = setup.view.to_plane(pixels) + rng.normal(0.0, MAP_M, (4, 2))
    lens = setup.lens
    view = PlaneView(fit_homography(lens.ideal(pixels), places), lens)
    poses, hold_s = [], np.array([0.0, 0.1])
    for goal in grip_poses(settings, view):
        path = Trajectory(hold_s, *(np.full(2, v) for v in (goal.x_m, goal.y_m, goal.angle_rad)))
        at = (goal.x_m, goal.y_m, goal.angle_rad)
        images = [render(shape(path, hold_s)[0], at, setup.eye, look, rng) for _ in range(4)]
        mean = np.rint(np.mean(images, axis=0)).astype(np.uint8)
        poses.append(ShownPose("fit", goal, NamedImage(f"{len(poses)}", mean)))
    views, _ = views_of(ShownCell(tuple(poses)), view, settings)
    fit = fit_grip(views, MAP_M * np.sqrt(2.0) * 2.0 / 3.0)  # the corners' error, over the picture
    off = np.abs(fit.mean - [*displaced_m, askew, 0.1 + longer_m])
    unit = np.array([1e3, 1e3, np.degrees(1.0), 1e3])
    row = {"seed": float(seed)}
    for name, error, half in zip(GRIP, unit * off, unit * fit.half_95, strict=True):
        row |= {name: float(error), f"{name}_95": float(half)}
    return row


def plane_errors(fit: CellFit, setup: Setup) -> dict[str, float]:
    """Plane in base and roll: error and 95 % bound."""
    off = np.linalg.inv(setup.X_BP) @ fit.X_BP
    origin_m, turn_rad = fit.plane_spread()
    roll, roll_std = fit.roll()
    return {
        "origin": 1e3 * float(np.linalg.norm(off[:3, 3])),
        "origin_95": 1e3 * SPHERE_95 * origin_m,
        "turn_deg": float(np.degrees(np.linalg.norm(cv2.Rodrigues(off[:3, :3])[0]))),
        "turn_95_deg": float(np.degrees(SPHERE_95 * turn_rad)),
        "roll_deg": float(np.degrees(abs(roll - camera_roll(setup.eye.X_CP)))),
        "roll_95_deg": float(np.degrees(1.96 * roll_std)),
    }


def opencv_view(
    views: tuple[BoardView, ...], shown: list[JawObservation], setup: Setup, method: int
) -> PlaneView:
    """Map by OpenCV alone: lens, poses of the plate one by one, gripper–eye, mean plate in the
    tool.

    It gets the true plane relative to its own plate: only camera, robot and plate are estimated.
    """
    _, K, distortion, _, _ = cv2.calibrateCamera(
        [BOARD.corners_m[v.ids].astype(np.float32) for v in views],
        [v.pixels.astype(np.float32) for v in views],
        SIZE, None, None,
    )  # fmt: skip
    flat = np.column_stack([MARKS_M, np.zeros(len(MARKS_M))])
    X_CM = []
    for one in shown:
        _, turn, shift = cv2.solvePnP(flat, one.pixels, K, distortion, flags=cv2.SOLVEPNP_IPPE)
        X_CM.append(pose(np.concatenate([turn.ravel(), shift.ravel()])))
    bases = [np.linalg.inv(one.X_BT) for one in shown]
    R, t = cv2.calibrateHandEye(
        [X[:3, :3] for X in bases], [X[:3, 3] for X in bases],
        [X[:3, :3] for X in X_CM], [X[:3, 3] for X in X_CM], method=method,
    )  # fmt: skip
    X_BC = np.eye(4)
    X_BC[:3, :3], X_BC[:3, 3] = R, t.ravel()
    X_CP = np.linalg.inv(X_BC) @ setup.X_BP
    lens = Lens(K[0, 0], K[1, 1], K[0, 2], K[1, 2], *distortion.ravel()[:5])
    return PlaneView.from_pose(lens, X_CP)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(np.square(values))))


#: What is measured, by the option: its function, and of each quantity the columns of its error and
#: of its 95 % bound.
MODES = {
    "map": (
        measured,
        (("map_rms", ""), ("map_max", ""), ("origin", "origin_95"), ("turn_deg", "turn_95_deg"),
         ("roll_deg", "roll_95_deg"), ("held_out_rms", "")),
    ),
    "time": (timed, (("latency_ms", "latency_95_ms"), ("lag_ms", "lag_95_ms"))),
    "grip": (gripped, tuple((name, f"{name}_95") for name in GRIP)),
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--setups", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    for name, explained in (("time", "latency and lag"), ("grip", "how the jaws hold a cable")):
        parser.add_argument(f"--{name}", action="store_const", const=name, dest="mode",
                            default="map", help=f"{explained} instead of the map")  # fmt: skip
    parser.add_argument("-o", "--out", type=Path, default=Path("calibration_study.csv"))
    options = parser.parse_args()
    measure, quantities = MODES[options.mode]
    rows: list[dict[str, float]] = []
    for seed in range(options.first, options.first + options.setups):
        try:
            rows.append(measure(seed))
        except CalibrationError as error:
            print(f"{seed}: refused: {error}", flush=True)
            continue
        print(", ".join(f"{k} {v:.4g}" for k, v in rows[-1].items()), flush=True)
        pd.DataFrame(rows).to_csv(options.out, index=False, na_rep="nan")
    print(f"\n{len(rows)} of {options.setups} set-ups calibrated; error, mm, degrees or ms")
    if rows:
        print("\n".join(summary(pd.DataFrame(rows), quantities)))


def summary(columns: pd.DataFrame, quantities: tuple[tuple[str, str], ...]) -> Iterator[str]:
    """Lines of errors, and the share within their bounds; for a map also those of the peers."""
    for name, bound in quantities:
        off = columns[name]
        line = f"  {name:14} median {np.median(off):.4f} rms {rms(off):.4f} largest {off.max():.4f}"
        if bound:
            inside, half = np.mean(off <= columns[bound]), np.median(columns[bound])
            line += f"; inside its 95 % bound {inside:.3f}, bound {half:.4f}"
        yield line
    if "map_inside" in columns:
        yield f"  points of the map inside their 95 % bound {columns['map_inside'].mean():.3f}"
        for peer in PEERS:
            error, better = columns[f"{peer}_rms"], columns["map_rms"] < columns[f"{peer}_rms"]
            yield (f"OpenCV, {peer}: rms {np.median(error):.4f} mm in the median, "
                   f"ours lower in {np.mean(better):.0%}")  # fmt: skip


if __name__ == "__main__":
    main()
