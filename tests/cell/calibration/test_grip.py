"""How a cable is shown to the camera."""

from __future__ import annotations

from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np

from cell.calibration import grip
from cell.calibration.assistants import Operator
from cell.calibration.session import RestingView
from drivers.interfaces import Pose


def test_nobodys_hands_are_at_the_jaws_when_a_held_cable_is_moved(monkeypatch) -> None:
    happened: list[str] = []

    @contextmanager
    def holding_cable():
        happened.append("grips")
        yield

    def at_rest(*_: object) -> RestingView:
        happened.append("moves")
        return RestingView(Pose(0.0, 0.0), np.zeros((2, 2), np.uint8))

    def ask(words: str) -> str:
        happened.append("warns" if "people out: the robot will move" in words else "asks")
        return ""

    monkeypatch.setattr(grip, "grip_poses", lambda *_: [Pose(0.0, 0.0)])
    monkeypatch.setattr(grip, "_at_rest", at_rest)
    session = SimpleNamespace(
        settings=None, home=None, go_to=lambda goal: None, holding_cable=holding_cable
    )
    grip.show_cable(session, Operator(ask), None, lambda *_: None)
    assert happened == ["asks", "grips", "warns", "moves"]
