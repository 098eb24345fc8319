"""Industrial cameras (GigE Vision, USB3 Vision) through GenICam: the extra `genicam`.

The camera's maker supplies a GenTL producer, a file `*.cti`; harvesters loads it.  The camera's
count of pictures (block or frame id) reveals gaps; its clock, if any, provides the timestamps.

source  EMVA, GenICam Standard Features Naming Convention (SFNC) 2.7; GenTL 1.6
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from drivers.capture import StreamingCamera
from drivers.installing import install_extra
from drivers.interfaces import CameraError, Clock, ConnectError, DeviceLostError, Image
from drivers.recording import CaptureOptions, Shot, check_settings

_FETCH_S = 0.2
_BUFFERS = 32
_PIXELS = "Mono8"
_LARGEST_ID = 65_535


@dataclass(frozen=True)
class GenicamOptions:
    """Choice and settings of a camera; every value is read back.

    producer       the maker's GenTL producer, *.cti
    serial_number  None = the only camera
    exposure_s     None = unchanged
    """

    producer: FilePath
    serial_number: str | None = None
    width_px: int = 1280
    height_px: int = 1024
    frame_rate_hz: float = 200.0
    exposure_s: float | None = 0.0005
    setting_tolerance: float = 0.05
    capture: CaptureOptions = field(default_factory=CaptureOptions)

    def __post_init__(self) -> None:
        check_settings(self.width_px, self.height_px, self.frame_rate_hz, self.exposure_s)


class GenicamCamera(StreamingCamera):
    """An industrial camera through its maker's GenTL producer."""

    def __init__(self, options: GenicamOptions, clock: Clock, name: str = "camera") -> None:
        super().__init__(lambda: _GenicamSource(options, name), options.capture, clock, name)


class _GenicamSource:
    """An acquiring camera with the requested settings."""

    def __init__(self, options: GenicamOptions, device: str) -> None:
        self._options = options
        self._device = device
        self._closers: list[Callable[[], None]] = []
        self._number = 0  # of pictures, counted on beyond the camera's 16 bits
        self._last_id: int | None = None
        try:
            self._acquirer = self._open()
            self.rate_hz = self._set_up(self._acquirer.remote_device.node_map)
            self._acquirer.num_buffers = max(_BUFFERS, self._acquirer.min_num_buffers)
            self._acquirer.start()
            self._closers.append(self._acquirer.stop)
        except BaseException:
            self.close()
            raise

    def grab(self, wanted: Callable[[], bool]) -> Shot | None:
        """Raises DeviceLostError, CameraError.  An incomplete picture is skipped: the next
        number then shows the gap.
        """
        try:
            buffer = self._acquirer.try_fetch(timeout=_FETCH_S)
            if buffer is None:
                return None
            with buffer:
                image = self._image(buffer.payload.components[0]) if wanted() else None
                return Shot(image, _stamp_s(buffer), self._count(int(buffer.module.frame_id)))
        except CameraError:
            raise
        except Exception as error:  # the library's own exceptions have no common base
            raise DeviceLostError(
                self._device,
                f"{type(error).__name__}: {error}",
                "check the camera's cable and power, then reset",
            ) from error

    def close(self) -> None:
        """Stop and release, in the reverse order of opening, ignoring errors of a lost camera."""
        while self._closers:
            closer = self._closers.pop()
            with contextlib.suppress(Exception):
                closer()

    # --- opening ------------------------------------------------------------------------------

    def _open(self) -> Any:
        """The harvesters acquirer of the camera.  Raises ConnectError."""
        options = self._options
        try:
            from harvesters.core import Harvester
        except ImportError as error:
            raise ConnectError(
                self._device,
                f"GenICam is not installed ({error})",
                install_extra("genicam"),
            ) from error
        harvester = Harvester()
        self._closers.append(harvester.reset)
        if not options.producer.is_file():
            raise ConnectError(
                self._device,
                f"{options.producer} does not exist",
                "install the maker's GenTL producer and give its .cti file",
            )
        try:
            harvester.add_file(str(options.producer), check_validity=True)
            harvester.update()
            serials = [str(info.serial_number) for info in harvester.device_info_list]
            wanted = options.serial_number
            if len(serials) != 1 if wanted is None else serials.count(wanted) != 1:
                raise ConnectError(
                    self._device,
                    f"{options.producer.name} finds the cameras {', '.join(serials) or 'none'}, "
                    f"wanted is {wanted or 'the only one'}",
                    "check cable, power and network address, and give its serial number",
                )
            acquirer = harvester.create(0 if wanted is None else serials.index(wanted))
        except ConnectError:
            raise
        except Exception as error:
            raise ConnectError(
                self._device,
                f"it does not open: {type(error).__name__}: {error}",
                "check whether another program has it, and the producer",
            ) from error
        self._closers.append(acquirer.destroy)
        return acquirer

    def _set_up(self, nodes: Any) -> float:
        """Set all features, read them back; the frame rate, Hz.  Raises ConnectError."""
        options = self._options
        self._set(nodes, "PixelFormat", _PIXELS)
        self._set(nodes, "Width", options.width_px)
        self._set(nodes, "Height", options.height_px)
        if hasattr(nodes, "TriggerMode"):
            self._set(nodes, "TriggerMode", "Off")
        if options.exposure_s is not None:
            if hasattr(nodes, "ExposureAuto"):
                self._set(nodes, "ExposureAuto", "Off")
            self._set(nodes, "ExposureTime", options.exposure_s * 1e6)
        if hasattr(nodes, "AcquisitionFrameRateEnable"):
            self._set(nodes, "AcquisitionFrameRateEnable", True)
        # the rate last: it may depend on all the others
        return float(self._set(nodes, "AcquisitionFrameRate", options.frame_rate_hz))

    def _set(self, nodes: Any, name: str, value: Any) -> Any:
        """Set a feature; returns the actual value.  Raises ConnectError."""
        why = ""
        try:
            getattr(nodes, name).value = value
        except Exception as error:
            why = f": {type(error).__name__}: {error}".rstrip(": ")
        try:
            actual = getattr(nodes, name).value
        except Exception:
            actual = None
        if isinstance(value, float) and isinstance(actual, int | float):
            accepted = abs(actual - value) <= self._options.setting_tolerance * value
        else:
            accepted = actual == value
        if not accepted:
            has = "has no such feature" if actual is None else f"has {actual}"
            raise ConnectError(
                self._device,
                f"{name} = {value} refused, the camera {has}{why}",
                "ask for what the camera can do",
            )
        return actual

    # --- pictures -----------------------------------------------------------------------------

    def _count(self, frame_id: int) -> int:
        """Running number of a picture.  GigE Vision 1 counts 1 … 65535, then 1 again."""
        step = 0 if self._last_id is None else frame_id - self._last_id
        self._number += step if step >= 0 else step + _LARGEST_ID
        self._last_id = frame_id
        return self._number

    def _image(self, component: Any) -> Image:
        shape = (self._options.height_px, self._options.width_px)
        actual = (int(component.height), int(component.width))
        if actual != shape or component.data_format != _PIXELS:
            raise CameraError(
                self._device,
                f"a {component.data_format} picture of shape {actual} came, {_PIXELS} of {shape} "
                "expected",
                "check the camera's resolution, then reset",
            )
        # a copy, as the buffer goes back to the camera
        image: Image = np.array(component.data, dtype=np.uint8).reshape(shape)
        return image


def _stamp_s(buffer: Any) -> float | None:
    """The camera's own time of a picture, or None if it has none."""
    with contextlib.suppress(Exception):  # a missing stamp shows in three ways
        ticks, per_second = buffer.timestamp, buffer.timestamp_frequency
        if ticks > 0:
            return float(ticks) / float(per_second)
    return None
