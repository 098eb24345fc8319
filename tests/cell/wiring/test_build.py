"""Devices are built as the settings name them."""

from __future__ import annotations

from pathlib import Path

from cell.settings import load_settings
from cell.wiring.build import real_devices
from cell.wiring.ownership import devices_of
from drivers.genicam_camera import GenicamCamera
from drivers.opencv_camera import OpenCvCamera
from drivers.serial_gripper import SerialGripper
from drivers.ur import UrArm
from drivers.urcap_gripper import UrcapGripper, UrcapGripperOptions

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


def test_a_gripper_behind_its_urcap_is_built_as_the_settings_say(tmp_path: Path) -> None:
    text = (CONFIG / "line3.yaml").read_text(encoding="utf-8")
    path = tmp_path / "urcap.yaml"
    flange = "kind: urcap\n  host: 10.0.0.3"
    path.write_text(text.replace("kind: serial\n  port: /dev/ttyUSB0", flange), encoding="utf-8")
    gripper = real_devices(load_settings(path)).gripper
    assert isinstance(gripper, UrcapGripper)
    assert gripper._options == UrcapGripperOptions("10.0.0.3", 63352, 0.07)
    assert [d.name for d in devices_of(load_settings(path))][2] == "gripper on 10.0.0.3:63352"
