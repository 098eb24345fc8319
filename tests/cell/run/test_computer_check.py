"""What a cell needs of its computer is told, with a remedy for all that is missing."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.cli import app
from cell.computer.abilities import Abilities, Stalls
from cell.run import computer_check
from cell.run.computer_check import CameraLoad, check_computer, vision_rates_hz
from cell.vision.detect import VisionOptions

CAMERA = CameraLoad(640, 512, 200.0, VisionOptions(0.1))
GOOD = Abilities(2, True, "6.1, PREEMPT_RT", "tsc", "performance", 8 * 2**30)
SILENT = Abilities(4, True, "5.10", None, None, None)
POOR = Abilities(1, False, "5.10", "hpet", "powersave", 2**20)


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch):
    """Conditions on a computer that is made up."""

    class Probe:
        stalls = Stalls(np.array([1e-4]), np.array([1e-4]))

        def __enter__(self):
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def take(self) -> Stalls:
            return self.stalls

    def conditions(computer: Abilities, stall_s: float, tracked_hz: float):
        Probe.stalls = Stalls(np.full(100, 1e-4), np.r_[np.full(99, 1e-4), stall_s])
        monkeypatch.setattr(computer_check, "abilities", lambda: computer)
        monkeypatch.setattr(computer_check, "StallProbe", Probe)
        monkeypatch.setattr(computer_check, "vision_rates_hz", lambda _: (tracked_hz, 100.0))
        return check_computer(CAMERA, 0.0)

    return conditions


@pytest.mark.parametrize("computer", [GOOD, SILENT], ids=["good", "says nothing"])
def test_a_good_computer_meets_all(here, computer: Abilities) -> None:
    assert all(c.met and not c.remedy for c in here(computer, 0.01, 401.0))


def test_whatever_is_not_met_has_a_remedy(here) -> None:
    poor = [c for c in here(POOR, 0.05, 399.0) if not c.met]
    assert [c.name for c in poor] == [
        *("cores", "real-time scheduling", "clock", "frequency of the cores", "free memory"),
        *("stalls while awake", "vision"),
    ]
    assert all(c.remedy for c in poor)
    assert "50.0 ms" in poor[-2].measured and "camera.frame_rate_hz to 200 Hz" in poor[-1].remedy


def test_vision_is_measured_with_pictures_of_the_cameras_size() -> None:
    """One with the jaw at hand is quicker than one in which it must be found."""
    small = vision_rates_hz(CAMERA)
    large = vision_rates_hz(CameraLoad(2560, 2048, 200.0, CAMERA.vision))
    assert small[0] > small[1] > large[1]


def test_the_command_ends_with_whether_all_are_met() -> None:
    done = CliRunner().invoke(app, ["doctor", "--seconds", "1", "--json"])
    found = json.loads(done.stdout)
    assert done.exit_code == (0 if all(c["met"] for c in found) else 1)
    assert {c["name"] for c in found} >= {"cores", "stalls while asleep", "vision"}
    assert done.stderr.startswith("measuring stalls, for 1 s")


def test_settings_that_are_not_there_are_refused() -> None:
    done = CliRunner().invoke(app, ["doctor", "--config", "nowhere.yaml"])
    assert done.exit_code == 2 and "nowhere.yaml" in done.stderr
