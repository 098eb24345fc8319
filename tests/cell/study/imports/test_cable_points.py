"""Which points of a file are on the cable, which on the gripper, and which on neither."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cell.study.imports.capture import Capture, CapturedColumn, ImportFindings
from cell.study.imports.choosing import choose
from cell.study.imports.contents import contents
from cell.study.imports.read import read_capture
from tests.cell.study.imports.corpus.swing import Swing
from tests.cell.study.imports.made import CABLE, NOISE_M, made, run

NAMES = ("m1", "m2", "m3", "m4", "tip")
Points = dict[str, np.ndarray]


def places(gripper: str, *names: str) -> tuple[Swing, Points]:
    """A swing, with noise of the gripper too, and the places of its points by name."""
    m = made()
    noise = np.random.default_rng(7).normal(0.0, NOISE_M, m.gripper_m.shape)
    points = {name or NAMES[i]: m.markers_m[:, i] for i, name in enumerate(names or NAMES)}
    return m, {gripper: m.gripper_m + noise, **points}


def resting(m: Swing, *place: float) -> np.ndarray:
    noise = np.random.default_rng(int(1e3 * abs(place[0]))).normal(0.0, NOISE_M, m.gripper_m.shape)
    return np.asarray(place + noise)


def chosen(points: Points, unit: str = "", elsewhere: bool = False) -> tuple[str, list[str], str]:
    """Gripping point, markers from it to the tip, and the findings; y down, 4000 pixels a metre."""
    scale = {"": 4000.0, "m": 1.0}[unit]
    names = [n for n in sorted(points) for _ in "xy"]
    columns = [CapturedColumn("t [s]")]
    columns += [CapturedColumn(f"{n}_{a}", unit) for n, a in zip(names, "xy" * 99, strict=False)]
    values = [points[n] @ np.diag([scale, -scale]) + scale for n in sorted(points)]
    rows = len(values[0])
    table = np.column_stack([np.arange(rows) / 200.0, *values])
    capture = Capture(Path("a.csv"), tuple(columns), table, np.arange(rows) + 2)
    findings = ImportFindings()
    result = choose(capture, contents(capture), elsewhere, findings, (), 0.1)
    told = " ".join(f.sentence for f in findings)
    hand = result.gripper.name if result.gripper is not None else ""
    return hand, [p.name for p in result.markers], told


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize(("gripper", "elsewhere"), [("clamp", False), ("p0", False), ("", True)])
def test_points_that_rest_while_the_gripper_moves_are_left_out(
    gripper: str, elsewhere: bool, count: int
) -> None:
    """A ruler joined the chain, and its ends were taken as the cable's: arc lengths and unit were
    wrong."""
    m, points = places(gripper)
    points.pop("") if elsewhere else None
    points |= {"q_0": resting(m, -0.25, -0.12), "q_100": resting(m, -0.35, -0.12)}
    if count == 1:
        del points["q_0"]
    hand, markers, told = chosen(points, elsewhere=elsewhere)
    assert (hand, markers) == (gripper, list(NAMES))
    assert "'q 100'" in told and "not on the cable: it is left out" in told


@pytest.mark.parametrize(
    ("unit", "place", "size", "why"),
    [
        ("m", (0.9, 0.3), 0.03, "is farther from the others than the cable is long"),
        ("", (0.05, 0.08), 0.05, "keeps no distance to another point"),
    ],
)
def test_points_that_move_apart_from_the_cable_are_left_out(
    unit: str, place: tuple[float, float], size: float, why: str
) -> None:
    """Markers on the operator turned the axes, and made the unit implausible."""
    m, points = places("clamp")
    walk = size * np.column_stack([np.sin(2.0 * m.t_s), np.cos(3.1 * m.t_s)])
    hand, markers, told = chosen({**points, "lsho": resting(m, *place) + walk}, unit)
    assert (hand, markers) == ("clamp", list(NAMES))
    assert f"'lsho' {why}" in told


def test_corners_of_a_tag_are_one_marker_with_its_centre() -> None:
    """Each corner was taken as a marker of the cable."""
    m, points = places("p0")
    points["q9"] = resting(m, -0.3, -0.2)
    cos, sin = np.cos(m.angle_rad), np.sin(m.angle_rad)
    for name, centre in tuple(points.items()):
        points[f"{name}_c"] = points.pop(name)
        for k, (x, y) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
            turned = np.column_stack([x * cos - y * sin, x * sin + y * cos])
            points[f"{name}_c{k}"] = centre + 0.003 * turned
    hand, markers, told = chosen(points)
    assert (hand, markers) == ("p0 c", [f"{n} c" for n in NAMES])
    assert "as corners of a tag do" in told


@pytest.mark.parametrize("gripper", ["clamp", "klemme", "p0"])
@pytest.mark.parametrize("name", ["root", "cable_base"])
def test_a_marker_that_swings_is_on_the_cable_though_named_after_its_root(
    gripper: str, name: str
) -> None:
    """'root' at 40 mm was the gripping point: the unit was 43 % too large, up was reversed."""
    _, points = places(gripper)
    points[name] = points.pop("m2")
    hand, markers, told = chosen(points)
    assert (hand, markers) == (gripper, ["m1", name.replace("_", " "), "m3", "m4", "tip"])
    assert "swings with 'tip' while the gripper rests" in told


def test_a_root_that_does_not_swing_is_the_gripping_point() -> None:
    _, points = places("root")
    assert chosen(points)[:2] == ("root", list(NAMES))


def tema(folder: Path, later_ms: float, gap: bool = False) -> Path:
    """A column of times for each point, with one name."""
    m, points = places("Klemme", "P20", "P40", "P60", "P80", "Spitze")
    names, rows = [], []
    for name in points:
        names += ["Time (ms)", f"{name}, X (mm)", f"{name}, Y (mm)"]
    for k, t in enumerate(m.t_s):
        cells = []
        for i, xy in enumerate(points.values()):
            time = "" if gap and i and k > 350 else f"{1e3 * t + (later_ms if i else 0.0):.3f}"
            cells += [time, *(f"{1e3 * v:.5f}" for v in xy[k])]
        rows.append("\t".join(cells))
    file = folder / "tema.txt"
    file.write_text("TEMA 3.9\n" + "\n".join(["\t".join(names), *rows]) + "\n")
    return file


@pytest.mark.parametrize("gap", [False, True])
def test_repeated_times_that_agree_are_one_column(tmp_path: Path, gap: bool) -> None:
    """They were refused: names must differ."""
    assert read_capture(tema(tmp_path, 0.0, gap)).names.count("Time (ms)") == 1


def test_repeated_times_that_differ_are_refused(tmp_path: Path) -> None:
    told = run(tema(tmp_path, 1.0), "-o", tmp_path / "out", *CABLE, code=2)
    assert "'Time (ms)' names columns 1 and 4 and 7" in told
