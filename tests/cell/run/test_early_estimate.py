"""What is computed ahead: who gives way to whom, and on which clock a cable's future is."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.effects.library import load_effect
from cell.cable.geometry import Motion
from cell.computer.second_process import SecondProcess
from cell.identify.identified import Identified
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.plan.choose import Freedom
from cell.plan.paths import executed_motion, insertion_path
from cell.run.candidates import simulate_offsets
from cell.run.commands import Commands
from cell.run.early_estimate import EarlyEstimator, ScheduledEstimate, _schedule
from cell.run.findings import EarlyEstimate, FilmedMotion, Filming
from cell.run.station import Timing
from cell.settings import load_settings
from cell.study.data import Markers, Trial
from cell.wiring.build import cell_task
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
    task, timing = cell_task(load_settings(CONFIG)), Timing(500.0, 0.03, 10.0)
    station = SimpleNamespace(computer=computer, commands=Commands(), task=task, timing=timing)
    filming = Filming(0.0, 0.0, 1.0, 10)
    estimator = EarlyEstimator(station, filming)
    assert estimator.result(10) is None
    assert computer.noted == []
    job: Future[object] = Future()
    computer.noted.append("asked")
    estimate = EarlyEstimate(*3 * [SimpleNamespace()])
    job.set_result(estimate)
    estimator._running.append((ScheduledEstimate(0.0, filming), job))
    assert estimator.result(9) is None
    assert estimator.result(10) is estimate
    assert computer.noted == ["asked", "hurries", "gives way"]


def holds(least_s: float | None, most_s: float, window_s: float = 0.0) -> list[ScheduledEstimate]:
    task = replace(cell_task(load_settings(CONFIG)), least_hold_s=least_s, hold_s=most_s)
    task = replace(task, choice=replace(task.choice, freely=Freedom(window_s)))
    filming = Filming(2.0, 2.5, 2.5 + most_s, 100 + round(200 * most_s))
    return list(_schedule(task, Timing(500.0, 0.03, 200.0), filming))


def test_a_fixed_hold_is_looked_at_twice_and_ends_once() -> None:
    first, last = holds(None, 1.0)
    assert first.filming is None and first.after_s < last.after_s
    assert last.filming is not None and last.filming.frame_count == 300


def test_a_hold_may_end_at_a_few_moments_each_decided_ahead() -> None:
    looks = holds(0.4, 1.0)
    assert [round(look.after_s, 9) for look in looks] == [0.1, 0.4, 0.7]
    ends = [look.filming for look in looks if look.filming is not None]
    assert [round(f.end_s - f.rest_s, 9) for f in ends] == [0.4, 0.7, 1.0]
    assert [f.frame_count for f in ends] == [180, 240, 300]


def test_the_last_moment_is_the_longest_hold() -> None:
    """However the moments fall, none is close to the end, and none before the least."""
    for least_s, most_s, window_s in ((0.1, 0.45, 0.0), (0.5, 0.6, 0.0), (0.4, 1.2, 0.25)):
        looks = holds(least_s, most_s, window_s)
        ends = [look.filming.end_s - 2.5 for look in looks if look.filming is not None]
        assert len(ends) == len(looks) and ends[-1] == pytest.approx(most_s)
        assert all(end_s >= least_s for end_s in ends)
        assert all(look.after_s < end_s for look, end_s in zip(looks, ends, strict=True))
        assert np.all(np.diff([0.0, *ends]) > 0.1)


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
