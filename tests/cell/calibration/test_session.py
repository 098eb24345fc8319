"""Devices while a cell is calibrated."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from cell.calibration.session import Session


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
    session = Session(settings, devices)
    with pytest.raises(KeyboardInterrupt), session.holding_cable():
        raise KeyboardInterrupt
    assert happened == ["grip", "stop", "release"]
    happened.clear()
    with session.holding_cable():
        pass
    assert happened == ["grip", "release"]
