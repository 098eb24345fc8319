"""The simulated world, its hidden cables and the twins of the three devices, by the settings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import count, islice

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.dynamics import simulate
from cell.cable.effects import library, unscreened
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.settings import Settings
from cell.settings import devices as device_settings
from cell.settings.calibrated import Calibrated, typed
from cell.settings.devices import Emulated
from cell.settings.model import JawPlate
from cell.settings.translate import cable_of, pose_of
from drivers.files import FilesCamera
from drivers.interfaces import Trajectory
from drivers.sim.arm import ArmTwinOptions, SimArm
from drivers.sim.camera import CameraTwinOptions, SimCamera, Staging
from drivers.sim.clock import SimClock
from drivers.sim.gripper import SimGripper
from drivers.sim.pinhole import Pinhole, Sight
from drivers.sim.render import LIGHT_ON_DARK, RenderOptions
from drivers.sim.world import CableShape, SimWorld

#: Knots of the simulated cables' flexural rigidity; more than the model has.
HIDDEN_KNOTS = 13
#: First eigenvalue β₁L of a clamped beam.
FIRST_MODE = 1.8751


def hidden_cable(settings: Settings, seed: int, number: int) -> CableModel:
    """The `number`-th cable of a simulated batch: the truth that the cell has to identify.

    Its rigidity varies along the cable, its exponent is not 1; both come from the seed alone.
    """
    truth, known = settings.world, library() | unscreened()
    rng = np.random.default_rng([seed, number])
    low, high = np.log(truth.rigidity_n_m2)
    rigidity = float(np.exp(rng.uniform(low, high)))
    s = np.linspace(0.0, 1.0, HIDDEN_KNOTS)
    waves = sum(
        rng.normal(scale=1.0 / k) * np.cos(np.pi * k * s + rng.uniform(0.0, 2.0 * np.pi))
        for k in (1, 2, 3)
    )
    profile = rigidity * np.exp(truth.rigidity_variation * waves)
    cable = cable_of(settings)
    stiffness = rigidity / (cable.line_density_kg_per_m * cable.free_length_m**4)
    first_mode_rad_per_s = FIRST_MODE**2 * float(np.sqrt(stiffness))
    damping_ratio = rng.uniform(*truth.damping_ratio)
    return CableModel(
        cable,
        profile,
        exponent=float(rng.uniform(*truth.exponent)),
        viscosity_n_m2_s=float(2.0 * damping_ratio * rigidity / first_mode_rad_per_s),
        effects=tuple(known[name].active(**v) for name, v in truth.effects.items()),
    )


def cable_shape(model: CableModel, segments: int) -> CableShape:
    """The simulated world's cable: shapes (Q, segments + 1, 2) at times, tip first."""
    arc_length_m = np.linspace(model.cable.length_m, 0.0, segments + 1)
    solver = Solver(segments=segments)

    def shape(grip: Trajectory, query_s: FloatArray) -> FloatArray:
        motion = Motion(grip.t_s, grip.x_m, grip.y_m, grip.angle_rad)
        shapes: FloatArray = simulate(model, motion, query_s, arc_length_m, solver=solver)[0]
        return shapes

    return shape


@dataclass(frozen=True)
class Twins:
    """The simulated world and the devices in it, without the limits around them.

    seed     of the cables
    numbers  of the following cables
    """

    world: SimWorld
    arm: SimArm
    camera: SimCamera | FilesCamera
    gripper: SimGripper
    seed: int
    numbers: Iterator[int] = field(default_factory=count)

    def make(self, settings: Settings) -> None:
        """Take the following cables, and their appearance, from these settings."""
        self.world.supply(_cables(settings, self.seed, self.numbers))
        if isinstance(self.camera, SimCamera):
            assert isinstance(settings.camera, device_settings.SimulatedCamera)
            self.camera.redraw(camera_twin(settings, settings.camera, self.seed).picture)

    def stage(self, staging: Staging) -> None:
        """Hold an object in front of the camera."""
        if isinstance(self.camera, SimCamera):
            self.camera.stage(staging)


def build_twins(
    settings: Settings, seed: int, cycles: int | None, calibration: Calibrated | None = None
) -> Twins:
    """The simulated world with `cycles` cables laid out; for settings whose devices are `sim`.

    cycles  None = unlimited number of cables
    calibration  delays that the drivers assume; None = as typed
    """
    calibration = typed(settings) if calibration is None else calibration
    arm = settings.arm
    assert isinstance(arm, device_settings.SimulatedArm)
    clock = SimClock(real_time_factor=settings.world.real_time_factor)
    world = SimWorld(clock, pose_of(settings.motion.home))
    numbers = count(1)
    if cycles is None:
        world.supply(_cables(settings, seed, numbers))
    else:
        for cable in _cables(settings, seed, islice(numbers, cycles)):
            world.present(cable)
    true_lag_s = settings.world.arm_lag_s
    options = ArmTwinOptions(
        lag_s=calibration.lag_s,
        true_lag_s=arm.lag_s if true_lag_s is None else true_lag_s,
        rate_hz=arm.rate_hz,
        noise_m=arm.noise_m,
    )
    return Twins(
        world,
        SimArm(world, options, seed=seed),
        _simulated_camera(settings, world, seed, calibration),
        SimGripper(world),
        seed,
        numbers,
    )


def _cables(settings: Settings, seed: int, numbers: Iterator[int]) -> Iterator[CableShape]:
    for number in numbers:
        yield cable_shape(hidden_cable(settings, seed, number), settings.world.segments)


def _simulated_camera(
    settings: Settings, world: SimWorld, seed: int, calibration: Calibrated
) -> SimCamera | FilesCamera:
    camera = settings.camera
    if isinstance(camera, device_settings.FilesCameraSettings):
        return FilesCamera(camera.folder, camera.frame_rate_hz, world.clock)
    assert isinstance(camera, device_settings.SimulatedCamera)
    hidden = settings.world.camera
    late_s = 0.0 if hidden is None else hidden.stamps_late_s - calibration.latency_s
    twin = replace(camera_twin(settings, camera, seed), stamps_late_s=late_s)
    return SimCamera(world, twin, seed=seed)


def camera_twin(
    settings: Settings, look: device_settings.SimulatedCamera | Emulated, seed: int
) -> CameraTwinOptions:
    """Options of the camera's twin, from the settings; `look` has blur, exposure and noise."""
    camera = settings.camera
    assert not isinstance(camera, device_settings.FilesCameraSettings)
    vision = settings.vision
    picture = replace(
        RenderOptions() if vision.cable_is == "dark" else LIGHT_ON_DARK,
        plate_m=_plate_m(vision.jaw),
        marks_m=tuple((x_m, y_m, vision.jaw.radius_m) for x_m, y_m in vision.jaw.discs_m),
        width_px=camera.width_px,
        height_px=camera.height_px,
        thickness_m=settings.cable.thickness_m,
        lens_blur_px=look.lens_blur_px,
        exposure_s=look.exposure_s,
        read_noise=look.read_noise,
        scene_seed=seed,
    )
    return CameraTwinOptions(_sight(settings), picture, camera.frame_rate_hz)


def _sight(settings: Settings) -> Sight:
    """True pose and lens of the camera of a simulated or emulated cell."""
    hidden, camera = settings.world.camera, settings.camera
    if hidden is None:
        return typed(settings).view.homography
    return Pinhole.standing(
        metres_per_pixel=hidden.metres_per_pixel,
        origin_px=(hidden.origin_column_px, hidden.origin_row_px),
        size_px=(camera.width_px, camera.height_px),
        focal_px=hidden.focal_px,
        tilt_rad=hidden.tilt_rad,
        pan_rad=hidden.pan_rad,
        roll_rad=hidden.roll_rad,
        distortion=(hidden.k1, hidden.k2, hidden.p1, hidden.p2, 0.0),
    )


def _plate_m(jaw: JawPlate) -> tuple[float, float, float, float]:
    """A plate around the discs and the gripping point: x and y from, x and y to, m."""
    low, high = np.min(jaw.discs_m, axis=0), np.max(jaw.discs_m, axis=0)
    edges = (
        min(0.0, low[0] - jaw.radius_m),
        low[1] - jaw.radius_m - 0.0015,
        high[0] + jaw.radius_m + 0.0035,
        high[1] + jaw.radius_m + 0.0015,
    )
    x0, y0, x1, y1 = (round(float(edge), 6) for edge in edges)
    return x0, y0, x1, y1
