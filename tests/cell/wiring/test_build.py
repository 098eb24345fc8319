"""Devices are built as the settings name them."""

from __future__ import annotations

from pathlib import Path

from cell.settings import load_settings
from cell.wiring.build import real_devices
from drivers.genicam_camera import GenicamCamera
from drivers.opencv_camera import OpenCvCamera
from drivers.serial_gripper import SerialGripper
from drivers.ur import UrArm

CONFIG = Path(__file__).parents[3] / "config"


def test_hardware_is_built_as_the_settings_say_and_not_touched(tmp_path: Path) -> None:
    text = (CONFIG / "line3.yaml").read_text(encoding="utf-8")
    uvc = tmp_path / "uvc.yaml"
    uvc.write_text(
        "\n".join(
            line
            for line in text.replace("kind: genicam", "kind: opencv").splitlines()
            if not line.strip().startswith(("producer:", "serial_number:"))
        ),
        encoding="utf-8",
    )
    for path, camera in ((CONFIG / "line3.yaml", GenicamCamera), (uvc, OpenCvCamera)):
        devices = real_devices(load_settings(path))
        assert isinstance(devices.arm, UrArm)
        assert isinstance(devices.camera, camera)
        assert isinstance(devices.gripper, SerialGripper)
        assert (devices.arm.lag_s, devices.arm.rate_hz) == (0.034, 500.0)
        assert devices.camera.latency_s == 0.012
