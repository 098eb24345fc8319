"""Devices while a cell is calibrated."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from cell.calibration.session import CalibrationSession, opened


def test_an_arm_that_is_broken_off_stops_before_the_jaws_open() -> None:
    happened: list[str] = []
    devices = SimpleNamespace(
        arm=SimpleNamespace(stop=lambda reason: happened.append("stop")),
        gripper=SimpleNamespace(
            grip=lambda force_n: happened.append("grip"),
            release=lambda: happened.append("release"),
        ),
    )
    settings = SimpleNamespace(gripper=SimpleNamespace(force_n=20.0))
    session = CalibrationSession(settings, devices)
    with pytest.raises(KeyboardInterrupt), session.holding_cable():
        raise KeyboardInterrupt
    assert happened == ["grip", "stop", "release"]
    happened.clear()
    with session.holding_cable():
        pass
    assert happened == ["grip", "release"]


def test_every_device_is_closed_whatever_another_does() -> None:
    """Else the port of a camera stays open, and the next calibration cannot connect."""
    happened: list[str] = []

    def fails(*_: object) -> None:
        raise OSError("gone")

    def device(name: str, **more: object) -> SimpleNamespace:
        calls = {"connect": lambda: None, "close": lambda: happened.append(f"close {name}")}
        return SimpleNamespace(**{"name": name, **calls, **more})

    arm = device("arm", stop=lambda reason: happened.append("stop"), reset=lambda: None)
    idle = SimpleNamespace(holding=False)
    devices = SimpleNamespace(
        camera=device("camera"), arm=arm, gripper=device("gripper", close=fails, state=lambda: idle)
    )
    with (
        pytest.raises(OSError, match="gone"),
        opened(SimpleNamespace(), devices, moves=True, say=lambda text: None),
    ):
        raise KeyboardInterrupt
    assert happened == ["stop", "close arm", "close camera"]
