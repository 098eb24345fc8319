"""What a cell's settings may say: sections, units, ranges and defaults."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Discriminator, Field, Tag, model_validator

from cell.settings.devices import (
    Emulated,
    FilesCameraSettings,
    GenicamCameraSettings,
    OpenCvCameraSettings,
    SerialGripperSettings,
    SimulatedArm,
    SimulatedCamera,
    SimulatedGripper,
    UrArmSettings,
    UrcapGripperSettings,
    WorldSettings,
)
from cell.settings.plant import Plant
from cell.settings.product import Products
from cell.settings.records import LedgerSettings, RecordingSettings
from cell.settings.section import (
    Angle,
    Distance,
    Duration,
    Finite,
    Fraction,
    Length,
    NotNegative,
    Place,
    PlaceRange,
    Positive,
    Section,
    Wait,
    increasing,
)
from cell.workers.executor import place


def scheduler(address: str) -> str:
    """Validate the address of a scheduler, and return it.  Raises ValueError."""
    if not isinstance(place(address), str):
        raise ValueError(f"{address!r} is no address of a scheduler; give tcp://host:8786")
    return address


class Workers(Section):
    """Where independent fits run: on a cluster, or on cores of this computer."""

    cluster: Annotated[str, AfterValidator(scheduler)] | None = None
    """Address of a Dask scheduler, tcp://host:8786; null = this computer."""
    cores: Annotated[int, Field(ge=1, le=1024)] | None = None
    """Cores of this computer; null = all."""

    @model_validator(mode="after")
    def _one_place(self) -> Workers:
        if self.cluster is not None and self.cores is not None:
            raise ValueError("has both `cluster` and `cores`; leave one out")
        return self

    @property
    def place(self) -> str | int | None:
        """Address or number of cores; None = all cores."""
        return self.cluster if self.cluster is not None else self.cores


class CableSettings(Section):
    """Data sheet of the cable type: the properties that all cables share."""

    free_length_m: Annotated[float, Field(gt=0.0, le=2.0)]
    """Length from the gripping point, at the jaw's edge, to the end of the cable or to its
    connector."""
    line_density_kg_per_m: Annotated[float, Field(gt=0.0, le=10.0)]
    """Mass per metre."""
    width_m: Annotated[float, Field(gt=0.0, le=0.5)]
    """Width of the strip, along the camera's line of sight."""
    thickness_m: Annotated[float, Field(gt=0.0, le=0.5)]
    """Thickness, as the camera sees it edge-on."""


class DestinationSettings(Section):
    """The opening: rectangle that the tip must pass, moving left."""

    x_m: PlaceRange
    """Far edge and entry edge of the opening."""
    y_m: PlaceRange
    """Lower and upper edge of the opening."""


class HandPose(Section):
    """Pose of the gripping point in the cell's plane."""

    x_m: Place = 0.0
    """Position to the right of the plane's origin."""
    y_m: Place = 0.0
    """Position above the plane's origin."""
    angle_rad: Angle = 0.0
    """Clamp angle: 0 = level, positive = pointing down."""


class Offsets(Section):
    """Offsets, distances down, that are simulated; one of them is executed."""

    first_m: Length = 0.0
    """Smallest offset."""
    last_m: Length = 0.040
    """Largest offset."""
    step_m: Distance = 0.002
    """Distance between offsets."""

    @property
    def values_m(self) -> tuple[float, ...]:
        """All of them, ascending."""
        count = round((self.last_m - self.first_m) / self.step_m) + 1
        return tuple(round(self.first_m + self.step_m * i, 9) for i in range(count))


class KinematicLimits(Section):
    """Kinematic limits of a movement, along either axis."""

    velocity_m_per_s: Annotated[float, Field(gt=0.0, le=5.0)]
    """Largest speed of the gripping point."""
    acceleration_m_per_s2: Annotated[float, Field(gt=0.0, le=100.0)]
    """Largest acceleration of the gripping point."""
    jerk_m_per_s3: Annotated[float, Field(gt=0.0, le=50_000.0)]
    """Largest jerk of the gripping point."""


class StartSettings(Section):
    """What may be chosen for an insertion in addition to the offsets, at once and at the usual
    pace."""

    window_s: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    """Latest start of the insertion. If it is above 0, offsets between the listed ones are
    allowed, too; 0 = start at once, with a listed offset. A useful value is one period of the
    swing, 0.25. The arm then waits up to 0.3 s longer for the computer."""
    paces: tuple[Annotated[float, Field(gt=1.0, le=3.0)], ...] = (1.15, 1.3, 1.5, 1.8)
    """If `window_s` is above 0: factors by which the insertion may be slower."""
    further_m: Length = 0.0
    """If `window_s` is above 0: how much further left the gripper may go if no offset surely
    passes, for cables that hang too low."""


#: One period of a cable's swing, s: what `start: auto` allows.
AUTO_WINDOW_S = 0.25


class Hold(Section):
    """A hold as long as needed: it ends, at one of a few moments, if more frames would change the
    chosen offset's probability by less than 0.01. A cable that would be rejected is held for all of
    `most_s`.
    """

    least_s: Duration = 0.4
    """Shortest hold."""
    most_s: Duration = 1.0
    """Longest hold."""

    @model_validator(mode="after")
    def _in_order(self) -> Hold:
        if self.least_s > self.most_s:
            raise ValueError(
                f"least_s {self.least_s:g} is longer than most_s {self.most_s:g}; lower least_s"
            )
        return self


class MotionSettings(Section):
    """What the gripper does in a cycle."""

    home: HandPose = HandPose()
    """Where a cable is grasped."""
    aside: HandPose = HandPose(x_m=0.015, y_m=-0.05)
    """Where a rejected cable is let go."""
    calm_s: Wait = 0.5
    """Pause after grasping, until the cable is at rest."""
    still_s: Duration = 0.2
    """Duration of filming the cable at rest before the motion, for noise and rest shape."""
    lower_m: Distance = 0.050
    """Downward movement that makes the cable swing."""
    lower_s: Duration = 0.3
    """Duration of the downward movement; longer if the limits require it."""
    hold_s: Duration = 1.0
    """Duration of filming the swing, with the gripper held still."""
    hold: Hold | None = None
    """Null = always `hold_s`."""
    decide_s: Wait = 0.2
    """Time between the last frame of the swing and the insertion, for the computer."""
    offsets: Offsets = Offsets()
    start: StartSettings | Literal["auto"] = "auto"
    """When the insertion begins, and how fast it is. `{}` = at once, with one of the offsets.
    `auto` = the same if one of them surely passes, else up to 0.25 s later, with any offset, at any
    of the usual paces."""
    advance_m: Distance = 0.050
    """Movement to the left, into the opening."""
    settle_s: Wait = 0.2
    """Duration of filming after the insertion, with the gripper at rest."""
    lowering: KinematicLimits = KinematicLimits(
        velocity_m_per_s=0.5, acceleration_m_per_s2=5.0, jerk_m_per_s3=200.0
    )
    """Kinematic limits of the movement that makes the cable swing."""
    insertion: KinematicLimits = KinematicLimits(
        velocity_m_per_s=0.2, acceleration_m_per_s2=1.0, jerk_m_per_s3=10.0
    )
    """Kinematic limits of the insertion; slow, so that neighbouring offsets bring the tip to
    similar places."""

    @property
    def longest_hold_s(self) -> float:
        """For so long the swing is filmed at most."""
        return self.hold_s if self.hold is None else self.hold.most_s

    @model_validator(mode="after")
    def _held_once(self) -> MotionSettings:
        said = "hold_s" in self.model_fields_set
        if said and self.hold is not None and self.hold_s != self.hold.most_s:
            raise ValueError(
                f"hold_s {self.hold_s:g} contradicts hold.most_s {self.hold.most_s:g}; "
                "remove hold_s"
            )
        return self

    @property
    def freedom(self) -> StartSettings:
        """What `start` allows."""
        return StartSettings(window_s=AUTO_WINDOW_S) if isinstance(self.start, str) else self.start


class Limits(KinematicLimits):
    """Limits of every motion: a path beyond them is refused before it starts."""

    x_m: PlaceRange
    """Least and greatest x of the gripping point."""
    y_m: PlaceRange
    """Least and greatest y of the gripping point."""
    angle_rad: Annotated[tuple[Angle, Angle], AfterValidator(increasing)]
    """Least and greatest clamp angle."""


class Identification(Section):
    """How this cable's parameters are estimated."""

    method: Literal["map", "paper"] = "map"
    """`map`: one fit to all frames (maximum a posteriori), with covariance. `paper`: rest shape and
    swing are fitted in turn."""


#: Standard deviation of a tip's height for reasons that are not the cable's, m: arm, draught.
REPEATABILITY_M = 1e-4


class ChoiceSettings(Section):
    """Which offset may be executed."""

    min_probability: Fraction = 0.9
    """Smallest probability that the tip passes the opening; below it the cable is rejected."""


class KnownParameter(Section):
    """A parameter of an effect that is known."""

    fixed: Finite
    """Its value."""
    std: NotNegative = 0.0
    """Standard deviation of the value; 0 = exact. Otherwise a cable's frames may correct the value
    within this uncertainty."""


class ModelEffect(Section):
    """Effect that the cables have in addition to the baseline model."""

    effect: Annotated[str, Field(min_length=1)]
    """Name of an effect of the library, or a file.py with one of your own."""
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    """SHA-256 of the effect's file: a file that was changed is refused. Null = the file is not
    checked."""
    parameters: dict[
        str,
        Annotated[
            Annotated[KnownParameter, Tag("known")]
            | Annotated[Literal["prior", "fitted"], Tag("word")],
            Discriminator(lambda given: "word" if isinstance(given, str) else "known"),
        ],
    ] = Field(default={})
    """Each parameter of the effect: a known value, `prior` = from the batch's prior, `fitted` =
    fitted to every cable. Not named = fitted."""


class BatchPrior(Section):
    """Gaussian prior of a cable's parameters, learned from a batch of cables."""

    names: list[str]
    """`rigidity_0` … `rigidity_5` (EI from the jaw to the tip), `exponent`, `viscosity`, and
    `effect.parameter` for those of effects."""
    mean: list[Finite]
    """Mean of each parameter, in its natural unit."""
    covariance: list[list[Finite]]
    """Covariance of the parameters' logarithms; of the values themselves for the exponent and
    for parameters that may be 0."""


class ModelSettings(Section):
    """What all cables have in common besides the data sheet; empty = the baseline model.

    `cell learn` finds it out and `cell promote` writes it here."""

    effects: list[ModelEffect] = Field(default=[])
    """Effects in the model of all cables."""
    prior: BatchPrior | None = None
    """Null = a weak prior."""


class Promotion(Section):
    """What happens to a promoted model that predicts worse than the one before it."""

    withdraw: bool = False
    """Whether a promoted model that predicts worse is removed without asking, as by `cell promote
    --undo`. A worse model is reported in any case."""


def _distinguishable(discs_m: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    from cell.vision.marks import JawMarks  # takes its time, and hardly anybody has other discs

    JawMarks(discs_m)
    return discs_m


Discs = Annotated[
    tuple[tuple[Place, Place], ...],
    Field(min_length=3, max_length=12),
    AfterValidator(_distinguishable),
]


class JawPlate(Section):
    """Light discs on the dark plate of the jaw, by which the camera finds the gripper."""

    discs_m: Discs = ((0.006, 0.009), (0.006, -0.009), (0.032, 0.009), (0.025, -0.003))
    """Centres, m, as the camera sees them with the clamp level: origin at the gripping point, the
    cable leaves towards -x, y up.  All distances between them differ by 1 mm or more."""
    radius_m: Annotated[float, Field(ge=0.0005, le=0.05)] = 0.0025
    """Radius of every disc, m."""


class Vision(Section):
    """What the cable and the jaw look like in the camera's pictures."""

    cable_is: Literal["dark", "light"] = "dark"
    """Whether the cable is darker than the background (lit screen) or lighter (black
    background)."""
    min_contrast: Annotated[float, Field(ge=1.0, le=200.0)] = 5.0
    """Smallest contrast of the cable over three pixels, grey levels; less counts as no cable."""
    line_width_px: Annotated[float, Field(ge=0.3, le=20.0)] = 1.0
    """Standard deviation of the cable's profile across it, blur included, pixels."""
    nodes: Annotated[int, Field(ge=3, le=101)] = 11
    """Number of measured points, equally spaced along the cable."""
    length_tolerance_m: Annotated[float, Field(gt=0.0, le=0.1)] = 0.003
    """A detected line whose length differs from the cable's by more is not the cable."""
    jaw: JawPlate = JawPlate()


class Calibration(Section):
    """Results of `cell calibrate`: their folder, largest allowed errors and ages.

    With this section camera map, latency, lag and, for a UR arm, plane and tool come from there,
    and nothing moves unless they are there, fit the devices, and are good and new enough.  So do
    the free length and the discs' places about the gripping point, if they are there; each product
    has its own.
    """

    folder: Path = Path("calibration")
    """Folder that `cell calibrate` writes."""
    max_age_days: Positive = 90.0
    """Largest allowed age of the calibrations of camera, cell and grip."""
    time_max_age_h: Positive = 24.0
    """Largest allowed age of latency and lag; a camera's timestamps change with every start."""
    max_error_m: Annotated[float, Field(gt=0.0, le=0.01)] = 1.5e-4
    """Largest allowed error of the map from pixels to metres: 95 % bound anywhere in the field."""
    max_time_error_s: Annotated[float, Field(gt=0.0, le=0.1)] = 1e-3
    """Largest allowed error of latency and lag, 95 % bound."""
    max_grip_error_m: Annotated[float, Field(gt=0.0, le=0.01)] = 3e-4
    """Largest allowed error of gripping point and free length, 95 % bound."""
    max_clamp_error_rad: Annotated[float, Field(gt=0.0, le=0.5)] = 0.01
    """Largest allowed error of the clamp angle, 95 % bound."""
    square_m: Annotated[float, Field(ge=0.001, le=0.5)] = 0.02
    """Side of a square of the board, as measured on the printout."""
    columns: Annotated[int, Field(ge=3, le=40)] = 12
    """Squares of the board across."""
    rows: Annotated[int, Field(ge=3, le=40)] = 9
    """Squares of the board down."""
    dictionary: str = "4X4_100"
    """OpenCV's dictionary of the markers on the board."""
    legacy: bool = False
    """Whether the board has the pattern of OpenCV before 4.6."""


class Settings(Section):
    """Settings of a cell.  Numbers carry their unit in the key; SI throughout."""

    cable: CableSettings
    destination: DestinationSettings
    motion: MotionSettings = MotionSettings()
    limits: Limits
    arm: Annotated[SimulatedArm | UrArmSettings, Field(discriminator="kind")]
    """The arm, by its kind."""
    camera: Annotated[
        SimulatedCamera | OpenCvCameraSettings | GenicamCameraSettings | FilesCameraSettings,
        Field(discriminator="kind"),
    ]
    """The camera, by its kind."""
    gripper: Annotated[
        SimulatedGripper | SerialGripperSettings | UrcapGripperSettings, Field(discriminator="kind")
    ]
    """The gripper, by its kind."""
    vision: Vision = Vision()
    calibration: Calibration | None = None
    """Null = uncalibrated: `camera.view`, `camera.latency_s` and `arm.lag_s` are typed by hand."""
    identification: Identification = Identification()
    model: ModelSettings = ModelSettings()
    promotion: Promotion = Promotion()
    products: Products = Field(default={})
    """Products by name: the settings in which each differs from the rest of the file."""
    product: Annotated[str, Field(min_length=1)] | None = None
    """Default product; in the record of a cycle, the product of that cycle."""
    choice: ChoiceSettings = ChoiceSettings()
    feedback: Literal["auto", "off", "on"] = "auto"
    """Correction of insertions in flight: `on`, `off`; `auto` = on if latency and lag are
    known to 2 ms."""
    retry: Annotated[int, Field(ge=0, le=3)] = 0
    """Further attempts with a cable that the correction stopped in front of the opening."""
    recording: RecordingSettings | None = RecordingSettings()
    """Null = only tables, JSON and a few pictures are left of a cycle, no film."""
    ledger: LedgerSettings | None = LedgerSettings()
    """Null = cycles are not listed, and nothing is said of what has changed in them."""
    workers: Workers | None = None
    """Null = independent fits are done on all cores of this computer."""
    plant: Plant | None = None
    """Null = the cell talks to no other machine and to no plant's systems."""
    world: WorldSettings = WorldSettings()
    emulated: Emulated | None = None
    """Null = the devices are real."""
