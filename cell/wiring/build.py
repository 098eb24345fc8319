"""Settings → a live cell.  The only file that names concrete drivers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import time as time_of_day
from functools import partial
from importlib.metadata import version
from pathlib import Path

import numpy as np

from cell.computer.memory import use_one_arena
from cell.computer.second_process import SecondProcess
from cell.plan.choose import ChoiceOptions, Freedom
from cell.plan.destination import Destination
from cell.plan.paths import MotionLimits
from cell.records.ledger.outbox import LaterLedger, LedgerWriter, outbox_of
from cell.records.recording.devices import recorded_devices
from cell.records.recording.recorder import Recorder
from cell.records.recording.retention import Retention
from cell.records.recording.store import Store
from cell.records.recording.uploads import Uploads
from cell.run.archive import Archive, LedgerSetup, RecordingSetup
from cell.run.clocks import CalibratedDelays
from cell.run.cycle import Cell
from cell.run.station import ProductTask, Task
from cell.settings import InputError, Settings
from cell.settings import devices as device_settings
from cell.settings.calibrated import Calibrated, as_gripped, typed
from cell.settings.plugged import plugged_in
from cell.settings.provenance import calibration_hash, files_of, line_name
from cell.settings.records import LedgerSettings
from cell.settings.translate import (
    arm_limits_of,
    cable_of,
    identification_of,
    model_hash,
    pose_of,
    vision_of,
)
from cell.wiring.emulated import EmulatedCell, runs_already
from cell.wiring.ownership import owned
from cell.wiring.simulated_assistant import SimulatedAssistant
from cell.wiring.twins import Twins, build_twins
from drivers.clock import RealClock
from drivers.emulators.launch import EmulatorError
from drivers.files import FilesCamera
from drivers.genicam_camera import GenicamCamera, GenicamOptions
from drivers.guard import (
    GripperLimits,
    GuardedArm,
    GuardedCamera,
    GuardedGripper,
)
from drivers.interfaces import Arm, Camera, Clock, Devices, Gripper
from drivers.opencv_camera import OpenCvCamera, OpenCvOptions
from drivers.plane_mount import PlaneMount
from drivers.priority import take_precedence
from drivers.recording import CaptureOptions
from drivers.serial_gripper import SerialGripper, SerialGripperOptions
from drivers.ur import UrArm, UrOptions
from drivers.urcap_gripper import UrcapGripper, UrcapGripperOptions

#: Longest wait of a frame for the recorder in simulated time, s: it delays nothing else there.
PATIENCE_S = 60.0


def listed(settings: Settings, runs: Path) -> LedgerSetup | None:
    """Ledger of the settings, with its writer's thread started; None = the settings name none."""
    section = settings.ledger
    if section is None:
        return None
    writer = LedgerWriter(LaterLedger(section.url or runs), outbox_of(runs))
    writer.start()
    return LedgerSetup(writer, line_name(settings), software=version("cable-cell"))


def in_real_time(settings: Settings) -> bool:
    """Whether the cell's clock runs at the speed of real time, so that computing time counts."""
    simulated = isinstance(settings.arm, device_settings.SimulatedArm)
    return not simulated or settings.world.real_time_factor is not None


def with_recorder(
    settings: Settings, devices: Devices, runs: Path
) -> tuple[Devices, RecordingSetup | None]:
    """Recorded devices, and the set-up of recordings; None = nothing is recorded."""
    section = settings.recording
    if section is None:
        return devices, None
    patience_s = 0.0 if in_real_time(settings) else PATIENCE_S
    recorder = Recorder(devices.arm, devices.clock, section.memory_mb * 10**6, patience_s)
    shifts = (settings.ledger or LedgerSettings()).shifts
    retention = Retention(runs, section, tuple(map(time_of_day.fromisoformat, shifts)))
    uploads = None
    if section.store is not None:
        uploads = Uploads(partial(Store, section.store), runs, line_name(settings))
        uploads.start()
    recording = RecordingSetup(recorder, wanted=section, retention=retention, uploads=uploads)
    return recorded_devices(devices, recorder, uploads), recording


_UR_TUNING = ("lookahead_s", "gain")
#: Largest 95 % half width of latency and lag for corrections in flight, s.
FEEDBACK_TIME_S = 2e-3


def build_cell(
    settings: Settings,
    runs: Path,
    *,
    seed: int,
    cycles: int | None,
    on_step: Callable[[int, str], None] = lambda number, step: None,
    calibration: Calibrated | None = None,
    twins: Twins | None = None,
    others: Sequence[Task] = (),
) -> Cell:
    """A cell with its devices, none of them connected yet, that records and lists its cycles.

    seed    of the simulated cables and of their devices' noise
    cycles  number of simulated cables; None = unlimited
    calibration  of camera and clocks; None = as typed
    twins   of a simulated cell; None = built here
    others  tasks of further products, see `Cell`
    """
    if isinstance(settings.arm, device_settings.SimulatedArm):
        twins = build_twins(settings, seed, cycles, calibration) if twins is None else twins
        devices = twin_devices(twins)
    else:
        take_precedence()
        devices = real_devices(settings, calibration)
    devices, recording = with_recorder(settings, devices, runs)
    archive = Archive(recording, listed(settings, runs))
    return cell_with(settings, devices, runs, on_step, calibration, archive=archive, others=others)


def guarded_devices(settings: Settings, devices: Devices) -> Devices:
    """Devices guarded by the limits of the settings."""
    return replace(
        devices,
        arm=GuardedArm(devices.arm, arm_limits_of(settings)),
        camera=GuardedCamera(devices.camera, devices.clock),
        gripper=GuardedGripper(devices.gripper, GripperLimits(*settings.gripper.force_limits_n)),
    )


def cell_with(
    settings: Settings,
    devices: Devices,
    runs: Path,
    on_step: Callable[[int, str], None],
    calibration: Calibrated | None = None,
    *,
    archive: Archive | None = None,
    others: Sequence[Task] = (),
) -> Cell:
    """A cell with existing devices, guarded by their limits.

    archive  where its cycles are recorded and listed; None = nowhere
    others   tasks of further products, see `Cell`
    """
    use_one_arena()
    guarded = guarded_devices(settings, devices)
    watched = isinstance(devices.clock, RealClock)
    return Cell(
        guarded,
        product_task(settings, calibration),
        runs,
        on_step,
        computer=SecondProcess() if in_real_time(settings) else None,
        watched=watched,
        archive=archive,
        others=others,
    )


def product_task(settings: Settings, calibration: Calibrated | None = None) -> ProductTask:
    """Task of the settings, which are resolved for a product if there are some."""
    return ProductTask(
        settings.product,
        cell_task(settings, calibration),
        settings.model_dump(mode="json"),
        files_of(settings),
        calibration_hash(settings),
    )


@contextmanager
def emulating(settings: Settings, config: Path, seed: int) -> Iterator[EmulatedCell]:
    """Run emulators of the devices, at the addresses in the settings.

    config  the settings' file
    raises  InputError: the cell is simulated, or its settings have no section `emulated`; or an
            emulator does not start
    """
    if isinstance(settings.arm, device_settings.SimulatedArm):
        message = (
            "this cell is simulated and needs no emulators; `cell init --emulated` writes the "
            "settings of an emulated cell"
        )
        raise InputError.at(config, message, key="arm.kind")
    if settings.emulated is None:
        raise InputError.at(config, "is missing; add `emulated: {}`", key="emulated")
    with ExitStack() as stack:
        try:
            cell = stack.enter_context(EmulatedCell(settings, seed))
        except EmulatorError as error:
            raise InputError.at(config, str(error), key="emulated") from error
        yield cell


@contextmanager
def emulators_asked_for(settings: Settings, config: Path, seed: int) -> Iterator[None]:
    """Run emulators if the settings have some and none run yet.  Raises as `emulating`."""
    with ExitStack() as stack:
        if settings.emulated is not None and not runs_already(settings):
            stack.enter_context(emulating(settings, config, seed))
        yield


@contextmanager
def staged_devices(
    settings: Settings, config: Path, calibration: Calibrated, seed: int, views: int
) -> Iterator[tuple[Devices, SimulatedAssistant | None]]:
    """The devices of a cell that is to be calibrated, owned and none of them connected yet.
    With the simulated assistant; None = a person assists.

    views   of the board that a simulated assistant has ready
    raises  InputError: another program owns them; emulators do not start, or run already
    """
    with ExitStack() as stack:
        stack.enter_context(owned(settings, config))
        assistant = None
        if isinstance(settings.arm, device_settings.SimulatedArm):
            twins = build_twins(settings, seed, 1, calibration)
            devices = twin_devices(twins)
            assistant = SimulatedAssistant(settings, twins.stage, seed, views)
        else:
            if settings.emulated is not None:
                if runs_already(settings):
                    raise InputError.at(
                        config,
                        "emulators run already, and cannot be shown the board; end `cell emulate`; "
                        "calibrating starts its own",
                        key="emulated",
                    )
                emulated = stack.enter_context(emulating(settings, config, seed))
                assistant = SimulatedAssistant(settings, emulated.camera.notify, seed, views)
            devices = real_devices(settings, calibration)
        yield guarded_devices(settings, devices), assistant


def twin_devices(twins: Twins) -> Devices:
    """The twins as the cell's devices."""
    return Devices(twins.arm, twins.camera, twins.gripper, twins.world.clock)


def real_devices(settings: Settings, calibration: Calibrated | None = None) -> Devices:
    """Arm, camera and gripper as the settings name them, not connected yet.

    calibration  their delays; None = as typed
    """
    calibration = typed(settings) if calibration is None else calibration
    clock, lag_s, latency_s = RealClock(), calibration.lag_s, calibration.latency_s
    return Devices(
        arm=plugged_in("arm", settings.arm, clock, lag_s) or _real_arm(settings, lag_s),
        camera=plugged_in("camera", settings.camera, clock, latency_s)
        or _real_camera(settings, clock, latency_s),
        gripper=plugged_in("gripper", settings.gripper, clock) or _real_gripper(settings, clock),
        clock=clock,
    )


def _real_arm(settings: Settings, lag_s: float) -> Arm:
    arm = settings.arm
    assert isinstance(arm, device_settings.UrArmSettings)
    mount = PlaneMount(arm.plane_origin_m, arm.plane_x_axis, arm.plane_y_axis)
    options = arm.model_dump(include={"host", "model", "tcp", "rate_hz", *_UR_TUNING})
    options |= {"lag_s": lag_s, "allow_version": arm.allowed_version}
    return UrArm(UrOptions(mount=mount, **options))


def _real_camera(settings: Settings, clock: RealClock, latency_s: float) -> Camera:
    values = settings.camera.model_dump(exclude={"kind", "view", "latency_s", "lost_after_s"})
    match settings.camera:
        case device_settings.OpenCvCameraSettings() as camera:
            capture = CaptureOptions(latency_s, lost_after_s=camera.lost_after_s)
            return OpenCvCamera(OpenCvOptions(**values, capture=capture), clock)
        case device_settings.GenicamCameraSettings() as camera:
            capture = CaptureOptions(latency_s, lost_after_s=camera.lost_after_s)
            return GenicamCamera(GenicamOptions(**values, capture=capture), clock)
        case device_settings.FilesCameraSettings() as camera:
            return FilesCamera(camera.folder, camera.frame_rate_hz, clock)
    raise AssertionError("the settings refuse a simulated camera with a real arm")


def _real_gripper(settings: Settings, clock: Clock) -> Gripper:
    values = settings.gripper.model_dump(exclude={"kind", "force_n", "force_limits_n"})
    match settings.gripper:
        case device_settings.SerialGripperSettings():
            return SerialGripper(SerialGripperOptions(**values), clock)
        case device_settings.UrcapGripperSettings():
            return UrcapGripper(UrcapGripperOptions(**values), clock)
    raise AssertionError("the settings refuse a simulated gripper with a real arm")


def cell_task(settings: Settings, calibration: Calibrated | None = None) -> Task:
    """Task for every cable by the settings; `calibration` None = as typed."""
    calibration = typed(settings) if calibration is None else calibration
    settings = as_gripped(settings, calibration)
    motion = settings.motion
    return Task(
        cable=cable_of(settings),
        destination=Destination(*settings.destination.x_m, *settings.destination.y_m),
        home=pose_of(motion.home),
        aside=pose_of(motion.aside),
        calm_s=motion.calm_s,
        still_s=motion.still_s,
        lower_m=motion.lower_m,
        lower_s=motion.lower_s,
        hold_s=motion.longest_hold_s,
        least_hold_s=None if motion.hold is None else motion.hold.least_s,
        decide_s=motion.decide_s,
        offsets_m=motion.offsets.values_m,
        advance_m=motion.advance_m,
        feedback=corrects_in_flight(settings, calibration),
        retries=settings.retry,
        settle_s=motion.settle_s,
        lowering=MotionLimits(**motion.lowering.model_dump()),
        insertion=MotionLimits(**motion.insertion.model_dump()),
        force_n=settings.gripper.force_n,
        view=calibration.view,
        map_std_m=calibration.map_std_m,
        delays=_delays(settings, calibration),
        vision=vision_of(settings),
        identification=identification_of(settings),
        choice=_choice(settings, calibration),
        model=model_hash(settings.model),
    )


def corrects_in_flight(settings: Settings, calibration: Calibrated) -> bool:
    """Whether insertions are corrected in flight; `auto` = if the delays are well known."""
    if settings.feedback != "auto":
        return settings.feedback == "on"
    return calibration.delays_95_s is not None and max(calibration.delays_95_s) <= FEEDBACK_TIME_S


def _delays(settings: Settings, calibration: Calibrated) -> CalibratedDelays | None:
    """Uncertainty of the delays, and their allowed change; None = not known."""
    if calibration.delays_95_s is None or settings.calibration is None:
        return None
    return CalibratedDelays(
        *calibration.delays_95_s, settings.calibration.max_time_error_s, calibration.remedy
    )


def _choice(settings: Settings, calibration: Calibrated) -> ChoiceOptions:
    """Options of the choice; the uncertainty of the map adds to that of the destination."""
    start = settings.motion.freedom
    options = ChoiceOptions(
        least_probability=settings.choice.min_probability,
        freely=Freedom(start.window_s, start.paces, start.further_m),
    )
    upright_m = calibration.map_std_m / np.sqrt(2.0)
    return replace(options, repeatability_m=float(np.hypot(options.repeatability_m, upright_m)))
