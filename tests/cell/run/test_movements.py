"""The motions of a dry run: those of a cycle, end to end, and the same way in more time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cell.plan.measuring import Measuring, Move
from cell.plan.paths import MotionLimits
from cell.run.movements import (
    inserting_movements,
    measuring_movements,
    paths_from,
    slowed,
    slowed_motion,
)
from cell.run.station import Task
from cell.settings import load_settings
from cell.wiring.build import cell_task
from drivers.guard import ArmLimits, check_path
from drivers.interfaces import Pose, Trajectory

RATE_HZ = 500.0
FAKE = cell_task(load_settings(Path(__file__).parents[3] / "config" / "fake.yaml"))
WIDE = ArmLimits(-1.0, 1.0, -1.0, 1.0, -3.0, 3.0, 0.6, 6.0, 250.0, 1.0, 20.0, 1000.0)

metres = st.floats(0.005, 0.08)
coordinates = st.floats(-0.1, 0.1)
speeds = st.floats(0.02, 1.0)


@st.composite
def tasks(draw: st.DrawFn) -> Task:
    brisk = MotionLimits(draw(st.floats(0.1, 0.5)), draw(st.floats(1.0, 5.0)), 200.0)
    return replace(
        FAKE,
        home=Pose(draw(coordinates), draw(coordinates), draw(st.floats(-0.3, 0.3))),
        aside=Pose(draw(coordinates), draw(coordinates), draw(st.floats(-0.3, 0.3))),
        lower_m=draw(metres),
        lower_s=draw(st.floats(0.05, 0.6)),
        offsets_m=tuple(np.cumsum(draw(st.lists(metres, min_size=1, max_size=4)))),
        advance_m=draw(metres),
        lowering=brisk,
    )


@settings(max_examples=15, deadline=None)
@given(tasks(), speeds, coordinates, coordinates)
def test_movements_join_and_begin_where_the_hand_is_and_end_at_home(
    task: Task, speed: float, x_m: float, y_m: float
) -> None:
    here = Pose(x_m, y_m, 0.1)
    movements = inserting_movements(slowed(task, speed), RATE_HZ)
    for movement in movements:
        path = movement.path_from(here, RATE_HZ)
        if path is None:
            continue
        begin = path.at(0.0)
        assert (begin.x_m, begin.y_m) == pytest.approx((here.x_m, here.y_m), abs=3e-4)
        assert begin.angle_rad == pytest.approx(here.angle_rad, abs=2e-3)
        here = path.at(float(path.t_s[-1]))
        assert (here.x_m, here.y_m) == pytest.approx(
            (movement.goal.x_m, movement.goal.y_m), abs=1e-6
        )
    assert (movements[-1].goal, movements[0].goal) == (task.home, task.home)


@settings(max_examples=15, deadline=None)
@given(tasks(), speeds)
def test_a_slow_run_makes_the_same_way_in_inversely_more_time(task: Task, speed: float) -> None:
    full, slow = (
        [path for _, path in paths_from(task.home, t, inserting_movements(t, RATE_HZ), RATE_HZ)]
        for t in (task, slowed(task, speed))
    )
    assert len(full) == len(slow)
    for quick, path in zip(full, slow, strict=True):
        # both end on the arm's grid of times, each stroke up to one period later than it could
        assert path.t_s[-1] * speed == pytest.approx(quick.t_s[-1], abs=4.0 / RATE_HZ)
        assert _hull(path) == pytest.approx(_hull(quick), abs=1e-6)
        for power, (peak, quick_peak) in enumerate(
            zip(_peaks(path), _peaks(quick), strict=True), start=1
        ):
            assert peak <= 1.02 * speed**power * quick_peak + 1e-4 * 30.0**power


@settings(max_examples=15, deadline=None)
@given(tasks(), speeds)
def test_one_stroke_is_the_other_with_its_time_stretched(task: Task, speed: float) -> None:
    quick, slow = (
        next(
            movement.path
            for movement in inserting_movements(t, RATE_HZ)
            if movement.name == "go_down"
        )
        for t in (task, slowed(task, speed))
    )
    assert quick is not None and slow is not None
    at_s = np.minimum(slow.t_s * speed, quick.t_s[-1])
    # linear between samples 2 ms apart: at most a t² / 8
    bound_m = task.lowering.acceleration_m_per_s2 * (1.0 / RATE_HZ) ** 2 / 8.0
    np.testing.assert_allclose(
        slow.y_m, np.interp(at_s, quick.t_s, quick.y_m), atol=1.1 * bound_m + 1e-7
    )


@settings(max_examples=10, deadline=None)
@given(tasks(), speeds)
def test_what_keeps_the_limits_keeps_them_at_any_lower_speed(task: Task, speed: float) -> None:
    for _, path in paths_from(task.home, task, inserting_movements(task, RATE_HZ), RATE_HZ):
        check_path(path, WIDE)
    slow = slowed(task, speed)
    for _, path in paths_from(task.home, slow, inserting_movements(slow, RATE_HZ), RATE_HZ):
        check_path(path, WIDE)


def test_the_least_and_the_greatest_offset_are_made_and_all_are_checked() -> None:
    movements = inserting_movements(FAKE, RATE_HZ)
    deepest = [movement.goal.y_m for movement in movements if movement.name == "go_in"]
    assert deepest == pytest.approx([-0.05, -0.09])
    paths = paths_from(FAKE.home, FAKE, movements, RATE_HZ)
    ends = {round(float(p.y_m[-1]), 6) for name, p in paths if name.startswith("go_in")}
    assert ends == {round(-0.05 - offset_m, 6) for offset_m in FAKE.offsets_m}


def test_a_measuring_motion_is_made_as_it_is_measured() -> None:
    start, end = Pose(-0.01, 0.0, 0.5), Pose(-0.01, -0.05, 0.5)
    motion = Measuring("tilted", start, 0.2, (Move(end, 0.4),), 0.5)
    movements = measuring_movements(motion, FAKE, RATE_HZ, 0.25)
    assert [movement.name for movement in movements] == [
        "go_home",
        "go_to_start",
        "go_through",
        "go_home",
    ]
    assert movements[1].goal == start
    (path,) = (movement.path for movement in movements if movement.path is not None)
    assert path.t_s[-1] == pytest.approx(1.6, abs=1.0 / RATE_HZ)
    assert path.at(2.0) == end


@pytest.mark.parametrize("speed", [0.0, -0.1, 1.1, float("nan")])
def test_a_speed_that_is_none_is_refused(speed: float) -> None:
    motion = Measuring("m", FAKE.home, 0.2, (Move(FAKE.lowered, 0.4),), 0.5)
    for act in (lambda: slowed(FAKE, speed), lambda: slowed_motion(motion, speed)):
        with pytest.raises(ValueError, match=r"speed is .*: must be > 0 and ≤ 1"):
            act()


def _hull(path: Trajectory) -> tuple[float, ...]:
    return tuple(
        float(f(v)) for v in (path.x_m, path.y_m, path.angle_rad) for f in (np.min, np.max)
    )


def _peaks(path: Trajectory) -> tuple[float, float]:
    """Greatest speed and acceleration."""
    xy = np.column_stack([path.x_m, path.y_m])
    speed = np.diff(xy, axis=0) * RATE_HZ
    return (
        float(np.linalg.norm(speed, axis=1).max()),
        float(np.linalg.norm(np.diff(speed, axis=0) * RATE_HZ, axis=1).max(initial=0.0)),
    )
