"""Cameras that OpenCV reads: UVC through Video4Linux, or a stream through FFmpeg.

Video4Linux stamps a picture when its transfer begins or ends (the driver's choice), FFmpeg
forwards the stamps of the stream.  Their origin is estimated at every `connect`; the remaining
offset, the latency, is an option of the capture, measured by calibration.

source  OpenCV, videoio flags; Linux, V4L2_CID_EXPOSURE_AUTO (1 = manual) and
        V4L2_CID_EXPOSURE_ABSOLUTE (units of 100 µs)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np

from drivers.capture import StreamingCamera
from drivers.interfaces import CameraError, Clock, ConnectError, DeviceLostError, Image
from drivers.recording import CaptureOptions, Shot, check_settings

_MANUAL = 1.0
_EXPOSURE_UNIT_S = 100e-6
_STREAM_SILENCE_MS = 500
_SETTINGS_REMEDY = "ask for what the camera can do: `v4l2-ctl --list-formats-ext --list-ctrls`"


@dataclass(frozen=True)
class OpenCvOptions:
    """Choice and settings of a camera.

    device         number or path of a Video4Linux device, or the URL of a stream
    frame_rate_hz  requested and read back; likewise width_px and height_px
    exposure_s     manual exposure, set and read back; None = unchanged (a stream has none)
    fourcc         pixel format, e.g. GREY, YUYV, MJPG; None = unchanged.  GREY and YUYV are exact
    stamps         source of timestamps: the `device`, or the `arrival` of the pictures,
                   which carries the jitter of this computer and hides a missing picture
    """

    device: int | str = 0
    width_px: int = 1280
    height_px: int = 1024
    frame_rate_hz: float = 200.0
    exposure_s: float | None = 0.0005
    fourcc: str | None = None
    stamps: Literal["device", "arrival"] = "device"
    setting_tolerance: float = 0.05
    capture: CaptureOptions = field(default_factory=CaptureOptions)

    def __post_init__(self) -> None:
        check_settings(self.width_px, self.height_px, self.frame_rate_hz, self.exposure_s)
        if self.fourcc is not None and len(self.fourcc) != 4:
            raise ValueError(f"camera.fourcc = {self.fourcc!r}: must be four characters")

    @property
    def is_stream(self) -> bool:
        """Whether the device is a URL."""
        return isinstance(self.device, str) and "://" in self.device


class OpenCvCamera(StreamingCamera):
    """A camera through OpenCV's VideoCapture."""

    def __init__(self, options: OpenCvOptions, clock: Clock, name: str = "camera") -> None:
        super().__init__(lambda: _OpenCvSource(options, name), options.capture, clock, name)


class _OpenCvSource:
    """An open VideoCapture with the requested settings."""

    def __init__(self, options: OpenCvOptions, device: str) -> None:
        self._options = options
        self._device = device
        self._capture = _open(options, device)
        self._last_stamp_s = -np.inf
        try:
            self.rate_hz = self._set_up()
        except BaseException:
            self.close()
            raise

    def grab(self, wanted: Callable[[], bool]) -> Shot:
        """Raises DeviceLostError: the stream ended; CameraError: a picture of another kind."""
        # one call is faster while other threads compute: each call waits for the interpreter
        came, picture = self._capture.read() if wanted() else (self._capture.grab(), None)
        if not came:
            raise DeviceLostError(
                self._device,
                "the stream of pictures ended",
                "check the camera's cable and power, then reset",
            )
        stamp_s = self._stamp_s()
        if picture is None and wanted():
            came, picture = self._capture.retrieve()
            if not came:
                raise CameraError(self._device, "a picture cannot be decoded", "check the cable")
        return Shot(None if picture is None else self._grey(picture), stamp_s)

    def close(self) -> None:
        """Release the camera."""
        self._capture.release()

    # --- setting up ---------------------------------------------------------------------------

    def _set_up(self) -> float:
        """Set all properties, read them back; the frame rate, Hz.  Raises ConnectError."""
        options, capture = self._options, self._capture
        if options.fourcc is not None:
            code = cv2.VideoWriter.fourcc(*options.fourcc)
            capture.set(cv2.CAP_PROP_FOURCC, code)
            actual = int(capture.get(cv2.CAP_PROP_FOURCC))
            if actual != code:
                text = actual.to_bytes(4, "little", signed=False).decode("latin-1")
                raise self._refused("fourcc", options.fourcc, repr(text))
        for name, key, value in (
            ("width_px", cv2.CAP_PROP_FRAME_WIDTH, float(options.width_px)),
            ("height_px", cv2.CAP_PROP_FRAME_HEIGHT, float(options.height_px)),
        ):
            self._set(name, key, value, value, 0.0)
        if options.exposure_s is not None:
            self._set("auto_exposure (1 = manual)", cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL, _MANUAL)
            units = options.exposure_s / _EXPOSURE_UNIT_S
            self._set("exposure_s", cv2.CAP_PROP_EXPOSURE, units, options.exposure_s)
        # the rate last: it may depend on all the others
        rate_hz = options.frame_rate_hz
        rate_hz = self._set("frame_rate_hz", cv2.CAP_PROP_FPS, rate_hz, rate_hz)
        self._skip_colour_conversion()
        return rate_hz

    def _set(
        self, name: str, key: int, value: float, requested: float, tolerance: float | None = None
    ) -> float:
        """Set a property; the actual value, in units of `requested`.  Raises ConnectError."""
        tolerance = self._options.setting_tolerance if tolerance is None else tolerance
        if self._capture.get(key) != value:
            self._capture.set(key, value)
        actual = float(self._capture.get(key)) * requested / value
        if not abs(actual - requested) <= tolerance * requested:
            raise self._refused(name, f"{requested:g}", f"{actual:g}")
        return actual

    def _refused(self, name: str, requested: str, actual: str) -> ConnectError:
        return ConnectError(
            self._device, f"{name} = {requested} refused, the camera has {actual}", _SETTINGS_REMEDY
        )

    def _skip_colour_conversion(self) -> None:
        """Request pictures without colour conversion, if the camera's own contain the grey."""
        self._capture.set(cv2.CAP_PROP_CONVERT_RGB, 0.0)
        self.grab(lambda: False)
        came, picture = self._capture.retrieve()
        if not came or _luminance(picture, self._shape) is None:
            self._capture.set(cv2.CAP_PROP_CONVERT_RGB, 1.0)

    @property
    def _shape(self) -> tuple[int, int]:
        return self._options.height_px, self._options.width_px

    # --- pictures -----------------------------------------------------------------------------

    def _stamp_s(self) -> float | None:
        if self._options.stamps == "arrival":
            return None
        stamp_s = 1e-3 * float(self._capture.get(cv2.CAP_PROP_POS_MSEC))
        if not stamp_s > self._last_stamp_s:
            raise CameraError(
                self._device,
                f"time stamps do not advance: {stamp_s:.6f} s after {self._last_stamp_s:.6f} s",
                "for a camera without them set `stamps: arrival`",
            )
        self._last_stamp_s = stamp_s
        return stamp_s

    def _grey(self, picture: np.ndarray) -> Image:
        image = _luminance(picture, self._shape)
        if image is None and picture.ndim == 3 and picture.shape[:2] == self._shape:
            image = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        if image is None:
            raise CameraError(
                self._device,
                f"a picture of shape {picture.shape} came, {self._shape} expected",
                "check the camera's resolution, then reset",
            )
        return image


def _open(options: OpenCvOptions, device: str) -> cv2.VideoCapture:
    if options.is_stream:
        # the first bytes must identify the stream's format; one thread adds no delay
        settings = {
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC: int(options.capture.connect_s * 1e3),
            cv2.CAP_PROP_READ_TIMEOUT_MSEC: _STREAM_SILENCE_MS,
            cv2.CAP_PROP_N_THREADS: 1,
        }
        flat = [number for pair in settings.items() for number in pair]
        capture = cv2.VideoCapture(options.device, cv2.CAP_FFMPEG, flat)
    else:
        capture = cv2.VideoCapture(options.device, cv2.CAP_V4L2)
    if not capture.isOpened():
        capture.release()
        raise ConnectError(
            device, f"{options.device} does not open", "check address, cable, power and permissions"
        )
    return capture


def _luminance(picture: np.ndarray, shape: tuple[int, int]) -> Image | None:
    """(H, W) grey of a picture that came unconverted: grey, or YUYV; None = something else."""
    if picture.dtype != np.uint8 or picture.shape[:2] != shape:
        return None
    if picture.ndim == 2:
        return np.asarray(picture, dtype=np.uint8)
    if picture.shape[2] in (1, 2):
        return np.ascontiguousarray(picture[:, :, 0])
    return None
