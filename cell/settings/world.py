"""What the settings may say of a cell that is not real: hidden cables and camera, emulators."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from cell.settings.section import Exposure, Finite, NotNegative, Pixels, PositiveRange, Section


class HiddenCamera(Section):
    """Where the camera of a simulated or emulated cell really stands, and what its lens is."""

    metres_per_pixel: Annotated[float, Field(gt=0.0, le=0.01)]
    """Across the line of sight, in the middle of the picture."""
    origin_column_px: Pixels
    """Where a camera square to the plane would see its origin."""
    origin_row_px: Pixels
    """Row in which such a camera would see the plane's origin."""
    focal_px: Annotated[float, Field(ge=100.0, le=100_000.0)] = 2600.0
    """Focal length."""
    tilt_rad: Annotated[float, Field(ge=-0.7, le=0.7)] = 0.0
    """Turn about the plane's x axis: positive = it looks down."""
    pan_rad: Annotated[float, Field(ge=-0.7, le=0.7)] = 0.0
    """Turn about the plane's y axis."""
    roll_rad: Annotated[float, Field(ge=-0.7, le=0.7)] = 0.0
    """Turn about the line of sight."""
    k1: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    """Distortion, with k2, p1 and p2 as in OpenCV."""
    k2: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    """Distortion by the fourth power of the distance from the middle."""
    p1: Annotated[float, Field(ge=-0.01, le=0.01)] = 0.0
    """Distortion by a lens that leans, first coefficient."""
    p2: Annotated[float, Field(ge=-0.01, le=0.01)] = 0.0
    """Distortion by a lens that leans, second coefficient."""
    stamps_late_s: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    """Simulated camera: error of its timestamps, positive = late."""


class WorldSettings(Section):
    """The simulated cables and devices: the truth, which the cell never reads."""

    camera: HiddenCamera | None = None
    """null = it stands as `camera.view` says."""
    arm_lag_s: Annotated[float, Field(ge=0.0, le=0.3)] | None = None
    """True lag of a simulated arm; null = `arm.lag_s`."""

    rigidity_n_m2: PositiveRange = (1.5e-5, 5e-5)
    """Flexural rigidity of an individual is drawn from this range, evenly in its logarithm."""
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
    """null = as fast as the computer can; 1 = in real time, where the reported wait for the
    computer is that of a real cell."""


class Emulated(Section):
    """Emulators of all three devices, at the addresses that the devices' own sections name.

    They speak the devices' protocols, so that the cell's real drivers work with them; `cell run`
    starts them unless `cell emulate` did.  The cables are those of `world`.
    """

    exposure_s: Exposure = 0.0005
    """Exposure time of the emulated camera."""
    readout_s: Annotated[float, Field(ge=0.008, le=0.1)] = 0.012
    """Time from the middle of an exposure until the picture leaves the emulated camera."""
    polyscope: Annotated[str, Field(pattern=r"^[1-9]\d?(\.\d{1,9}){1,3}$")] = "5.12.2.1101534"
    """Software version of the emulated controller: major, minor, bugfix, build.  From 10 on it is
    PolyScope X, which has no dashboard server."""
    lens_blur_px: Annotated[float, Field(ge=0.0, le=100.0)] = 0.6
    """Standard deviation of the blur by the lens."""
    read_noise: NotNegative = 1.0
    """Standard deviation, grey levels."""
