"""Parsers of numbers, tables and names give back what was written, or say where it is wrong."""

from __future__ import annotations

import csv
import io
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cell.files.input_error import InputError
from cell.study.imports.capture import NOT_SEEN, CapturedColumn, is_clock, number
from cell.study.imports.column_names import ColumnKind, meaning
from cell.study.imports.delimited import read_delimited
from cell.study.imports.read import KINDS, read_capture
from cell.study.imports.units import METRES, RADIANS, SECONDS, split_unit

NUMBERS = st.floats(-1e6, 1e6, allow_nan=False).map(lambda v: round(v, 6))


def read(content: str, name: str = "t.csv") -> np.ndarray:
    with TemporaryDirectory() as folder:
        file = Path(folder) / name
        file.write_bytes(content.encode())
        return read_delimited(file).values


def test_a_separator_at_the_ends_of_rows_adds_no_column() -> None:
    rows = [f"{k}.0,{k}.5,,{k}.25" for k in range(6)]
    plain = read("\n".join(["t,x,y,z", *rows]))
    ended = read("\n".join(["t,x,y,z", *(f"{row}," for row in rows)]))
    np.testing.assert_array_equal(ended, plain)


@given(NUMBERS, st.sampled_from([".", ","]))
def test_a_number_is_read_as_it_was_written(value: float, decimal: str) -> None:
    text = repr(value).replace(".", decimal)
    assert number(f" {text} ", decimal) == value  # type: ignore[arg-type]


@given(st.text(max_size=12), st.sampled_from([".", ","]))
def test_a_cell_is_a_number_nothing_or_neither(text: str, decimal: str) -> None:
    value = number(text, decimal)  # type: ignore[arg-type]
    shown = text.strip().replace("−", "-").lower()
    assert value is None or np.isfinite(value) or shown in NOT_SEEN


@pytest.mark.parametrize("text", ["1_000", "0x1f", "inf", "1,2,3", "1.234.5", "12 mm", "1e999"])
def test_what_python_would_take_for_a_number_and_no_table_means_is_none(text: str) -> None:
    assert number(text, ".") is None


def test_times_of_day_and_dates_become_seconds() -> None:
    assert number("01:02:03.5", ".") == 3723.5
    first, second = (number(f"2024-05-01T12:00:0{k}Z", ".") for k in (1, 2))
    assert first is not None and second is not None
    assert second - first == 1.0


@pytest.mark.parametrize(
    ("written", "iso"),
    [
        ("30-Nov-2026 14:12:33.250", "2026-11-30 14:12:33.25"),
        ("05-Mrz-2026 00:00:01", "2026-03-05 00:00:01"),
        ("05-DEZ-2026 00:00:01,5", "2026-12-05 00:00:01.5"),
        ("14-févr.-2026 07:08:09", "2026-02-14 07:08:09"),
    ],
)
def test_a_month_may_be_a_word(written: str, iso: str) -> None:
    """MATLAB writes dates so; a file of them was read as one without times."""
    assert number(written, ".") == number(iso, ".") is not None
    assert is_clock(written) and not is_clock("30-Nix-2026 14:12:33")
    assert number("31-Feb-2026 14:12:33", ".") is None


@settings(max_examples=60)
@given(
    hnp.arrays(float, st.tuples(st.integers(3, 12), st.integers(3, 6)), elements=NUMBERS),
    st.sampled_from([(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), ("|", "."),
                     (" ", "."), (" ", ",")]),
    st.booleans(),
    st.sets(st.tuples(st.integers(0, 11), st.integers(1, 5)), max_size=3),
)  # fmt: skip
def test_a_table_is_read_whatever_its_separators(
    values: np.ndarray, form: tuple[str, str], remark: bool, lost: set[tuple[int, int]]
) -> None:
    separator, decimal = form
    values = values.copy()
    values[:, 0] = np.arange(len(values)) + 0.5
    for row, column in lost:
        if row < values.shape[0] and column < values.shape[1] - 1:
            values[row, column] = np.nan
    names = ["time", *(f"p{k}_{a}" for k in range(4) for a in "xy")][: values.shape[1]]
    lines = ["# made on a Monday"] if remark else []
    lines.append(separator.join(names))
    lines += [
        separator.join("nan" if v != v else repr(float(v)).replace(".", decimal) for v in row)
        for row in values
    ]
    np.testing.assert_array_equal(read("\n".join(lines) + "\n"), values)


@pytest.mark.parametrize(
    ("separator", "decimal"), [(",", "."), (";", ","), ("\t", "."), (" ", ","), ("|", ".")]
)
def test_a_long_table_is_read_as_a_short_one(separator: str, decimal: str) -> None:
    """Plain lines below the first hundreds are read at once: the same numbers, to the last bit."""
    values = np.round(np.random.default_rng(1).normal(0.0, 1e3, (700, 5)), 7)
    values[:, 0] = np.arange(len(values)) + 0.5
    lost = separator != " "
    values[500:503, 2] = values[501, 3] = np.nan if lost else 0.25
    lines = [separator.join(["time", "a_x", "a_y", "b_x", "b_y"])]
    lines += [
        separator.join("" if v != v else repr(float(v)).replace(".", decimal) for v in row)
        for row in values
    ]
    np.testing.assert_array_equal(read("\n".join(lines) + "\n"), values)
    for wrong in ("1.2.3", "12 mm", "1_000", "1e999", "0x1f"):
        bad = [*lines[:600], separator.join(["600.5", "1", wrong, "2", "3"]), *lines[601:]]
        with pytest.raises(InputError, match=":601"):
            read("\n".join(bad) + "\n")


@given(hnp.arrays(float, st.tuples(st.integers(3, 8), st.just(3)), elements=NUMBERS))
def test_decimal_commas_within_quotes_are_read(values: np.ndarray) -> None:
    stream = io.StringIO()
    writer = csv.writer(stream, quoting=csv.QUOTE_ALL)
    writer.writerow(["time", "tip_x", "tip_y"])
    values = values + 0.25
    writer.writerows([[repr(float(v)).replace(".", ",") for v in row] for row in values])
    np.testing.assert_allclose(read(stream.getvalue()), values, rtol=1e-12)


@settings(max_examples=150)
@given(st.binary(max_size=300), st.sampled_from(sorted(KINDS)))
def test_any_bytes_are_read_or_refused(content: bytes, ending: str) -> None:
    with TemporaryDirectory() as folder:
        file = Path(folder) / f"t{ending}"
        file.write_bytes(content)
        try:
            read_capture(file)
        except InputError as error:
            assert str(file) in str(error)


@settings(max_examples=150)
@given(st.lists(st.lists(st.sampled_from(["1", "2,5", "x", "", "tip", "nan", "time", "3.5", "mm",
                                          '"', "#", "X"]), max_size=6), max_size=12),
       st.sampled_from([",", ";", "\t", " "]))  # fmt: skip
def test_any_table_of_words_and_numbers_is_read_or_refused(
    rows: list[list[str]], separator: str
) -> None:
    with TemporaryDirectory() as folder:
        file = Path(folder) / "t.csv"
        file.write_text("\n".join(separator.join(row) for row in rows))
        try:
            capture = read_capture(file)
        except InputError as error:
            assert f"{file}:" in str(error)
        else:
            assert capture.values.shape == (len(capture.lines), len(capture.columns))
            assert len(set(capture.names)) == len(capture.names)


@pytest.mark.parametrize("unit", [*METRES, *SECONDS, *RADIANS])
@pytest.mark.parametrize("form", ["{} [{}]", "{} ({})", "{}_{}", "{} {}", "{}/{}"])
def test_a_unit_is_taken_off_a_name(unit: str, form: str) -> None:
    assert split_unit(form.format("tip_x", unit)) == ("tip_x", unit)


def test_a_unit_may_stand_before_the_number_of_a_run() -> None:
    assert split_unit("Position (m) Run #1") == ("Position Run #1", "m")
    assert split_unit("Track (new) no 1") == ("Track (new) no 1", "")


@pytest.mark.parametrize(
    ("name", "kind", "group", "axis"),
    [
        ("t_s", ColumnKind.TIME, "", ""),
        ("Time (Seconds)", ColumnKind.TIME, "", ""),
        ("timestamp", ColumnKind.TIME, "", ""),
        ("Zeit [ms]", ColumnKind.TIME, "", ""),
        ("Frame#", ColumnKind.FRAME, "", ""),
        ("Sub Frame", ColumnKind.FRAME, "sub", ""),
        ("tip_x_mm", ColumnKind.COORDINATE, "tip", "x"),
        ("Tip X [mm]", ColumnKind.COORDINATE, "tip", "x"),
        ("tipX", ColumnKind.COORDINATE, "tip", "x"),
        ("x_tip", ColumnKind.COORDINATE, "tip", "x"),
        ("X1", ColumnKind.COORDINATE, "1", "x"),
        ("pts_px 0 y", ColumnKind.COORDINATE, "pts 0", "y"),
        ("x0_m", ColumnKind.COORDINATE, "0", "x"),
        ("M1Z", ColumnKind.COORDINATE, "m1", "z"),
        ("rig:LED 3 Y", ColumnKind.COORDINATE, "rig led 3", "y"),
        ("/mocap/tip pose position z", ColumnKind.COORDINATE, "mocap tip", "z"),
        ("pos_y", ColumnKind.COORDINATE, "", "y"),
        ("posx", ColumnKind.COORDINATE, "", "x"),
        ("Hand Rotation W", ColumnKind.ANGLE, "hand", "w"),
        ("hand_qx", ColumnKind.QUATERNION, "hand", "x"),
        ("clamp_angle_deg", ColumnKind.ANGLE, "clamp", ""),
        ("theta", ColumnKind.ANGLE, "", ""),
        ("tip_vx", ColumnKind.OTHER, "tip vx", ""),
        ("tip x velocity", ColumnKind.OTHER, "tip velocity", "x"),
        ("force_y", ColumnKind.OTHER, "force", "y"),
        ("acc_x [g]", ColumnKind.ACCELERATION, "", "x"),
        ("ax_g", ColumnKind.ACCELERATION, "", "x"),
        ("accelY", ColumnKind.ACCELERATION, "", "y"),
        ("Base Acceleration Z (m/s²)", ColumnKind.ACCELERATION, "base", "z"),
        ("tip_az", ColumnKind.ACCELERATION, "tip", "z"),
        ("Accelerometer", ColumnKind.ACCELERATION, "", ""),
        ("arm_encoder", ColumnKind.ENCODER, "arm", ""),
        ("enc_y_mm", ColumnKind.ENCODER, "", "y"),
        ("joint angle [counts]", ColumnKind.ENCODER, "joint", ""),
        ("frame counts", ColumnKind.FRAME, "counts", ""),
        ("notes", ColumnKind.OTHER, "notes", ""),
    ],
)
def test_the_meaning_of_names_that_programs_give(
    name: str, kind: ColumnKind, group: str, axis: str
) -> None:
    found = meaning(CapturedColumn(name))
    assert (found.kind, found.group, found.axis) == (kind, group, axis)


@pytest.mark.parametrize(
    ("ending", "library"),
    [
        (".xlsx", "python_calamine"),
        (".parquet", "pyarrow.parquet"),
        (".h5", "h5py"),
        (".c3d", "ezc3d"),
        (".tdms", "nptdms"),
    ],
)
def test_a_library_that_is_missing_is_named_with_its_extra(
    ending: str, library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / f"t{ending}"
    file.write_bytes(b"x")
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(
        InputError, match=rf"needs {library.split('.')[0]} .*pip install -e .*\[import\]"
    ):
        read_capture(file)


def test_a_second_table_below_the_first_is_told(tmp_path: Path) -> None:
    file = tmp_path / "t.csv"
    file.write_text("time,tip_x,tip_y\n0,1,2\n1,2,3\n2,3,4\n\nDevices\n100\nForce\n1\n")
    capture = read_delimited(file)
    assert capture.values.shape == (3, 3)
    assert capture.notes == (f"{file}:6: another table begins here; it is not read",)
