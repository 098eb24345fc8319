"""What a cell's settings may say: sections, units, ranges and defaults."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, Tag

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(gt=0.0, lt=1.0)]


def _increasing(pair: tuple[float, float]) -> tuple[float, float]:
    if not pair[0] < pair[1]:
        raise ValueError(f"[{pair[0]:g}, {pair[1]:g}] is not a range; give [lower, upper]")
    return pair


Range = Annotated[tuple[Finite, Finite], AfterValidator(_increasing)]

#: Coordinates in the cell's plane, m; distances and durations of a motion, m and s.
Place = Annotated[float, Field(ge=-10.0, le=10.0)]
Distance = Annotated[float, Field(gt=0.0, le=1.0)]
Duration = Annotated[float, Field(gt=0.0, le=30.0)]
Wait = Annotated[float, Field(ge=0.0, le=30.0)]
Angle = Annotated[float, Field(ge=-np.pi, le=np.pi)]
PlaceRange = Annotated[tuple[Place, Place], AfterValidator(_increasing)]
PositiveRange = Annotated[tuple[Positive, Positive], AfterValidator(_increasing)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class Cable(_Section):
    """Datasheet of the cable: what all its individuals have in common."""

    free_length_m: Annotated[float, Field(gt=0.0, le=2.0)]
    """From the jaw's edge to the tip."""
    line_density_kg_per_m: Annotated[float, Field(gt=0.0, le=10.0)]
    """Mass per metre."""
    width_m: Annotated[float, Field(gt=0.0, le=0.5)]
    """Width of the strip, across the picture."""
    thickness_m: Annotated[float, Field(gt=0.0, le=0.5)]
    """Thickness, as the camera sees it edge-on."""


class Destination(_Section):
    """Rectangle that the tip must pass, moving left: the hole's mouth."""

    x_m: PlaceRange
    """From the far edge to the edge where the tip enters."""
    y_m: PlaceRange
    """From the lower to the upper edge."""


class HandPose(_Section):
    """Pose of the gripping point in the cell's plane."""

    x_m: Place = 0.0
    y_m: Place = 0.0
    angle_rad: Angle = 0.0
    """Clamp angle: 0 = level, positive = pointing down."""


class Offsets(_Section):
    """Distances down that are simulated, one of which is executed."""

    first_m: NotNegative = 0.0
    last_m: NotNegative = 0.040
    step_m: Positive = 0.002

    @property
    def values_m(self) -> tuple[float, ...]:
        """All of them, ascending."""
        count = round((self.last_m - self.first_m) / self.step_m) + 1
        return tuple(round(self.first_m + self.step_m * i, 9) for i in range(count))


class Briskness(_Section):
    """How briskly the hand moves along either axis; no arm of this kind is brisker."""

    velocity_m_per_s: Annotated[float, Field(gt=0.0, le=5.0)]
    acceleration_m_per_s2: Annotated[float, Field(gt=0.0, le=100.0)]
    jerk_m_per_s3: Annotated[float, Field(gt=0.0, le=50_000.0)]


class Motion(_Section):
    """What the hand does in a cycle."""

    home: HandPose = HandPose()
    """Where a cable is grasped."""
    aside: HandPose = HandPose(x_m=0.015, y_m=-0.05)
    """Where a rejected cable is let go."""
    calm_s: Wait = 0.5
    """After grasping, until the cable rests."""
    still_s: Duration = 0.2
    """Filmed at rest before the cable is moved; shows the noise and the still shape."""
    lower_m: Distance = 0.050
    """Down, to make the cable swing."""
    lower_s: Duration = 0.3
    """In this time, or as long as the limits ask."""
    hold_s: Duration = 1.0
    """Held still while the swing is filmed."""
    decide_s: Wait = 0.2
    """From the last frame of the swing until the execution begins: time for the computer."""
    offsets: Offsets = Offsets()
    advance_m: Distance = 0.050
    """Left, towards the destination."""
    settle_s: Wait = 0.2
    """Filmed after the hand has come to rest."""
    lowering: Briskness = Briskness(
        velocity_m_per_s=0.5, acceleration_m_per_s2=5.0, jerk_m_per_s3=200.0
    )
    """Brisk, so that the swing is worth filming."""
    insertion: Briskness = Briskness(
        velocity_m_per_s=0.2, acceleration_m_per_s2=1.0, jerk_m_per_s3=10.0
    )
    """Gentle, so that neighbouring offsets lead the tip to neighbouring heights."""


class Limits(Briskness):
    """Beyond these no command is sent, whatever the motion asks for."""

    x_m: PlaceRange
    y_m: PlaceRange
    angle_rad: Annotated[tuple[Angle, Angle], AfterValidator(_increasing)]


class Identification(_Section):
    """How this cable's parameters are found."""

    method: Literal["map", "paper"] = "map"
    """`map`: all frames together, with covariance.  `paper`: still shape, then swing, iterated."""


class Choice(_Section):
    """When an offset is good enough to be executed."""

    min_probability: Fraction = 0.9
    """Least probability that the tip passes the destination; below it the cable is rejected."""


class KnownParameter(_Section):
    """A parameter of an effect that is known."""

    fixed: Finite
    """Its value."""
    std: NotNegative = 0.0
    """Standard deviation of the value; 0 = exact.  Otherwise a cable's frames may correct it, by no
    more than it is uncertain."""


class ModelEffect(_Section):
    """Physics that the cables have beside the baseline."""

    effect: Annotated[str, Field(min_length=1)]
    """Name of an effect of the library, or a file.py with one of your own."""
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    """Of the file: a file that was changed is refused.  Null = whatever is in it."""
    parameters: dict[
        str,
        Annotated[
            Annotated[KnownParameter, Tag("known")]
            | Annotated[Literal["prior", "fitted"], Tag("word")],
            Discriminator(lambda given: "word" if isinstance(given, str) else "known"),
        ],
    ] = {}
    """Each known, with a batch's `prior`, or `fitted` to every cable; not named = fitted."""


class BatchPrior(_Section):
    """Gaussian prior of an individual's parameters: what a batch of cables has shown."""

    names: list[str]
    """`rigidity_0` … `rigidity_5` (EI from the jaw to the tip), `exponent`, `viscosity`, and
    `effect.parameter` for those of effects."""
    mean: list[Finite]
    """Natural values, one per name."""
    covariance: list[list[Finite]]
    """Of their logarithms, except for the exponent and for effects' parameters that may be 0."""


class Model(_Section):
    """What all cables have in common beside the data sheet; empty = the baseline model.

    `cell learn` finds it out and `cell promote` writes it here."""

    effects: list[ModelEffect] = []
    prior: BatchPrior | None = None
    """Null = a weak one."""


# --- devices ----------------------------------------------------------------------------------


class SimulatedArm(_Section):
    """Twin of an arm in the simulated world."""

    kind: Literal["sim"]
    rate_hz: Annotated[float, Field(ge=50.0, le=1000.0)] = 500.0
    lag_s: Annotated[float, Field(ge=0.0, le=0.3)] = 0.03
    """How late it follows."""
    noise_m: NotNegative = 10e-6
    """Standard deviation of a measured coordinate."""


class UrArm(_Section):
    """Universal Robots arm over RTDE."""

    kind: Literal["ur"]
    host: Annotated[str, Field(min_length=1)]
    """Address of the controller."""
    model: Literal["UR3e", "UR5e", "UR10e"] = "UR5e"
    tcp: tuple[Finite, Finite, Finite, Finite, Finite, Finite] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """Gripping point on the flange: x, y, z in m and rotation vector in rad.  Its x and y axes are
    the plane's when the clamp is level."""
    rate_hz: Annotated[float, Field(ge=50.0, le=500.0)] = 500.0
    lookahead_s: Annotated[float, Field(ge=0.03, le=0.2)] = 0.03
    gain: Annotated[float, Field(ge=100.0, le=2000.0)] = 300.0
    lag_s: Annotated[float, Field(ge=0.0, le=0.3)] = 0.034
    """Measured with this lookahead."""
    plane_origin_m: tuple[Finite, Finite, Finite]
    """Origin of the cell's plane, in the robot's base frame."""
    plane_x_axis: tuple[Finite, Finite, Finite]
    """Direction of the plane's x axis (away from the destination), in the base frame."""
    plane_y_axis: tuple[Finite, Finite, Finite] = (0.0, 0.0, 1.0)
    """Direction of the plane's y axis (up), in the base frame."""


class View(_Section):
    """Where the camera's pixels lie in the cell's plane, the camera being square to it."""

    metres_per_pixel: Annotated[float, Field(gt=0.0, le=0.01)]
    origin_column_px: Finite
    """Column of the picture in which the plane's origin is seen."""
    origin_row_px: Finite


class Calibration(_Section):
    """Where `cell calibrate` leaves what it finds, and how good and how old it may be.

    With this section camera map, latency, lag and, for a UR arm, plane and tool come from there,
    and nothing moves unless they are there, fit the devices, and are good and new enough.
    """

    folder: Path = Path("calibration")
    max_age_days: Positive = 90.0
    """Of camera and cell."""
    time_max_age_h: Positive = 24.0
    """Of latency and lag: a camera's stamps change with every start."""
    max_error_m: Positive = 1.5e-4
    """Of the map, 95 % bound anywhere in the field."""
    max_time_error_s: Positive = 1e-3
    """Of latency and lag, 95 % bound."""
    square_m: Positive = 0.02
    """Side of a square of the board, as measured on the printout."""
    columns: Annotated[int, Field(ge=3, le=40)] = 12
    rows: Annotated[int, Field(ge=3, le=40)] = 9
    dictionary: str = "4X4_100"
    legacy: bool = False
    """Pattern of the board as before OpenCV 4.6."""


class _Camera(_Section):
    width_px: Annotated[int, Field(ge=64, le=10_000)] = 1280
    height_px: Annotated[int, Field(ge=64, le=10_000)] = 1024
    frame_rate_hz: Annotated[float, Field(ge=10.0, le=2000.0)] = 200.0
    view: View | None = None
    """Typed by hand, for a cell that is not calibrated; null = from the section `calibration`."""


def _told_apart(discs_m: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    from cell.vision.marks import JawMarks  # takes its time, and hardly anybody has other discs

    JawMarks(discs_m)
    return discs_m


Discs = Annotated[
    tuple[tuple[Place, Place], ...], Field(min_length=3, max_length=12), AfterValidator(_told_apart)
]


class JawPlate(_Section):
    """Light discs on the dark plate of the jaw, by which the camera finds the hand."""

    discs_m: Discs = ((0.006, 0.009), (0.006, -0.009), (0.032, 0.009), (0.025, -0.003))
    """Centres, m, as the camera sees them with the clamp level: origin at the gripping point, the
    cable leaves towards -x, y up.  All distances between them differ by 1 mm or more."""
    radius_m: Annotated[float, Field(ge=0.0005, le=0.05)] = 0.0025
    """Radius of every disc, m."""


class Vision(_Section):
    """What the cable and the jaw look like in the camera's pictures."""

    cable_is: Literal["dark", "light"] = "dark"
    """Darker than what is behind it, as before a lit screen; or lighter, as lit before black."""
    min_contrast: Annotated[float, Field(ge=1.0, le=200.0)] = 5.0
    """Least contrast of the cable over three pixels, grey levels; less counts as no cable."""
    line_width_px: Annotated[float, Field(ge=0.3, le=20.0)] = 1.0
    """Standard deviation of the cable's profile across it, blur included, pixels."""
    nodes: Annotated[int, Field(ge=3, le=101)] = 11
    """Points at which the cable's place is measured, at equal distances along it."""
    length_tolerance_m: Annotated[float, Field(gt=0.0, le=0.1)] = 0.003
    """A line that is longer or shorter than the cable by more than this, m, is not the cable."""
    jaw: JawPlate = JawPlate()


class SimulatedCamera(_Camera):
    """Twin of a camera: renders the simulated world."""

    kind: Literal["sim"]
    exposure_s: NotNegative = 0.0005
    lens_blur_px: NotNegative = 0.6
    read_noise: NotNegative = 1.0
    """Standard deviation, grey levels."""


class _RealCamera(_Camera):
    latency_s: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    """From the middle of an exposure to the arrival of its picture, at best; measured."""
    lost_after_s: Annotated[float, Field(ge=0.01, le=5.0)] = 0.055
    """Silence that counts as a lost camera, and stops the arm."""


class OpenCvCamera(_RealCamera):
    """Camera of the operating system (UVC), through OpenCV."""

    kind: Literal["opencv"]
    device: Annotated[int, Field(ge=0)] | str = 0
    """Number or path of the device, or the URL of a stream."""
    exposure_s: Positive | None = 0.0005
    """Set and read back; null = as it is, as with a stream."""
    fourcc: Annotated[str, Field(min_length=4, max_length=4)] | None = None
    """Pixel format, e.g. GREY or YUYV; null = as it is."""
    stamps: Literal["device", "arrival"] = "device"
    """Whose time stamps are believed: the device's, or the moment at which a picture arrives."""


class GenicamCamera(_RealCamera):
    """Industrial camera through its GenTL producer."""

    kind: Literal["genicam"]
    producer: Path
    """The vendor's .cti file."""
    serial_number: str | None = None
    """Null = the only camera there is."""
    exposure_s: Positive | None = 0.0005


class FilesCamera(_Camera):
    """Replays pictures from a folder."""

    kind: Literal["files"]
    folder: Path


class _Gripper(_Section):
    force_n: Annotated[float, Field(gt=0.0, le=235.0)]
    """Closing force."""
    force_limits_n: Range = (1.0, 40.0)
    """Least that holds the cable and most that does not crush it."""


class SimulatedGripper(_Gripper):
    """Twin of a gripper in the simulated world."""

    kind: Literal["sim"]


class SerialGripper(_Gripper):
    """Robotiq-type gripper (2F-85), Modbus RTU on a serial line."""

    kind: Literal["serial"]
    force_n: Annotated[float, Field(ge=20.0, le=235.0)]
    """Closing force: it can do no less and no more."""
    port: Annotated[str, Field(min_length=1)]
    address: Annotated[int, Field(ge=1, le=247)] = 9
    baud: Annotated[int, Field(ge=1200)] = 115_200
    reply_s: Annotated[float, Field(ge=0.005, le=1.0)] = 0.035
    """Time that an answer may take; two missing in a row are a lost gripper, and stop the arm."""


class HiddenCamera(_Section):
    """Where the camera of a simulated or emulated cell really stands, and what its lens is."""

    metres_per_pixel: Annotated[float, Field(gt=0.0, le=0.01)]
    """Across the line of sight, in the middle of the picture."""
    origin_column_px: Finite
    """Where a camera square to the plane would see its origin."""
    origin_row_px: Finite
    focal_px: Annotated[float, Field(ge=100.0, le=100_000.0)] = 2600.0
    tilt_rad: Annotated[float, Field(ge=-0.7, le=0.7)] = 0.0
    """Turn about the plane's x axis: positive = it looks down."""
    pan_rad: Annotated[float, Field(ge=-0.7, le=0.7)] = 0.0
    roll_rad: Annotated[float, Field(ge=-0.7, le=0.7)] = 0.0
    k1: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    """Distortion, with k2, p1 and p2 as in OpenCV."""
    k2: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    p1: Annotated[float, Field(ge=-0.01, le=0.01)] = 0.0
    p2: Annotated[float, Field(ge=-0.01, le=0.01)] = 0.0
    stamps_late_s: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    """Of a simulated camera: its frames say that they were exposed that much later."""


class World(_Section):
    """The simulated cables: what the cell must find out and never reads."""

    camera: HiddenCamera | None = None
    """null = it stands as `camera.view` says."""
    arm_lag_s: Annotated[float, Field(ge=0.0, le=0.3)] | None = None
    """How late a simulated arm really follows; null = as `arm.lag_s` says."""

    rigidity_n_m2: PositiveRange = (1.5e-5, 5e-5)
    """Flexural rigidity of an individual is drawn from this range, evenly in its logarithm."""
    rigidity_variation: Annotated[float, Field(ge=0.0, le=0.5)] = 0.15
    """Relative amplitude of its variation along the cable."""
    exponent: PositiveRange = (0.95, 1.05)
    """Bending exponent N."""
    damping_ratio: PositiveRange = (0.02, 0.06)
    """Of the first swing mode, from which the viscosity follows."""
    effects: dict[str, dict[str, Finite]] = {}
    """Physics that the model lacks: names of effects with their parameters, e.g.
    `air_drag: {drag_coefficient: 2.0}`."""
    segments: Annotated[int, Field(ge=60, le=400)] = 80
    """Of the simulated cable; more than the model has."""
    real_time_factor: Annotated[float, Field(ge=0.1, le=10.0)] | None = None
    """null = as fast as the computer can; 1 = at the speed of reality, in which the reported wait
    for the computer is that of a real cell."""


class Emulated(_Section):
    """Emulators of all three devices, at the addresses that the devices' own sections name.

    They speak the devices' protocols, so that the cell's real drivers work with them; `cell run`
    starts them unless `cell emulate` did.  The cables are those of `world`.
    """

    exposure_s: NotNegative = 0.0005
    """Of the emulated camera."""
    readout_s: Annotated[float, Field(ge=0.008, le=0.1)] = 0.012
    """From the middle of an exposure until the picture leaves the emulated camera."""
    lens_blur_px: NotNegative = 0.6
    read_noise: NotNegative = 1.0
    """Standard deviation, grey levels."""


class Settings(_Section):
    """Settings of a cell.  Numbers carry their unit in the key; SI throughout."""

    cable: Cable
    destination: Destination
    motion: Motion = Motion()
    limits: Limits
    arm: Annotated[SimulatedArm | UrArm, Field(discriminator="kind")]
    camera: Annotated[
        SimulatedCamera | OpenCvCamera | GenicamCamera | FilesCamera, Field(discriminator="kind")
    ]
    gripper: Annotated[SimulatedGripper | SerialGripper, Field(discriminator="kind")]
    vision: Vision = Vision()
    calibration: Calibration | None = None
    """Null = uncalibrated: `camera.view`, `camera.latency_s` and `arm.lag_s` are typed by hand."""
    identification: Identification = Identification()
    model: Model = Model()
    choice: Choice = Choice()
    world: World = World()
    emulated: Emulated | None = None
    """Null = the devices are real."""
