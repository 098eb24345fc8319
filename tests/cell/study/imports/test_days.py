"""Times of day, alone or beside a date, that pass midnight during the motion."""

from __future__ import annotations

from datetime import UTC, date, datetime, time, timedelta
from pathlib import Path

import numpy as np
import pytest

from cell.study.imports.read import read_capture
from cell.study.imports.repairs import over_midnight

from .corpus.swing import MARKERS, Swing
from .made import CABLE, check_same, filled, imported, made, run, saved, text
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


def _wincc(m: Swing, file: Path, clock: bool) -> Path:
    """A line for each number; the last marker's x is not valid in the first rows.

    source  Siemens WinCC, data log
    """
    rows: list[list[object]] = [["VarName", *(["TimeString"] if clock else []), "VarValue"]]
    rows[0] += ["Validity", "Time_ms"]
    for k, (moment, values) in enumerate(zip(_moments(m), _values(m), strict=True)):
        days = (moment - datetime(1899, 12, 30)) / timedelta(days=1)
        for name, value in zip(_NAMES, values, strict=True):
            valid = not (name == _NAMES[-2] and k < 3)
            row = [f"{value if valid else 0.0:.7f}", int(valid), f"{1e6 * days:.8f}"]
            row = [name, *([f"{moment:%d.%m.%Y %H:%M:%S}"] if clock else []), *row]
            rows.append([str(cell).replace(".", ",") if cell is not row[1] or not clock else cell
                         for cell in row])  # fmt: skip
    rows.append(["$RT_COUNT$", len(rows) - 1, *[""] * (len(rows[0]) - 2)])
    return saved(file, text(rows, ";"))


def test_days_that_a_coarser_clock_shows_are_the_times(tmp_path: Path) -> None:
    m = made()
    capture = read_capture(_wincc(m, tmp_path / "log.csv", clock=True))
    assert capture.names == ("Time_ms", *_NAMES)
    assert any("counts 0.0864 s since 1899-12-30" in note for note in capture.notes)
    seconds = capture.column("Time_ms")
    np.testing.assert_allclose(seconds - seconds[0], m.t_s, atol=5e-6)
    assert seconds[0] == pytest.approx(_BEGINS.replace(tzinfo=UTC).timestamp(), abs=1e-5)
    assert np.isnan(capture.column(_NAMES[-2])[:3]).all()
    np.testing.assert_allclose(capture.values[3:, 1:], _values(m)[3:])


def test_a_unit_of_time_by_which_no_gripper_moves_is_refused(tmp_path: Path) -> None:
    file = _wincc(made(), tmp_path / "log.csv", clock=False)
    said = run(file, "-o", tmp_path / "s", *CABLE, code=1)
    assert "limit 1000 m/s²; correct time.seconds_per_unit" in said
    filled(tmp_path / "s" / "import.yaml", {"time.seconds_per_unit": 0.0864})
    run(tmp_path / "s" / "import.yaml")


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("kind", ["duration", "timestamp"])
def test_durations_and_moments_of_arrow_are_seconds(tmp_path: Path, kind: str, unit: str) -> None:
    import pyarrow as arrow
    from pyarrow.parquet import write_table

    ticks = [1_000, 6_000, None] if unit != "ns" else [1_000_000_001, 6_000_000_000, None]
    times = arrow.array(ticks, arrow.int64()).cast(getattr(arrow, kind)(unit))
    table = arrow.table({"time": times, "tip_x": [1.0, 2.0, 3.0], "tip_y": [1.0, 2.0, 3.0]})
    write_table(table, tmp_path / "run.parquet")
    capture = read_capture(tmp_path / "run.parquet")
    seconds = np.array([np.nan if k is None else k for k in ticks])
    seconds *= {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}[unit]
    np.testing.assert_allclose(capture.column("time"), seconds, rtol=1e-15)
    assert capture.columns[0].unit == ("s" if kind == "duration" else "")
