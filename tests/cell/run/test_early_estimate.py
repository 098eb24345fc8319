"""What is computed ahead: who gives way to whom, and on which clock a cable's future is."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from cell.build import cell_task
from cell.cable.dynamics import simulate
from cell.cable.effects.library import load_effect
from cell.cable.geometry import Motion
from cell.computer.second_process import SecondProcess
from cell.identify.identified import Identified
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.plan.paths import executed_motion, insertion_path
from cell.run.commands import Commands
from cell.run.early_estimate import EarlyEstimator, simulate_offsets
from cell.run.findings import FilmedMotion, Filming
from cell.run.station import Timing
from cell.settings import load_settings
from cell.study.data import Markers, Trial
from drivers.interfaces import Trajectory

CONFIG = Path(__file__).parents[3] / "config" / "fake.yaml"
WIND = '''"""A wind that comes and goes."""
import math

from cell.cable.effects import Effect, Parameter


class Wind(Effect):
    """A wind to the right, N/m, 0.7 times a second."""

    name = "wind"
    parameters = (Parameter("size", "N/m", 0.0, 1.0, default=0.0, starts=(0.01,)),)

    def force(cable, at, p):
        return p.size * math.sin(2.0 * math.pi * 0.7 * at.time), 0.0
'''


class Noting(SecondProcess):
    """Does nothing, and notes when it is hurried."""

    def __init__(self) -> None:
        super().__init__()
        self.noted: list[str] = []

    @contextmanager
    def hurried(self) -> Iterator[None]:
        self.noted.append("hurries")
        yield
        self.noted.append("gives way")


def test_the_hand_waits_for_a_process_that_hurries() -> None:
    computer = Noting()
    station = SimpleNamespace(computer=computer, commands=Commands())
    estimator = EarlyEstimator(station, Filming(0.0, 0.0, 1.0, 10))
    assert estimator.result() is None
    assert computer.noted == []
    job: Future[object] = Future()
    computer.noted.append("asked")
    job.set_result("estimate")
    estimator._second = job
    assert estimator.result() == "estimate"
    assert computer.noted == ["asked", "hurries", "gives way"]


def test_an_effect_that_depends_on_time_goes_on_as_in_the_hold(tmp_path: Path) -> None:
    """It began with the path at time 0 again, so another wind was forecast than the hold's."""
    (tmp_path / "wind.py").write_text(WIND)
    task = replace(cell_task(load_settings(CONFIG)), offsets_m=(0.0, 0.01))
    space = ParameterSpace.of(task.cable, effects=[load_effect(tmp_path / "wind.py", trusted=True)])
    mean = space.start(3e-5)
    mean[space.names.index("wind.size")] = 0.05
    none = np.zeros((len(mean), len(mean)))
    identified = Identified(space, mean, none, Noise(5e-5), 5e-5, 1.0, 250, 250, 2, "map", none)

    t_s, lowered = np.arange(0.0, 1.5, 0.002), task.lowered
    x_m, angle_rad = np.full(len(t_s), lowered.x_m), np.full(len(t_s), lowered.angle_rad)
    share = np.clip((t_s - 0.2) / 0.3, 0.0, 1.0)
    down_m = task.lower_m * (1.0 - share**3 * (10 - 15 * share + 6 * share**2))
    grip = Motion(t_s, x_m, lowered.y_m + down_m, angle_rad)
    markers = Markers(t_s[1:2], np.zeros((1, len(task.arc_length_m), 2)))
    trial = Trial("hold", "fit", "equilibrium", grip, markers)
    begin_s, start_s = 7.0, 8.7  # on the cell's clock
    hand = Trajectory(t_s + begin_s, grip.x_m, grip.y_m, grip.angle_rad)
    found = simulate_offsets(
        task,
        Timing(500.0, 0.03, 200.0),
        FilmedMotion(begin_s, (), hand, (), 0.0),
        trial,
        identified,
        start_s,
    ).forecast

    tip = np.array([task.cable.free_length_m])
    for row, offset_m in enumerate(task.offsets_m):
        path = insertion_path(lowered, offset_m, task.advance_m, task.insertion, 500.0)
        late = executed_motion(path, 0.03, settle_s=task.settle_s)
        fields = ("x_m", "y_m", "angle_rad")
        whole = Motion(
            np.append(t_s, late.t_s + 1.7),
            *(np.append(getattr(grip, f), getattr(late, f)) for f in fields),
        )
        true = simulate(space.model(mean), whole, found.t_s + 1.7, tip)[0, :, 0]
        assert np.abs(found.tip_m[row] - true).max() < 3e-5
    assert np.ptp(found.tip_m[0, -50:, 0]) > 1e-4  # the wind blows on
