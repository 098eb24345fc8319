"""Times of day, alone or beside a date, that pass midnight during the motion."""

from __future__ import annotations

from datetime import date, datetime, time, timedelta
from pathlib import Path

import numpy as np
import pytest

from cell.study.imports.days import over_midnight
from cell.study.imports.read import read_capture

from .corpus.swing import MARKERS, Swing
from .made import check_same, imported, made, saved, text
from .test_layouts import _xlsx

#: Half a second before midnight.
_BEGINS = datetime(2026, 12, 1, 23, 59, 59, 500_000)
_NAMES = ["tcp_x_mm", "tcp_y_mm", "tcp_angle_deg", *(f"{m}_{a}_mm" for m in MARKERS for a in "xy")]


def _values(m: Swing) -> list[list[float]]:
    markers = 1e3 * m.markers_m.reshape(len(m.t_s), -1)
    values = np.column_stack([1e3 * m.gripper_m, np.degrees(m.angle_rad), markers])
    return values.round(7).tolist()  # type: ignore[no-any-return]


def _moments(m: Swing) -> list[datetime]:
    return [_BEGINS + timedelta(seconds=t) for t in m.t_s.tolist()]


@pytest.mark.parametrize("day", ["%d.%m.%Y", "%Y-%m-%d", "%m/%d/%Y", "%d-%b-%Y", None])
@pytest.mark.parametrize("decimal", [".", ","])
def test_a_text_with_times_of_day_goes_on_over_midnight(
    tmp_path: Path, day: str | None, decimal: str
) -> None:
    m = made()
    rows: list[list[object]] = [[*(["Date"] if day else []), "Time", *_NAMES]]
    for moment, values in zip(_moments(m), _values(m), strict=True):
        cells = [f"{moment:%H:%M:%S.%f}", *(f"{v:.7f}" for v in values)]
        dates = [moment.strftime(day)] if day else []
        rows.append([*dates, *(c.replace(".", decimal) for c in cells)])
    file = saved(tmp_path / "trend.csv", text(rows, ";"))
    capture = read_capture(file)
    assert not capture.notes and capture.names[0] == "Time"
    seconds = capture.column("Time")
    np.testing.assert_allclose(seconds - seconds[0], m.t_s, atol=2e-6)
    if day == "%Y-%m-%d":
        check_same(imported([str(file)], tmp_path / "s"), m)


@pytest.mark.parametrize("day", [datetime, date, None])
def test_a_sheet_with_times_of_day_goes_on_over_midnight(
    tmp_path: Path, day: type[date] | None
) -> None:
    m = made()
    rows: list[list[object]] = [[*(["Datum"] if day else []), "Zeit", *_NAMES]]
    for moment, values in zip(_moments(m), _values(m), strict=True):
        dates = [] if day is None else [day(moment.year, moment.month, moment.day)]
        rows.append([*dates, time(moment.hour, moment.minute, moment.second, moment.microsecond)])
        rows[-1] += values
    _xlsx(tmp_path / "trend.xlsx", {"Trend": rows})
    seconds = read_capture(tmp_path / "trend.xlsx").column("Zeit")
    np.testing.assert_allclose(seconds - seconds[0], m.t_s, atol=6e-4)


def test_a_gripper_log_that_begins_after_midnight_has_its_date(tmp_path: Path) -> None:
    m = made()
    begin = int(np.searchsorted(m.t_s, 0.52))
    values = np.array(_values(m))
    parts = []
    for name, columns, first in (("camera.csv", range(3, 13), 0), ("robot.csv", range(3), begin)):
        rows: list[list[object]] = [["date", "time", *(_NAMES[c] for c in columns)]]
        for moment, row in zip(_moments(m)[first:], values[first:], strict=True):
            cells = [f"{moment:%Y-%m-%d}", f"{moment:%H:%M:%S.%f}"]
            rows.append([*cells, *(f"{row[c]:.7f}" for c in columns)])
        parts.append(read_capture(saved(tmp_path / name, text(rows))))
    camera, robot = parts
    assert robot.column("time")[0] == pytest.approx(camera.column("time")[begin], abs=1e-4)


def test_only_a_step_of_half_a_day_back_is_to_the_next_day() -> None:
    late = [86_399.0, 86_399.5, 0.0, 0.5]
    np.testing.assert_array_equal(
        over_midnight(np.array(late)), [86_399, 86_399.5, 86_400, 86_400.5]
    )
    for other in ([5.0, 6.0, 5.0], [100.0, 80_000.0, 80_001.0], [np.nan, 1.0, 2.0]):
        np.testing.assert_array_equal(over_midnight(np.array(other)), other)
    twice = over_midnight(np.array([*late, *late]))  # a marker after the other
    np.testing.assert_array_equal(twice[:4], twice[4:])
