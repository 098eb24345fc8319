"""What the settings may say of arm, camera and gripper, and of the world of a cell without them.

That is simulated or emulated: hidden cables and a hidden camera, emulators.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from cell.settings.section import (
    Exposure,
    Finite,
    Host,
    NotNegative,
    Pixels,
    PositiveRange,
    Section,
    address,
    increasing,
)


class SimulatedArm(Section):
    """Twin of an arm in the simulated world."""

    kind: Literal["sim"]
    rate_hz: Annotated[float, Field(ge=50.0, le=1000.0)] = 500.0
    """Poses commanded and measured per second."""
    lag_s: Annotated[float, Field(ge=0.0, le=0.3)] = 0.03
    """Delay of the arm's motion after the command."""
    noise_m: Annotated[float, Field(ge=0.0, le=1e-3)] = 10e-6
    """Standard deviation of a measured coordinate."""


def _in_quotes(given: object) -> object:
    """The version as text.  Raises ValueError: as a number 5.20 would be 5.2."""
    if isinstance(given, int | float):
        raise ValueError(f'{given} is a number; write the version in quotes: "{given}"')
    return given


Vector = tuple[Finite, Finite, Finite]
_LONGEST_TOOL_M, _TURN_RAD, _UNIT = 1.0, 2.0 * np.pi, 0.01


def _tool(tcp: tuple[float, ...]) -> tuple[float, ...]:
    """The tool itself.  Raises ValueError: millimetres or degrees, for all that one can see."""
    furthest = max(abs(v) for v in tcp[:3])
    if furthest > _LONGEST_TOOL_M:
        raise ValueError(
            f"a tool that is {furthest:g} m off the flange, at most {_LONGEST_TOOL_M:g} m; give x, "
            "y and z in metres, not millimetres"
        )
    turned = float(np.linalg.norm(tcp[3:]))
    if turned > _TURN_RAD:
        raise ValueError(
            f"a rotation vector of length {turned:g}, at most 2π; give rx, ry and rz in radians, "
            "not degrees"
        )
    return tcp


def _direction(axis: tuple[float, float, float]) -> tuple[float, float, float]:
    """The unit vector itself.  Raises ValueError: it is none."""
    length = float(np.linalg.norm(axis))
    if abs(length - 1.0) <= _UNIT:
        return axis
    shown = [float(v) for v in axis]
    if length == 0.0:
        raise ValueError(f"{shown} is no direction; give one of length 1, such as [0, -1, 0]")
    unit = [round(v / length, 6) + 0.0 for v in axis]
    raise ValueError(f"{shown} has length {length:g}, a direction has length 1; give {unit}")


Direction = Annotated[Vector, AfterValidator(_direction)]
#: No arm reaches further from its base, m.
Reach = Annotated[float, Field(ge=-3.0, le=3.0)]

#: Where Robotiq's URCap listens on a UR controller.
URCAP_PORT = 63352
#: A line that is reached through a network: its address and port.
_LINE_URL = re.compile(r"(socket|rfc2217)://([^/:]+|\[[0-9a-fA-F:]+\]):(\d{1,5})")


def _line(port: str) -> str:
    """The serial line itself.  Raises ValueError: neither a device nor a known kind of URL."""
    if "://" not in port:
        return port
    found = _LINE_URL.fullmatch(port)
    if found is None or not 1 <= int(found[3]) <= 65535:
        raise ValueError(
            f"{port!r} is no line; give a device such as /dev/ttyUSB0, or socket://host:port or "
            "rfc2217://host:port"
        )
    address(found[2].strip("[]"))
    if int(found[3]) == URCAP_PORT:
        raise ValueError(
            f"{port!r}: at port {URCAP_PORT} Robotiq's URCap takes lines of text, not the bytes of "
            f"a serial line; give `kind: urcap` and `host: {found[2]}` instead of port"
        )
    return port


_ALLOWED = r"^[1-9]\d{0,1}\.\d{1,3}$"


class UrArmSettings(Section):
    """Universal Robots arm over RTDE."""

    kind: Literal["ur"]
    host: Host
    """Address of the controller."""
    model: Literal["UR3e", "UR5e", "UR10e"] = "UR5e"
    """Arm's type, for its kinematics."""
    tcp: Annotated[tuple[Finite, Finite, Finite, Finite, Finite, Finite], AfterValidator(_tool)] = (
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
    )
    """Gripping point on the flange: x, y, z in m and rotation vector in rad. Its x and y axes are
    parallel to the plane's when the clamp is level."""
    rate_hz: Annotated[float, Field(ge=50.0, le=500.0)] = 500.0
    """Poses sent and measured per second: 500 for an e-series, 125 for a CB3."""
    lookahead_s: Annotated[float, Field(ge=0.03, le=0.2)] = 0.03
    """Lookahead of the controller (`servoj`): smooths the commanded path."""
    gain: Annotated[float, Field(ge=100.0, le=2000.0)] = 300.0
    """Gain of the controller (`servoj`)."""
    lag_s: Annotated[float, Field(ge=0.0, le=0.3)] = 0.034
    """Delay of the arm's motion after the command, with this lookahead."""
    plane_origin_m: tuple[Reach, Reach, Reach]
    """Origin of the cell's plane, in the robot's base frame."""
    plane_x_axis: Direction
    """Direction of the plane's x axis (away from the destination), in the base frame."""
    plane_y_axis: Direction = (0.0, 0.0, 1.0)
    """Direction of the plane's y axis (up), in the base frame."""
    allow_version: Annotated[str, Field(pattern=_ALLOWED), BeforeValidator(_in_quotes)] | None = (
        None
    )
    """Allows a PolyScope version that is not tested, e.g. "5.26", on your responsibility, after
    a dry run at low speed. Null = tested versions only."""

    @property
    def allowed_version(self) -> tuple[int, int] | None:
        """`allow_version` as numbers."""
        if self.allow_version is None:
            return None
        major, minor = self.allow_version.split(".")
        return int(major), int(minor)


class ViewSettings(Section):
    """Map from pixels to the cell's plane, for a camera at right angles to the plane."""

    metres_per_pixel: Annotated[float, Field(gt=0.0, le=0.01)]
    """Side of a pixel in the plane."""
    origin_column_px: Pixels
    """Column of the picture in which the plane's origin is seen."""
    origin_row_px: Pixels
    """Row of the picture in which the plane's origin is seen."""


class _Camera(Section):
    width_px: Annotated[int, Field(ge=64, le=10_000)] = 1280
    """Columns of a picture."""
    height_px: Annotated[int, Field(ge=64, le=10_000)] = 1024
    """Rows of a picture."""
    frame_rate_hz: Annotated[float, Field(ge=10.0, le=2000.0)] = 200.0
    """Pictures per second."""
    view: ViewSettings | None = None
    """Entered by hand, for a cell that is not calibrated; null = from the section `calibration`."""


class SimulatedCamera(_Camera):
    """Twin of a camera: renders the simulated world."""

    kind: Literal["sim"]
    exposure_s: Exposure = 0.0005
    """Exposure time."""
    lens_blur_px: Annotated[float, Field(ge=0.0, le=100.0)] = 0.6
    """Standard deviation of the blur by the lens."""
    read_noise: NotNegative = 1.0
    """Standard deviation of the read noise, grey levels."""


class RealCameraSettings(_Camera):
    """Settings that every camera has which is really there."""

    latency_s: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    """Shortest time from the middle of an exposure to the arrival of its picture."""
    lost_after_s: Annotated[float, Field(ge=0.01, le=5.0)] = 0.055
    """Time without a picture after which the camera counts as lost and the arm stops."""


class OpenCvCameraSettings(RealCameraSettings):
    """Camera of the operating system (UVC), through OpenCV."""

    kind: Literal["opencv"]
    device: Annotated[int, Field(ge=0)] | str = 0
    """Number or path of the device, or the URL of a stream."""
    exposure_s: Annotated[float, Field(gt=0.0, le=1.0)] | None = 0.0005
    """Exposure time, set and read back; null = unchanged, for streams."""
    fourcc: Annotated[str, Field(min_length=4, max_length=4)] | None = None
    """Pixel format, e.g. GREY or YUYV; null = unchanged."""
    stamps: Literal["device", "arrival"] = "device"
    """Timestamps of the pictures: the device's, or the time of arrival."""


class GenicamCameraSettings(RealCameraSettings):
    """Industrial camera through its GenTL producer."""

    kind: Literal["genicam"]
    producer: Path
    """The vendor's .cti file."""
    serial_number: str | None = None
    """Null = the only connected camera."""
    exposure_s: Annotated[float, Field(gt=0.0, le=1.0)] | None = 0.0005
    """Exposure time; null = unchanged."""


class FilesCameraSettings(_Camera):
    """Replays pictures from a folder."""

    kind: Literal["files"]
    folder: Path
    """Folder with the pictures and `frames.csv`, which has their times."""


_Force = Annotated[float, Field(ge=0.0, le=1000.0)]


class GripperSettings(Section):
    """Settings that every gripper has."""

    force_n: Annotated[float, Field(gt=0.0, le=235.0)]
    """Closing force."""
    force_limits_n: Annotated[tuple[_Force, _Force], AfterValidator(increasing)] = (1.0, 40.0)
    """Smallest force that holds the cable, largest that does not crush it."""


class SimulatedGripper(GripperSettings):
    """Twin of a gripper in the simulated world."""

    kind: Literal["sim"]


class SerialGripperSettings(GripperSettings):
    """Robotiq-type gripper (2F-85), Modbus RTU on a serial line."""

    kind: Literal["serial"]
    force_n: Annotated[float, Field(ge=20.0, le=235.0)]
    """Closing force, within what the gripper can do."""
    port: Annotated[str, Field(min_length=1), AfterValidator(_line)]
    """Device of the serial line, or `socket://host:port` for a serial server. A gripper on a
    UR's tool flange has `kind: urcap`."""
    address: Annotated[int, Field(ge=1, le=247)] = 9
    """Modbus address of the gripper."""
    baud: Annotated[int, Field(ge=1200)] = 115_200
    """Baud rate, bits per second."""
    reply_s: Annotated[float, Field(ge=0.005, le=1.0)] = 0.035
    """Longest time of a reply. After two missing replies the gripper counts as lost and the arm
    stops."""


class UrcapGripperSettings(GripperSettings):
    """Robotiq-type gripper (2F-85) on a UR's tool flange, through Robotiq's URCap."""

    kind: Literal["urcap"]
    force_n: Annotated[float, Field(ge=20.0, le=235.0)]
    """Closing force, within what the gripper can do."""
    host: Host
    """Address of the controller."""
    port: Annotated[int, Field(ge=1, le=65535)] = URCAP_PORT
    """TCP port of the URCap."""
    reply_s: Annotated[float, Field(ge=0.005, le=1.0)] = 0.07
    """Longest time of a reply. After a missing one the gripper counts as lost and the arm stops."""


class HiddenCamera(Section):
    """True position and lens of the camera of a simulated or emulated cell."""

    metres_per_pixel: Annotated[float, Field(gt=0.0, le=0.01)]
    """Side of a pixel in the cell's plane, in the middle of the picture."""
    origin_column_px: Pixels
    """Column in which a camera at right angles to the plane would see the plane's origin."""
    origin_row_px: Pixels
    """Row in which such a camera would see the plane's origin."""
    focal_px: Annotated[float, Field(ge=100.0, le=100_000.0)] = 2600.0
    """Focal length."""
    tilt_rad: Annotated[float, Field(ge=-0.7, le=0.7)] = 0.0
    """Rotation about the plane's x axis: positive = the camera looks down."""
    pan_rad: Annotated[float, Field(ge=-0.7, le=0.7)] = 0.0
    """Rotation about the plane's y axis."""
    roll_rad: Annotated[float, Field(ge=-0.7, le=0.7)] = 0.0
    """Rotation about the line of sight."""
    k1: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    """Radial distortion, coefficient of the squared radius; k2, p1 and p2 are also as in OpenCV."""
    k2: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    """Radial distortion, coefficient of the fourth power of the radius."""
    p1: Annotated[float, Field(ge=-0.01, le=0.01)] = 0.0
    """Tangential distortion, first coefficient."""
    p2: Annotated[float, Field(ge=-0.01, le=0.01)] = 0.0
    """Tangential distortion, second coefficient."""
    stamps_late_s: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    """Simulated camera: error of its timestamps, positive = late."""


class WorldSettings(Section):
    """The simulated cables and devices, with true values that the cell never reads."""

    camera: HiddenCamera | None = None
    """Null = those of `camera.view`."""
    arm_lag_s: Annotated[float, Field(ge=0.0, le=0.3)] | None = None
    """True lag of a simulated arm; null = `arm.lag_s`."""

    rigidity_n_m2: PositiveRange = (1.5e-5, 5e-5)
    """Range of the flexural rigidity of a simulated cable, drawn uniformly in its logarithm."""
    rigidity_variation: Annotated[float, Field(ge=0.0, le=0.5)] = 0.15
    """Relative amplitude of the rigidity's variation along the cable."""
    exponent: PositiveRange = (0.95, 1.05)
    """Bending exponent N."""
    damping_ratio: PositiveRange = (0.02, 0.06)
    """Damping ratio of the first swing mode; the viscosity follows from it."""
    effects: dict[str, dict[str, Finite]] = Field(default={})
    """Effects of the simulated world that the model lacks, with parameters, e.g. `air_drag:
    {drag_coefficient: 2.0}`."""
    segments: Annotated[int, Field(ge=60, le=400)] = 80
    """Segments of the simulated cable; more than the model has."""
    real_time_factor: Annotated[float, Field(ge=0.1, le=10.0)] | None = None
    """Speed of the simulation. Null = as fast as the computer can; 1 = real time: only then is the
    reported wait for the computer that of a real cell."""


class Emulated(Section):
    """Emulators of all three devices, at the addresses that the devices' own sections name.

    They speak the devices' protocols, so that the cell's real drivers work with them; `cell run`
    starts them unless `cell emulate` did.  The cables are those of `world`.
    """

    exposure_s: Exposure = 0.0005
    """Exposure time of the emulated camera."""
    readout_s: Annotated[float, Field(ge=0.008, le=0.1)] = 0.012
    """Time from the middle of an exposure to the moment the picture leaves the emulated camera."""
    polyscope: Annotated[str, Field(pattern=r"^[1-9]\d?(\.\d{1,9}){1,3}$")] = "5.12.2.1101534"
    """Software version of the emulated controller: major, minor, bugfix, build.  From 10 on it is
    PolyScope X, which has no dashboard server."""
    lens_blur_px: Annotated[float, Field(ge=0.0, le=100.0)] = 0.6
    """Standard deviation of the blur by the lens."""
    read_noise: NotNegative = 1.0
    """Standard deviation of the read noise, grey levels."""
