"""Twin of a camera: looks at the simulated world from the side, frame by frame, on demand."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from drivers.interfaces import (
    CameraError,
    ConnectError,
    DeviceLostError,
    FloatArray,
    Frame,
    Image,
)
from drivers.sim.pinhole import Sight
from drivers.sim.render import LightArray, Patches, Rates, RenderOptions, backdrop, render
from drivers.sim.world import SimView, SimWorld

_LOST_REMEDY = "check the camera's cable and power, then reset"


@dataclass(frozen=True)
class CameraFaults:
    """Faults of the simulated camera, active until `faults` is set again.

    Frames are identified by their index in a recording; times are on the cell's clock.
    """

    refuses_to_connect: bool = False
    lost_at_s: float | None = None  # no frame exposed after this arrives
    missing_frames: frozenset[int] = frozenset()
    frozen_from: int | None = None  # from this frame on the picture is that of the one before
    late_from: int | None = None  # from this frame on, frames are handed over late by late_s …
    late_s: float = 0.0
    black_frames: frozenset[int] = frozenset()
    saturated_frames: frozenset[int] = frozenset()
    noise_level: float = 0.0  # standard deviation of further noise, grey levels
    stamp_error_s: float = 0.0  # stamp minus true time, s


@dataclass(frozen=True)
class CameraTwinOptions:
    """Place and properties of the simulated camera.

    sight          where it really stands, and its lens: (3, 3) pixel → plane, m; or a `Pinhole`
    picture        appearance of the picture, exposure time included
    frame_rate_hz  frames per second
    readout_s      time from the end of the exposure until a frame can be had
    stamps_late_s  stamp of a frame minus its true time of exposure
    """

    sight: Sight
    picture: RenderOptions = field(default_factory=RenderOptions)
    frame_rate_hz: float = 200.0
    readout_s: float = 0.004
    stamps_late_s: float = 0.0


@dataclass(frozen=True, eq=False)
class Staging:
    """Objects in front of the simulated camera, and whether the jaw is in view."""

    patches: tuple[Patches, ...] = ()
    jaw: bool = True

    def light(self, options: CameraTwinOptions) -> LightArray | None:
        """(H, W) light of the scene with the objects, to be drawn once; None = there are none."""
        return backdrop(self.patches, options.sight, options.picture) if self.patches else None


class SimCamera:
    """A camera in a simulated world; frames are rendered only when read."""

    def __init__(
        self, world: SimWorld, options: CameraTwinOptions, seed: int = 0, name: str = "camera"
    ) -> None:
        self.name = name
        self.faults = CameraFaults()
        self._staging = Staging()
        self._behind: LightArray | None = None
        self._world = world
        self._clock = world.clock
        self._options = options
        self._seed = seed
        self._connected = False
        self._recordings = 0
        self._wanted = 0
        self._next = 0
        self._start_s = 0.0
        self._frozen: Image | None = None

    @property
    def frame_rate_hz(self) -> float:
        """Frames per second."""
        return self._options.frame_rate_hz

    def stage(self, staging: Staging) -> None:
        """Show these objects from now on."""
        self._staging, self._behind = staging, staging.light(self._options)

    def redraw(self, picture: RenderOptions) -> None:
        """Show the world so from now on."""
        self._options = replace(self._options, picture=picture)
        self._behind = self._staging.light(self._options)

    def connect(self) -> None:
        """Raises ConnectError."""
        if self.faults.refuses_to_connect or self._came(self.faults.lost_at_s):
            raise ConnectError(self.name, "no camera answers", _LOST_REMEDY)
        self._connected = True

    def close(self) -> None:
        """Release the camera."""
        self.stop()
        self._connected = False

    def check(self) -> None:
        """Raises DeviceLostError."""
        self._check_alive(self._clock.now_s())

    def start(self, frame_count: int) -> None:
        """Raises CameraError: fewer than one frame; DeviceLostError."""
        self._check_alive(self._clock.now_s())
        if frame_count < 1:
            raise CameraError(self.name, f"{frame_count} frames asked for, at least 1 is needed")
        self._recordings += 1
        self._wanted, self._next = frame_count, 0
        self._start_s = self._clock.now_s()
        self._frozen = None

    def read(self) -> Frame | None:
        """Next frame, forwarding the clock until it can be had.  Raises DeviceLostError."""
        while self._next in self.faults.missing_frames and self._next < self._wanted:
            self._next += 1
        if self._next >= self._wanted:
            return None
        index, exposure_s = self._next, self._options.picture.exposure_s
        exposed_s = self._start_s + index / self.frame_rate_hz + 0.5 * exposure_s
        late = self.faults.late_from is not None and index >= self.faults.late_from
        ready_s = exposed_s + 0.5 * exposure_s + self._options.readout_s
        self._clock.forward_to_s(ready_s + (self.faults.late_s if late else 0.0))
        self._check_alive(exposed_s)
        self._next += 1
        stamp_s = exposed_s + self._options.stamps_late_s + self.faults.stamp_error_s
        return Frame(index, stamp_s, self._picture(index, exposed_s))

    def stop(self) -> None:
        """Drop the frames not read yet."""
        self._wanted = self._next = 0

    def _check_alive(self, exposed_s: float) -> None:
        if not self._connected:
            raise DeviceLostError(self.name, "not connected", "connect first")
        lost_s = self.faults.lost_at_s
        if lost_s is not None and exposed_s >= lost_s:
            self.close()
            raise DeviceLostError(self.name, "frames no longer arrive", _LOST_REMEDY)

    def _came(self, t_s: float | None) -> bool:
        return t_s is not None and t_s <= self._clock.now_s()

    def _picture(self, index: int, exposed_s: float) -> Image:
        frozen_from = self.faults.frozen_from
        if frozen_from is not None and index >= frozen_from:
            if self._frozen is None:
                before = max(0, frozen_from - 1)
                at_s = exposed_s - (index - before) / self.frame_rate_hz
                self._frozen = self._render(before, at_s)
            return self._frozen
        return self._render(index, exposed_s)

    def _render(self, index: int, exposed_s: float) -> Image:
        picture = self._options.picture
        if index in self.faults.black_frames:
            picture = replace(picture, exposure=0.0)
        if index in self.faults.saturated_frames:
            picture = replace(picture, exposure=20.0)
        if self.faults.noise_level > 0.0:
            noise = float(np.hypot(picture.read_noise, self.faults.noise_level))
            picture = replace(picture, read_noise=noise)
        span_s = max(picture.exposure_s, 1e-4)
        view = self._world.cable_shapes(exposed_s + span_s * np.array([-0.5, 0.0, 0.5]))
        rng = np.random.default_rng([self._seed, self._recordings, index])
        options = replace(self._options, picture=picture)
        return photograph(view, options, rng, jaw=self._staging.jaw, behind=self._behind)


def photograph(
    view: SimView,
    options: CameraTwinOptions,
    rng: np.random.Generator,
    *,
    jaw: bool = True,
    behind: LightArray | None = None,
) -> Image:
    """Picture of a view at three moments: the exposure's beginning, middle and end.

    jaw, behind  as of a `Staging`
    """
    span_s = float(view.t_s[2] - view.t_s[0])
    cables = view.cables
    return render(
        None if cables is None else cables[1],
        _triple(view.grip[1]) if jaw else None,
        options.sight,
        options.picture,
        rng,
        rates=Rates(
            None if cables is None else (cables[2] - cables[0]) / span_s,
            _triple((view.grip[2] - view.grip[0]) / span_s),
        ),
        behind=behind,
    )


def _triple(values: FloatArray) -> tuple[float, float, float]:
    x, y, angle = values
    return float(x), float(y), float(angle)
