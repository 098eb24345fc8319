"""Checks the settings for entries that contradict each other."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator

import numpy as np
from scipy.special import ndtri

from cell.cable.geometry import Cable
from cell.files.input_error import Problem, did_you_mean
from cell.files.words import counted
from cell.files.yaml_document import Complaint, Document, Key
from cell.identify.noise import FEWEST_STILL_FRAMES
from cell.settings.devices import OpenCvCameraSettings, SerialGripperSettings, UrArmSettings
from cell.settings.model import REPEATABILITY_M, Settings
from cell.settings.plant import Handshake

#: Where an emulated camera may stream from.
STREAM = re.compile(r"tcp://(127(?:\.\d{1,3}){3}):(\d{1,5})")


def oddities(settings: Settings) -> tuple[str, ...]:
    """Warnings about entries that are possible but probably not intended."""
    arm = settings.arm
    if not isinstance(arm, UrArmSettings) or arm.plane_y_axis[2] >= 0.0:
        return ()
    return (
        f"arm.plane_y_axis {list(arm.plane_y_axis)} points down in the arm's base frame, and y is "
        "up: unless the arm hangs upside down, change its signs",
    )


def freedoms(settings: Settings, map_std_m: float | None) -> str:
    """Sentence on the options of a decision, and the narrowest opening that noise allows.

    map_std_m  standard deviation of the camera's map, over both axes; None = it is not measured
    """
    start, hold, offsets = settings.motion.freedom, settings.motion.hold, settings.motion.offsets
    free = start.window_s > 0.0
    begins = "at once, with one of the offsets"
    if free:
        paces = f", {len(start.paces)} slower paces" if start.paces else ""
        begins = f"up to {start.window_s:g} s later, between the offsets{paces}"
    held = f"{settings.motion.hold_s:g} s"
    if hold is not None:
        held = f"{hold.least_s:g} … {hold.most_s:g} s, as needed"
    noise_m = float(np.hypot(REPEATABILITY_M, (map_std_m or 0.0) / np.sqrt(2.0)))
    sure = float(ndtri(0.5 + 0.5 * settings.choice.min_probability))
    half_m = sure * noise_m + (0.0 if free else 0.5 * offsets.step_m)
    apart = " (the error of the camera's map, known after calibration, adds to this)"
    return (
        f"starts {begins}; holds {held}; feedback {settings.feedback}; serves openings "
        f"of ±{half_m * 1e3:.2f} mm at best" + (apart if map_std_m is None else "")
    )


def contradictions(document: Document, settings: Settings) -> list[Problem]:
    """Problems of entries that contradict each other."""
    complaints = [c for check in _CHECKS for c in check(settings)]
    # The reach of the tip is checked only if the gripper's poses are valid.
    complaints = complaints or [c for check in _CHECKS_OF_PLACES for c in check(settings)]
    return document.problems(complaints)


def _cable(settings: Settings) -> Iterator[Complaint]:
    if message := Cable(**settings.cable.model_dump()).implausible():
        yield ("cable", "line_density_kg_per_m"), message


def _offsets(settings: Settings) -> Iterator[Complaint]:
    offsets = settings.motion.offsets
    key: Key = ("motion", "offsets")
    if offsets.last_m < offsets.first_m:
        message = f"{offsets.last_m:g} m is less than first_m = {offsets.first_m:g} m"
        yield (*key, "last_m"), message
        return
    steps = (offsets.last_m - offsets.first_m) / offsets.step_m
    if abs(steps - round(steps)) > 1e-6:
        message = f"{offsets.step_m:g} m does not divide {offsets.first_m:g} … {offsets.last_m:g} m"
        yield (*key, "step_m"), message
    elif steps >= 1000:
        yield (*key, "step_m"), f"makes {round(steps)} offsets, limit 1000"


def _poses_within_limits(settings: Settings) -> Iterator[Complaint]:
    """Home, the lowest and the leftmost place of the gripper, each against the cell's limits."""
    motion, home = settings.motion, settings.motion.home
    lowered_m = home.y_m - motion.lower_m
    furthest_m = home.x_m - motion.advance_m - motion.freedom.further_m
    places: list[tuple[Key, str, float]] = [
        *(
            ((name, axis), axis, getattr(getattr(motion, name), axis))
            for name in ("home", "aside")
            for axis in ("x_m", "y_m", "angle_rad")
        ),
        (("lower_m",), "y_m", lowered_m),
        (("offsets", "last_m"), "y_m", lowered_m - motion.offsets.last_m),
        (("advance_m",), "x_m", home.x_m - motion.advance_m),
        (("start", "further_m"), "x_m", furthest_m),
    ]
    for key, axis, value in places:
        low, high = getattr(settings.limits, axis)
        if not low <= value <= high:
            message = (
                f"takes the gripper to {axis} = {value:g}, outside limits.{axis} = [{low:g}, "
                f"{high:g}]; move less, start elsewhere or widen the limits"
            )
            yield ("motion", *key), message


def _above_kinematic_limits(settings: Settings) -> Iterator[Complaint]:
    for stroke in ("lowering", "insertion"):
        for name in ("velocity_m_per_s", "acceleration_m_per_s2", "jerk_m_per_s3"):
            value = getattr(getattr(settings.motion, stroke), name)
            limit = getattr(settings.limits, name)
            if value > limit:
                message = f"{value:g} is beyond limits.{name} = {limit:g}; lower it"
                yield ("motion", stroke, name), message


def _retry(settings: Settings) -> Iterator[Complaint]:
    if settings.retry > 0 and settings.feedback == "off":
        message = (
            f"is {settings.retry}, but only feedback stops a cable in front of the opening; remove "
            "it, or set feedback: on"
        )
        yield ("retry",), message


def _devices(settings: Settings) -> Iterator[Complaint]:
    low, high = settings.gripper.force_limits_n
    if not low <= settings.gripper.force_n <= high:
        message = f"{settings.gripper.force_n:g} N is outside gripper.force_limits_n = "
        message += f"[{low:g}, {high:g}]"
        yield ("gripper", "force_n"), message
    kinds = {name: getattr(settings, name).kind for name in ("arm", "camera", "gripper")}
    real = [name for name, kind in kinds.items() if kind not in ("sim", "files")]
    if "sim" in kinds.values() and real:
        message = "a real device cannot act in the simulated world; "
        message += "make all three `sim`, or none of them"
        yield (real[0], "kind"), message
    if settings.arm.kind == "ur":
        x = np.array(settings.arm.plane_x_axis)
        y = np.array(settings.arm.plane_y_axis)
        size = float(np.linalg.norm(x) * np.linalg.norm(y))
        if size == 0.0 or abs(float(x @ y)) > 1e-3 * size:
            message = f"{x.tolist()} is not perpendicular to plane_y_axis {y.tolist()}"
            yield ("arm", "plane_x_axis"), message


def _calibration(settings: Settings) -> Iterator[Complaint]:
    """The map from pixels to the plane is typed or calibrated, not both, not neither."""
    if settings.camera.view is not None and settings.calibration is not None:
        message = "is calibrated (section `calibration`); leave out one of the two"
        yield ("camera", "view"), message
    elif settings.camera.view is None and settings.calibration is None:
        message = "is missing; add the section `calibration: {}` and run `cell calibrate`, or type "
        yield ("camera", "view"), message + "it by hand"
    elif settings.camera.view is None and settings.world.camera is None and _is_unreal(settings):
        message = "where the camera stands is missing: this cell is not real, so say it here"
        yield ("world", "camera"), message


def _is_unreal(settings: Settings) -> bool:
    return settings.camera.kind == "sim" or settings.emulated is not None


def _emulated(settings: Settings) -> Iterator[Complaint]:
    """Devices must have emulators, and their addresses must not be those of real ones."""
    if settings.emulated is None:
        return
    arm, camera, gripper = settings.arm, settings.camera, settings.gripper
    for section, configured, kind in (
        ("arm", arm.kind, "ur"),
        ("camera", camera.kind, "opencv"),
        ("gripper", gripper.kind, "serial"),
    ):
        if configured != kind:
            message = f"{configured!r} has no emulator; use {kind!r}, or leave out `emulated`"
            yield (section, "kind"), message
    if isinstance(arm, UrArmSettings) and not arm.host.startswith("127."):
        message = f"{arm.host} is no loopback address, there may be a real arm; "
        yield ("arm", "host"), message + "use 127.0.0.x, or leave out `emulated`"
    if isinstance(camera, OpenCvCameraSettings) and STREAM.fullmatch(str(camera.device)) is None:
        message = f"{camera.device!r} is not where an emulator may be; use tcp://127.0.0.x:port"
        yield ("camera", "device"), message
    port = gripper.port if isinstance(gripper, SerialGripperSettings) else ""
    if "://" in port:
        yield ("gripper", "port"), f"{port} is no line that can be made; name a file outside /dev"
    if port.startswith("/dev/"):
        message = f"{port} may be a real line; name one outside /dev, which is made"
        yield ("gripper", "port"), message


def _hidden_effects(settings: Settings) -> Iterator[Complaint]:
    if not settings.world.effects:
        return
    from cell.cable.effects import library, unscreened  # compiled code, which few settings need
    from cell.cable.live import shown_live

    known = library() | unscreened()
    for name, values in settings.world.effects.items():
        key: Key = ("world", "effects", name)
        if name not in known:
            message = f"unknown effect{did_you_mean(name, list(known))}"
            yield key, message
            continue
        try:
            known[name].active(**values)
        except ValueError as error:
            yield key, str(error)
        if settings.emulated is not None and not shown_live(known[name]):
            message = "cannot be shown live, as an emulated camera must; leave it out"
            yield key, message


def _model(settings: Settings) -> Iterator[Complaint]:
    if settings.model.effects or settings.model.prior is not None:
        from cell.settings.check_model import model_problems  # compiled code, as above

        yield from model_problems(settings)


def _destination_in_reach(settings: Settings) -> Iterator[Complaint]:
    """The destination must be within reach of a cable that is stretched in the last stroke."""
    motion, destination = settings.motion, settings.destination
    length_m = settings.cable.free_length_m
    end_x_m = motion.home.x_m - motion.advance_m
    entry_m = destination.x_m[1]
    if entry_m < end_x_m - length_m:
        message = (
            f"entry edge {entry_m:g} m is out of reach: the gripper ends its stroke at "
            f"{end_x_m:g} m and the free length is {length_m:g} m; give one farther right, or "
            "advance farther"
        )
        yield ("destination", "x_m"), message
    if entry_m > motion.home.x_m:
        message = (
            f"entry edge {entry_m:g} m lies behind the gripper, which starts at "
            f"{motion.home.x_m:g} m and moves left; move it left"
        )
        yield ("destination", "x_m"), message
    highest_m = motion.home.y_m - motion.lower_m - motion.offsets.first_m + length_m
    lowest_m = motion.home.y_m - motion.lower_m - motion.offsets.last_m - length_m
    low, high = destination.y_m
    if low > highest_m or high < lowest_m:
        message = (
            f"[{low:g}, {high:g}] is out of reach: with these offsets the tip is between "
            f"{lowest_m:g} and {highest_m:g} m; move it or change motion.offsets"
        )
        yield ("destination", "y_m"), message


def _in_view(settings: Settings) -> Iterator[Complaint]:
    """The path of the tip must be in the camera's view, otherwise nothing can be verified."""
    camera = settings.camera
    if camera.view is None:
        return  # seen when the calibration is read
    scale = camera.view.metres_per_pixel
    left_m = -camera.view.origin_column_px * scale
    top_m = camera.view.origin_row_px * scale
    picture = {
        "x_m": (left_m, left_m + (camera.width_px - 1) * scale),
        "y_m": (top_m - (camera.height_px - 1) * scale, top_m),
    }
    for name, (low, high) in picture.items():
        wanted = getattr(settings.destination, name)
        if wanted[0] < low or wanted[1] > high:
            message = (
                f"[{wanted[0]:g}, {wanted[1]:g}] is not all in the picture, which shows "
                f"{low:.4g} … {high:.4g} m; move it or correct camera.view"
            )
            yield ("destination", name), message


def _wide_enough(settings: Settings) -> Iterator[Complaint]:
    """The cable must fit into the destination, and the camera must see that it did."""
    view = settings.camera.view
    pixel_m = 0.0 if view is None else view.metres_per_pixel
    for name, least_m, limit in (
        ("x_m", pixel_m, "a pixel of the camera"),
        ("y_m", max(pixel_m, settings.cable.thickness_m), "the cable's thickness and a pixel"),
    ):
        low, high = getattr(settings.destination, name)
        if high - low < least_m:
            message = (
                f"[{low}, {high}] is {high - low:.2g} m wide, less than {limit} "
                f"({least_m:g} m); widen it"
            )
            yield ("destination", name), message


#: Frames of a swing; one is identified from some hundred.
MAX_FRAMES = 5_000


def _film(settings: Settings) -> Iterator[Complaint]:
    """Times and frame rate with which cables cannot be identified, or too slowly."""
    camera, motion = settings.camera, settings.motion
    rate_hz = camera.frame_rate_hz
    at_rest = int(motion.still_s * rate_hz + 1e-9)
    if at_rest < FEWEST_STILL_FRAMES:
        least_s = math.ceil(100.0 * FEWEST_STILL_FRAMES / rate_hz) / 100.0
        message = (
            f"{motion.still_s:g} s at {rate_hz:g} Hz makes {counted(at_rest, 'frame')} of "
            "the cable at rest; "
            f"its noise is known from {FEWEST_STILL_FRAMES} or more, and without them every cable "
            f"is rejected: give {least_s:g} s or more"
        )
        yield ("motion", "still_s"), message
    longest_s = motion.longest_hold_s
    frames = (motion.still_s + motion.lower_s + longest_s) * rate_hz
    if frames > MAX_FRAMES:
        message = (
            f"{longest_s:g} s at {rate_hz:g} Hz makes {frames:.0f} frames of a swing, limit "
            f"{MAX_FRAMES}; hold for a shorter time or film at a lower rate"
        )
        key: Key = ("hold_s",) if motion.hold is None else ("hold", "most_s")
        yield ("motion", *key), message
    exposure_s = getattr(camera, "exposure_s", None) or 0.0
    if exposure_s > 1.0 / rate_hz:
        message = f"{exposure_s:g} s is longer than a frame at {rate_hz:g} Hz"
        yield ("camera", "exposure_s"), message


def _plant(settings: Settings) -> Iterator[Complaint]:
    """Entries of the section `plant` that contradict others."""
    handshake = _handshake(settings)
    if handshake is None or handshake.carrier != "controller" or controller_of(settings):
        return
    message = (
        f"is missing: arm.kind is {settings.arm.kind!r}, so say which UR controller has the inputs "
        "and outputs"
    )
    yield ("plant", "handshake", "host"), message


def controller_of(settings: Settings) -> str | None:
    """Address of the controller with the signals of the handshake; None = there is none."""
    handshake = _handshake(settings)
    if handshake is not None and handshake.host is not None:
        return handshake.host
    return settings.arm.host if isinstance(settings.arm, UrArmSettings) else None


def _handshake(settings: Settings) -> Handshake | None:
    return None if settings.plant is None else settings.plant.handshake


_Check = Callable[[Settings], Iterator[Complaint]]
_CHECKS: tuple[_Check, ...] = (
    _cable, _offsets, _poses_within_limits, _above_kinematic_limits, _devices, _film, _emulated,
    _calibration, _hidden_effects, _model, _retry, _plant,
)  # fmt: skip
_CHECKS_OF_PLACES: tuple[_Check, ...] = (_destination_in_reach, _in_view, _wide_enough)
