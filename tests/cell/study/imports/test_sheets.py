"""Sheets as people fill them: anywhere, with properties above the table, with numbers as text."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from cell.study.imports.contents import contents
from cell.study.imports.read import read_capture
from cell.study.imports.trial_files import read_trials
from cell.study.imports.trials import Files

from .corpus.swing import MARKERS, Swing, known_study
from .made import saved, text
from .test_layouts import _xlsx

_NAMES = ["Bild", "Zeit / s", "Greifer x / mm", "Greifer y / mm", "Greifer φ / °"]
_NAMES += [f"{m} {a} / mm" for m in MARKERS for a in "xy"]
#: Cells above the table, as many columns to the right of its first one.
_ABOVE: dict[str, tuple[int, list[object]]] = {
    "nothing": (0, []),
    "a property": (0, ["Lauf", 1]),
    "a property farther right": (3, ["Lauf", 1]),
    "a property of words": (0, ["Bediener", "Meier"]),
    "a property with its unit": (0, ["Rate", 200, "Hz"]),
}


def _rows(s: Swing, mark: str) -> list[list[object]]:
    """Rows of a table; mark  of numbers that are texts; empty = they are numbers."""
    values = np.column_stack([
        np.arange(len(s.t_s)), s.t_s, 1e3 * s.gripper_m, np.degrees(s.angle_rad),
        1e3 * s.markers_m.reshape(len(s.t_s), -1),
    ])  # fmt: skip
    if not mark:
        return values.round(7).tolist()  # type: ignore[no-any-return]
    return [[k, *(f"{v:.7f}".replace(".", mark) for v in row[1:])] for k, row in enumerate(values)]


def _sheet(s: Swing, mark: str, corner: int, above: str) -> list[list[object]]:
    right, cells = _ABOVE[above]
    rows: list[list[object]] = [["Auswertung"], [], [*[None] * right, *cells], []] if cells else []
    table: Sequence[list[object]] = [*rows, list(_NAMES), [], *_rows(s, mark)]
    return [[*[None] * corner, *row] for row in table]


@pytest.mark.parametrize("mark", ["", ",", "."], ids=["numbers", "commas", "points"])
@pytest.mark.parametrize("corner", [0, 2])
@pytest.mark.parametrize("above", list(_ABOVE))
def test_sheets_with_properties_and_numbers_as_text_are_trials(
    tmp_path: Path, mark: str, corner: int, above: str
) -> None:
    truth = known_study()
    sheets = {f"Lauf {k}": _sheet(s, mark, corner, above) for k, s in enumerate(truth, 1)}
    _xlsx(tmp_path / "a.xlsx", sheets)
    trials = read_trials([tmp_path / "a.xlsx"], [], str)
    assert [t.name for t in trials] == ["Lauf_1", "Lauf_2"]
    for trial, s in zip(trials, truth, strict=True):
        assert trial.capture.names == tuple(_NAMES)
        np.testing.assert_allclose(trial.capture.values, np.array(_rows(s, "")), atol=1e-7)


@pytest.mark.parametrize("above", ["a property", "a property farther right"])
def test_a_property_is_no_line_of_names_of_a_text(tmp_path: Path, above: str) -> None:
    s = known_study()[0]
    right, cells = _ABOVE[above]
    filled = [*[""] * right, *map(str, cells)]
    head = [*filled, *[""] * (len(_NAMES) - len(filled))]
    rows: list[list[object]] = [list(head), list(_NAMES), *_rows(s, ",")]
    file = saved(tmp_path / "a.csv", text(rows, ";"))
    assert read_capture(file).names == tuple(_NAMES)


@pytest.mark.parametrize("titles", [("X", "Y"), ("y", "x"), ("X", "Y", "Z")])
def test_sheets_of_an_axis_each_are_one_table(tmp_path: Path, titles: tuple[str, ...]) -> None:
    s = known_study()[0]
    places = np.concatenate([s.gripper_m[:, None], s.markers_m], axis=1)
    places = 1e3 * np.concatenate([places, np.zeros_like(places[..., :1])], axis=2)
    points = ("Greifer", *MARKERS)
    sheets: dict[str, list[list[object]]] = {"Notes": [["by", "Meier"]]}
    for title in titles:
        values = places[..., "xyz".index(title.lower())]
        rows = np.column_stack([s.t_s, values]).tolist()
        sheets[title] = [["t [s]", *(f"{p} [mm]" for p in points)], *rows]
    angle = np.column_stack([s.t_s, np.degrees(s.angle_rad)]).tolist()
    sheets["Angle"] = [["t [s]", "Greifer [deg]"], *angle]
    sheets["Other"] = [["t [s]", "volt"], *([float(k), 1.0] for k in range(20))]
    _xlsx(tmp_path / "a.xlsx", sheets)
    capture = read_capture(tmp_path / "a.xlsx")
    for k, p in enumerate(points):
        for title in titles:
            values = places[:, k, "xyz".index(title.lower())]
            np.testing.assert_allclose(capture.column(f"{p} {title}"), values, atol=1e-12)
    np.testing.assert_allclose(capture.column("Greifer Angle"), np.degrees(s.angle_rad))
    assert len(capture.names) == 2 + len(points) * len(titles)
    inside = contents(capture)
    assert [len(p.columns) for p in inside.points] == [len(titles)] * len(points)
    assert [n for n, _ in inside.angles] == ["Greifer Angle"]


def _beside(s: Swing) -> list[list[object]]:
    """A robot's log, and to the right of an empty column what a camera saw, at other times."""
    late_s = 0.003
    hand = np.column_stack([s.t_s, 1e3 * s.gripper_m, np.degrees(s.angle_rad)]).round(7).tolist()
    camera = np.column_stack([s.t_s + late_s, 1e3 * s.markers_m.reshape(len(s.t_s), -1)])
    rows: list[list[object]] = [["Robot", "", "", "", "", "Camera"]]
    rows.append(
        ["Time", "X", "Y", "Angle", "", "Time", *(f"{m} {a}" for m in MARKERS for a in "xy")]
    )
    rows.append(["s", "mm", "mm", "deg", "", "s", *["mm"] * 10])
    seen = camera.round(7).tolist()[:-5]  # fewer rows than the robot's
    cells = [[*own, "", *(seen[k] if k < len(seen) else [""] * 11)] for k, own in enumerate(hand)]
    rows += cells
    return rows


def _check_beside(trial: Files, s: Swing) -> None:
    assert trial.gripper is not None
    np.testing.assert_allclose(trial.gripper.column("Time"), s.t_s, atol=1e-7)
    np.testing.assert_allclose(trial.gripper.at(["X", "Y"]), 1e3 * s.gripper_m, atol=1e-6)
    assert trial.capture.names[0] == "Time" and len(trial.capture.names) == 11
    np.testing.assert_allclose(trial.capture.column("Time"), s.t_s[:-5] + 0.003, atol=1e-7)


def test_tables_side_by_side_on_sheets_are_the_cable_and_its_gripper(tmp_path: Path) -> None:
    truth = known_study()
    sheets = {f"Test {k}": _beside(s) for k, s in enumerate(truth, 1)} | {"Info": [["by", "J."]]}
    _xlsx(tmp_path / "a.xlsx", sheets)
    trials = read_trials([tmp_path / "a.xlsx"], [], lambda path: path.name)
    assert [(t.name, t.file, t.gripper_file) for t in trials] == [
        (f"Test_{k}", f"a.xlsx#Test {k}!F", f"a.xlsx#Test {k}!A") for k in (1, 2)
    ]
    for trial, s in zip(trials, truth, strict=True):
        _check_beside(trial, s)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_tables_side_by_side_in_a_text_are_the_cable_and_its_gripper(
    tmp_path: Path, separator: str
) -> None:
    s = known_study()[0]
    file = saved(tmp_path / "a.csv", text(_beside(s), separator))
    (trial,) = read_trials([file], [], lambda path: path.name)
    assert (trial.file, trial.gripper_file) == ("a.csv#F", "a.csv#A")
    _check_beside(trial, s)


def test_an_empty_column_between_points_with_the_same_times_is_none_between_tables(
    tmp_path: Path,
) -> None:
    s = known_study()[0]
    rows: list[list[object]] = [["t", "tip x", "tip y", "", "t", "hand x", "hand y"]]
    both = (np.column_stack([s.t_s, at_m]).round(9) for at_m in (s.markers_m[:, -1], s.gripper_m))
    rows += [[*a, "", *b] for a, b in zip(*(v.tolist() for v in both), strict=True)]
    _xlsx(tmp_path / "a.xlsx", {"Run": rows})
    (trial,) = read_trials([tmp_path / "a.xlsx"], [], lambda path: path.name)
    assert trial.gripper is None and {"tip x", "hand x"} <= set(trial.capture.names)
