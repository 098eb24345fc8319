"""Settings → a live cell.  The only file that names concrete drivers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib.plane import PlaneView
from cell.bench import Devices, Task
from cell.cable.dynamics import Solver, simulate
from cell.cable.effects import library, rare
from cell.cable.geometry import Cable, Motion
from cell.cable.model import CableModel
from cell.computing import SecondProcess
from cell.cycle import Cell
from cell.identify.individual import IdentifyOptions
from cell.memory import one_heap
from cell.plan.choose import ChoiceOptions
from cell.plan.destination import Destination
from cell.plan.paths import MotionLimits
from cell.settings import Settings
from cell.settings import model as given
from cell.vision.detect import VisionOptions
from drivers.clock import RealClock
from drivers.files import FilesCamera
from drivers.genicam_camera import GenicamCamera, GenicamOptions
from drivers.guard import (
    ArmLimits,
    GripperLimits,
    GuardedArm,
    GuardedCamera,
    GuardedGripper,
)
from drivers.interfaces import Camera, Pose
from drivers.interfaces import Path as HandPath
from drivers.opencv_camera import OpenCvCamera, OpenCvOptions
from drivers.plane_mount import PlaneMount
from drivers.recording import CaptureOptions
from drivers.serial_gripper import SerialGripper, SerialGripperOptions
from drivers.sim.arm import ArmTwinOptions, SimArm
from drivers.sim.camera import CameraTwinOptions, SimCamera
from drivers.sim.clock import SimClock
from drivers.sim.gripper import SimGripper
from drivers.sim.render import RenderOptions
from drivers.sim.world import CableShape, World
from drivers.ur import UrArm, UrOptions

FloatArray = NDArray[np.float64]

#: Knots of the simulated cables' flexural rigidity; more than the model has.
HIDDEN_KNOTS = 13
#: First eigenvalue β₁L of a clamped beam.
FIRST_MODE = 1.8751

_UR_TUNING = ("lookahead_s", "gain", "lag_s")


def hidden_cable(settings: Settings, seed: int, number: int) -> CableModel:
    """The `number`-th individual of a simulated batch: what the cell must find out.

    Its rigidity varies along the cable, its exponent is not 1; both come from the seed alone.
    """
    truth, known = settings.world, library() | rare()
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
    arc_length_m = np.linspace(model.cable.free_length_m, 0.0, segments + 1)
    solver = Solver(segments=segments)

    def shape(grip: HandPath, query_s: FloatArray) -> FloatArray:
        motion = Motion(grip.t_s, grip.x_m, grip.y_m, grip.angle_rad)
        shapes: FloatArray = simulate(model, motion, query_s, arc_length_m, solver=solver)[0]
        return shapes

    return shape


def cable_of(settings: Settings) -> Cable:
    """The datasheet."""
    return Cable(**settings.cable.model_dump())


@dataclass(frozen=True)
class Twins:
    """The simulated world and the devices in it, without the limits around them."""

    world: World
    arm: SimArm
    camera: SimCamera | FilesCamera
    gripper: SimGripper


def build_cell(
    settings: Settings,
    runs: Path,
    *,
    seed: int,
    cycles: int,
    on_step: Callable[[int, str], None] = lambda number, step: None,
) -> Cell:
    """A cell with its devices, none of them connected yet.

    seed    of the simulated cables and of their devices' noise
    cycles  so many simulated cables are laid out
    """
    if isinstance(settings.arm, given.SimulatedArm):
        devices = twin_devices(build_twins(settings, seed, cycles))
    else:
        devices = real_devices(settings)
    return cell_with(settings, devices, runs, on_step)


def cell_with(
    settings: Settings, devices: Devices, runs: Path, on_step: Callable[[int, str], None]
) -> Cell:
    """A cell around given devices, which it surrounds with their limits."""
    one_heap()
    guarded = Devices(
        arm=GuardedArm(devices.arm, _arm_limits(settings)),
        camera=GuardedCamera(devices.camera, devices.clock),
        gripper=GuardedGripper(devices.gripper, GripperLimits(*settings.gripper.force_limits_n)),
        clock=devices.clock,
    )
    watched = isinstance(devices.clock, RealClock)
    hurried = watched or settings.world.real_time_factor is not None
    return Cell(
        guarded,
        _task(settings),
        settings.model_dump(mode="json"),
        runs,
        on_step,
        computer=SecondProcess() if hurried else None,
        watched=watched,
    )


def build_twins(settings: Settings, seed: int, cycles: int) -> Twins:
    """The simulated world with `cycles` cables laid out; for settings whose devices are `sim`."""
    arm = settings.arm
    assert isinstance(arm, given.SimulatedArm)
    clock = SimClock(real_time_factor=settings.world.real_time_factor)
    world = World(clock, _pose(settings.motion.home))
    for number in range(1, cycles + 1):
        world.present(cable_shape(hidden_cable(settings, seed, number), settings.world.segments))
    options = ArmTwinOptions(lag_s=arm.lag_s, rate_hz=arm.rate_hz, noise_m=arm.noise_m)
    return Twins(
        world,
        SimArm(world, options, seed=seed),
        _simulated_camera(settings, world, seed),
        SimGripper(world),
    )


def twin_devices(twins: Twins) -> Devices:
    """The twins as the cell's devices."""
    return Devices(twins.arm, twins.camera, twins.gripper, twins.world.clock)


def _simulated_camera(settings: Settings, world: World, seed: int) -> SimCamera | FilesCamera:
    camera = settings.camera
    if isinstance(camera, given.FilesCamera):
        return FilesCamera(camera.folder, camera.frame_rate_hz, world.clock)
    assert isinstance(camera, given.SimulatedCamera)
    return SimCamera(world, camera_twin(settings, camera, seed), seed=seed)


def camera_twin(
    settings: Settings, look: given.SimulatedCamera | given.Emulated, seed: int
) -> CameraTwinOptions:
    """Pictures as the camera of the settings takes them; `look` tells how good they are."""
    camera = settings.camera
    assert not isinstance(camera, given.FilesCamera)
    picture = RenderOptions(
        width_px=camera.width_px,
        height_px=camera.height_px,
        thickness_m=settings.cable.thickness_m,
        lens_blur_px=look.lens_blur_px,
        exposure_s=look.exposure_s,
        read_noise=look.read_noise,
        scene_seed=seed,
    )
    return CameraTwinOptions(_view(camera.view).homography, picture, camera.frame_rate_hz)


def real_devices(settings: Settings) -> Devices:
    """Arm, camera and gripper as the settings name them, not connected yet."""
    arm, gripper, clock = settings.arm, settings.gripper, RealClock()
    assert isinstance(arm, given.UrArm)
    assert isinstance(gripper, given.SerialGripper)
    mount = PlaneMount(arm.plane_origin_m, arm.plane_x_axis, arm.plane_y_axis)
    reached = arm.model_dump(include={"host", "model", "tcp", "rate_hz", *_UR_TUNING})
    serial = gripper.model_dump(include={"port", "address", "baud", "reply_s"})
    return Devices(
        arm=UrArm(UrOptions(mount=mount, **reached)),
        camera=_real_camera(settings, clock),
        gripper=SerialGripper(SerialGripperOptions(**serial), clock),
        clock=clock,
    )


def _real_camera(settings: Settings, clock: RealClock) -> Camera:
    values = settings.camera.model_dump(exclude={"kind", "view", "latency_s", "lost_after_s"})
    match settings.camera:
        case given.OpenCvCamera() as camera:
            capture = CaptureOptions(camera.latency_s, lost_after_s=camera.lost_after_s)
            return OpenCvCamera(OpenCvOptions(**values, capture=capture), clock)
        case given.GenicamCamera() as camera:
            capture = CaptureOptions(camera.latency_s, lost_after_s=camera.lost_after_s)
            return GenicamCamera(GenicamOptions(**values, capture=capture), clock)
        case given.FilesCamera() as camera:
            return FilesCamera(camera.folder, camera.frame_rate_hz, clock)
    raise AssertionError("the settings refuse a simulated camera beside a real arm")


def _task(settings: Settings) -> Task:
    motion = settings.motion
    return Task(
        cable=cable_of(settings),
        destination=Destination(*settings.destination.x_m, *settings.destination.y_m),
        home=_pose(motion.home),
        aside=_pose(motion.aside),
        calm_s=motion.calm_s,
        still_s=motion.still_s,
        lower_m=motion.lower_m,
        lower_s=motion.lower_s,
        hold_s=motion.hold_s,
        decide_s=motion.decide_s,
        offsets_m=motion.offsets.values_m,
        advance_m=motion.advance_m,
        settle_s=motion.settle_s,
        lowering=MotionLimits(**motion.lowering.model_dump()),
        insertion=MotionLimits(**motion.insertion.model_dump()),
        force_n=settings.gripper.force_n,
        view=_view(settings.camera.view),
        vision=VisionOptions(free_length_m=settings.cable.free_length_m),
        identification=IdentifyOptions(method=settings.identification.method),
        choice=ChoiceOptions(least_probability=settings.choice.min_probability),
    )


def _arm_limits(settings: Settings) -> ArmLimits:
    limits = settings.limits
    return ArmLimits(
        *limits.x_m,
        *limits.y_m,
        *limits.angle_rad,
        max_speed_m_per_s=limits.velocity_m_per_s,
        max_acceleration_m_per_s2=limits.acceleration_m_per_s2,
        max_jerk_m_per_s3=limits.jerk_m_per_s3,
    )


def _pose(pose: given.Pose) -> Pose:
    return Pose(pose.x_m, pose.y_m, pose.angle_rad)


def _view(view: given.View) -> PlaneView:
    return PlaneView.from_scale(view.metres_per_pixel, view.origin_column_px, view.origin_row_px)
