"""Studies survive writing and reading; every mistake a person makes is named with its remedy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cell.cable.geometry import Cable, Connector, Motion
from cell.files.input_error import InputError
from cell.study.data import Markers, Study, Trial
from cell.study.folder import read_study, study_folder, write_study
from cell.study.hand_drift import HandDrift

SHARED = Path(__file__).parents[4] / "shared" / "data"


def trial(name: str = "identify", *, seed: int = 0, markers: int = 3, rows: int = 5) -> Trial:
    rng = np.random.default_rng(seed)
    t_s = np.cumsum(rng.uniform(1e-4, 0.01, rows))
    arc_m = np.linspace(0.1, 0.0, markers)
    xy_m = rng.uniform(-1e-3, 1e-3, (rows, markers, 2)) + arc_m[:, None] * [-0.8, -0.5]
    return Trial(
        name,
        "fit",
        "equilibrium",
        Motion(t_s, *rng.uniform(-1e-3, 1e-3, (2, rows)), rng.uniform(-0.5, 0.5, rows)),
        Markers(t_s + 1e-4, xy_m),
    )


def study(*trials: Trial) -> Study:
    return Study(
        "s", Cable(0.1, 0.0074, 0.016, 1e-4), np.array([0.1, 0.05, 0.0]), trials or (trial(),)
    )


def same(a: Study, b: Study) -> None:
    for field in ("name", "cable", "gravity_m_per_s2", "noise_std_m"):
        assert getattr(a, field) == getattr(b, field)
    assert (a.arc_length_std_m is None) == (b.arc_length_std_m is None)
    for one, other in (
        (a.arc_length_m, b.arc_length_m),
        (np.array(a.arc_length_std_m), np.array(b.arc_length_std_m)),
    ):
        np.testing.assert_array_equal(one, other)
    for left, right in zip(a.trials, b.trials, strict=True):
        for field in ("name", "role", "start", "release_s", "hand_drift"):
            assert getattr(left, field) == getattr(right, field)
        for field in ("t_s", "x_m", "y_m", "angle_rad"):
            np.testing.assert_array_equal(getattr(left.grip, field), getattr(right.grip, field))
        np.testing.assert_array_equal(left.markers.t_s, right.markers.t_s)
        np.testing.assert_array_equal(left.markers.xy_m, right.markers.xy_m)


@st.composite
def connectors(draw: st.DrawFn) -> Connector | None:
    if draw(st.booleans()):
        return None
    rod = Connector.rod(draw(st.floats(1e-6, 1.0)), draw(st.floats(1e-3, 0.5)))
    return replace(rod, inertia_kg_m2=rod.inertia_kg_m2 * draw(st.floats(0.1, 2.9)))


def drifts() -> st.SearchStrategy[HandDrift | None]:
    density = st.floats(0.0, 1e-2)
    return st.none() | st.builds(
        HandDrift,
        st.floats(-1.0, 0.0),
        st.floats(0.1, 1.0),
        st.tuples(density, density),
        st.floats(0.0, 0.1),
        st.booleans(),
    )


@st.composite
def studies(draw: st.DrawFn) -> Study:
    count = draw(st.integers(1, 4))
    free_length_m = draw(st.floats(0.02, 2.0))
    fractions = draw(
        st.lists(st.integers(0, 1000), min_size=count, max_size=count, unique=True).map(
            lambda x: np.sort(np.array(x))[::-1] / 1000
        )
    )
    # Inside 1.5 free lengths of the gripper wherever both are.
    near = st.floats(-0.4 * free_length_m, 0.4 * free_length_m)
    trials = []
    for i in range(draw(st.integers(1, 3))):
        start = draw(st.sampled_from(["equilibrium", "straight"]))
        rows = draw(st.integers(2, 6))
        steps = draw(hnp.arrays(float, rows, elements=st.floats(1e-4, 0.1)))
        grip = draw(hnp.arrays(float, (2, rows), elements=near))
        # Within reach of the gripper, on the side to which the clamp points.
        towards = draw(hnp.arrays(float, (rows, count, 2), elements=st.floats(-0.7, 0.0)))
        xy_m = grip.T[:, None] + towards * (fractions * free_length_m)[:, None]
        xy_m += 1e-5 * free_length_m * np.arange(rows)[:, None, None]  # none was lost and stays
        unseen = draw(hnp.arrays(bool, (rows, count)))
        unseen[0, 0] = False
        xy_m[unseen] = np.nan
        trials.append(
            Trial(
                f"trial_{i}",
                draw(st.sampled_from(["fit", "validate"])),
                start,  # type: ignore[arg-type]
                Motion(
                    np.cumsum(steps),
                    grip[0],
                    grip[1],
                    draw(hnp.arrays(float, rows, elements=st.floats(-1.5, 1.5))),
                ),
                Markers(np.cumsum(steps), xy_m),
                draw(st.sampled_from(np.cumsum(steps))) if start == "straight" else None,
                draw(drifts()),
            )
        )
    return Study(
        draw(st.text(st.characters(codec="utf-8", categories=("L", "N")), min_size=1)),
        Cable(free_length_m, draw(st.floats(4e-5, 0.035)), 0.016, 1e-4, draw(connectors())),
        fractions * free_length_m,
        tuple(trials),
        (draw(st.floats(-9.0, 9.0)), -9.81),
        draw(st.none() | st.floats(1e-6, 1e-3)),
        arc_length_std_m=draw(
            st.none() | hnp.arrays(float, count, elements=st.floats(0.0, 0.02 * free_length_m))
        ),
    )


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(studies())
def test_what_is_written_is_read_back_to_the_last_bit(tmp_path: Path, original: Study) -> None:
    write_study(original, tmp_path)
    same(read_study(tmp_path), original)


def test_markers_listed_from_the_hand_are_turned_tip_first(tmp_path: Path) -> None:
    original = study()
    turned = Study(
        original.name,
        original.cable,
        original.arc_length_m[::-1],
        tuple(
            Trial(t.name, t.role, t.start, t.grip, Markers(t.markers.t_s, t.markers.xy_m[:, ::-1]))
            for t in original.trials
        ),
    )
    write_study(turned, tmp_path)
    same(read_study(tmp_path), original)


@pytest.mark.skipif(not SHARED.exists(), reason="shared measurements are not beside the project")
@pytest.mark.parametrize("kind", ["practice", "real"])
def test_the_shared_studies_are_read(kind: str) -> None:
    folders = [f.parent for f in sorted((SHARED / kind).glob("*/study.yaml"))]
    assert folders
    for folder in folders:
        read = read_study(folder)
        assert read.name == folder.name
        assert read.role("fit")
        assert all(np.isfinite(t.markers.xy_m).any() for t in read.trials)


Edit = Callable[[str], str]


def swap(old: str, new: str) -> Edit:
    def edit(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return edit


def lines(change: Callable[[list[str]], list[str]]) -> Edit:
    return lambda text: "\n".join(change(text.splitlines())) + "\n"


def cell(row: int, column: int, value: str) -> Edit:
    def change(rows: list[str]) -> list[str]:
        cells = rows[row].split(",")
        cells[column] = value
        return [*rows[:row], ",".join(cells), *rows[row + 1 :]]

    return lines(change)


def test_a_round_cable_has_the_section_of_its_diameter(tmp_path: Path) -> None:
    write_study(study(), tmp_path)
    header = tmp_path / "study.yaml"
    kept = [x for x in header.read_text(encoding="utf-8").splitlines() if "width_m" not in x]
    text = "\n".join("  diameter_m: 0.0012" if "thickness_m" in x else x for x in kept)
    header.write_text(text, encoding="utf-8")
    cable = read_study(tmp_path).cable
    assert cable.width_m == 0.0012
    assert cable.width_m * cable.thickness_m == pytest.approx(np.pi * 0.0006**2)


def with_connector(entries: str) -> Edit:
    return swap("width_m: 0.016", f"width_m: 0.016\n  connector: {{{entries}}}")


def test_a_connector_without_an_inertia_is_a_rod(tmp_path: Path) -> None:
    write_study(study(), tmp_path)
    header = tmp_path / "study.yaml"
    text = header.read_text(encoding="utf-8")
    assert "connector" not in text
    stated = with_connector("mass_kg: 0.002, length_m: 0.02")(text)
    header.write_text(stated.replace("- 0.1\n", "- 0.11\n"), encoding="utf-8")  # on the connector
    read = read_study(tmp_path)
    assert read.cable.connector == Connector.rod(0.002, 0.02)
    assert read.arc_length_m.max() == 0.11


def with_std(entry: str) -> Edit:
    return swap("markers:\n", f"markers:\n  arc_length_std_m: {entry}\n")


def test_one_standard_deviation_of_arc_length_is_all_markers(tmp_path: Path) -> None:
    header = tmp_path / "study.yaml"
    for entry, std_m in (("0.0005", [5e-4] * 3), ("[0, 0.001, 0.0005]", [0.0, 1e-3, 5e-4])):
        write_study(study(), tmp_path)
        header.write_text(with_std(entry)(header.read_text(encoding="utf-8")), encoding="utf-8")
        read = read_study(tmp_path).arc_length_std_m
        assert read is not None
        assert read.tolist() == std_m


MISTAKES: list[tuple[str, Edit, str]] = [
    ("study.yaml", swap("0.1", "100"), "study.yaml:4:3: cable.free_length_m: 100 m is beyond"),
    ("study.yaml", swap("0.0074", "7.4"), "kg/m, not g/m"),
    ("study.yaml", swap("cable-study/1", "cable-study/2"), "study.yaml:1:1: format: "),
    ("study.yaml", swap("role: fit", "role: fitt"), "trials[0].role: input should be 'fit'"),
    ("study.yaml", swap("role: fit", "rôle: fit"), "did you mean 'role'?"),
    ("study.yaml", swap("role: fit\n", "role: fit\n  role: fit\n"), "given twice, first in line"),
    ("study.yaml", swap("width_m", "width_mm"), "did you mean 'width_m'?"),
    (
        "study.yaml",
        with_connector("mass_kg: 0.002, length_m: 20"),
        "study.yaml:7:31: cable.connector.length_m: 20 m is beyond 1 m; give metres, not milli",
    ),
    (
        "study.yaml",
        with_connector("mass_kg: 20, length_m: 0.02"),
        "cable.connector.mass_kg: 20 kg is beyond 10 kg; give kg, not g",
    ),
    (
        "study.yaml",
        with_connector("mass_kg: 0.002, length_m: 0.02, inertia_kg_m2: 1.0e-4"),
        "inertia_kg_m2: 0.0001 kg·m² is beyond 2e-07 kg·m², all of its mass at its ends",
    ),
    ("study.yaml", with_connector("mass_kg: -1, length_m: 0.02"), "connector.mass_kg: input sh"),
    ("study.yaml", with_connector("mass_kg: 0.002"), "cable.connector.length_m: "),
    ("study.yaml", swap("width_m: 0.016", ""), "study.yaml:3:1: cable: thickness_m given; a flat"),
    ("study.yaml", swap("width_m", "diameter_m"), "diameter_m alone"),
    ("study.yaml", swap("width_m: 0.016", "width_m: 16 mm"), "write the number alone"),
    ("study.yaml", swap("- 0.05", "- 0.2"), "markers.arc_length_m[1]: 0.2 m is not on the cable"),
    ("study.yaml", swap("- 0.05", "- -0.05"), "-0.05 m is not on the cable, 0 … 0.1 m"),
    ("study.yaml", swap("- 0.05", "- 0.1"), "markers cross or coincide"),
    ("study.yaml", with_std("5"), "arc_length_std_m: 5 m is beyond 0.002 m, 0.02 of the cable; me"),
    ("study.yaml", with_std("[0, 0, -0.001]"), "arc_length_std_m[2]: -0.001 m is negative; give 0"),
    ("study.yaml", with_std("[0.001, 0]"), "has 2 values for 3 markers; give one for each, or one"),
    ("study.yaml", with_std("wide"), "study.yaml:12:3: markers.arc_length_std_m"),
    ("study.yaml", swap("-9.81", "-9810"), "give m/s², not mm/s²"),
    (
        "study.yaml",
        swap("equilibrium", "equilibrium\n  hand_drift: {from_s: 0.4, to_s: 0.1}"),
        "hand_drift.to_s: 0.1 s is not after from_s, 0.4 s",
    ),
    ("study.yaml", swap("start: equilibrium", "start: straight"), "needs the time of letting go"),
    ("study.yaml", swap("equilibrium", "equilibrium\n  release_s: 0.1"), "only for `start: str"),
    ("study.yaml", swap("start: equilibrium", "start: held"), "needs the time of letting go"),
    ("study.yaml", swap("equilibrium", "moving\n  release_s: 0.1"), "only for `start: straight`"),
    *(
        (
            "study.yaml",
            swap("equilibrium", f"{start}\n  release_s: {release_s}"),
            f"trials[0].release_s: {release_s} s is outside the record, 0.00640592 … ",
        )
        for start in ("straight", "held")
        for release_s in (99, -1)
    ),
    ("study.yaml", swap("name: identify", "name: ../identify"), "trials[0].name: "),
    (
        "study.yaml",
        swap("name: identify", "name: Prüfung 1"),
        "write 'Prufung_1', and rename the folder",
    ),
    ("study.yaml", swap("cable:", "\tcable:"), "is not YAML"),
    ("study.yaml", swap("name: identify", "name: other"), "other/grip.csv:1:1: cannot be read"),
    ("identify/grip.csv", swap("angle_rad", "angle_deg"), "grip.csv:1: column angle_rad is miss"),
    ("identify/grip.csv", lines(lambda r: [f"{x},1" for x in r]), "grip.csv:1: 1: unknown column"),
    ("identify/grip.csv", cell(2, 3, "45"), "grip.csv:3: angle_rad: 45 is beyond ±2π"),
    ("identify/grip.csv", cell(2, 1, ""), "grip.csv:3: x_m: nan is not a number; the grip"),
    ("identify/grip.csv", lines(lambda r: [r[0], r[1], r[1]]), "grip.csv:3: t_s: "),
    ("identify/grip.csv", lines(lambda r: [r[0], r[2], r[1]]), "comes after"),
    ("identify/grip.csv", lines(lambda r: r[:2]), "has 1 row, needs at least 2"),
    ("identify/grip.csv", lambda text: text.replace(",", ";"), "separated by commas"),
    ("identify/markers.csv", cell(3, 2, "1,5"), "markers.csv:4: has 8 cells, the header has 7"),
    (
        "identify/markers.csv",
        lines(lambda r: [r[0] + ",", *(x + "," for x in r[1:-1]), r[-1] + ",late"]),
        "markers.csv:6: column 8: has no name, yet 'late' stands in it; empty it or name it",
    ),
    ("identify/markers.csv", cell(3, 2, "n/a"), "markers.csv:4: y0_m: 'n/a' is not a number"),
    ("identify/markers.csv", cell(3, 2, "inf"), "markers.csv:4: y0_m: inf is not finite"),
    ("identify/markers.csv", cell(3, 2, "-12.5"), "1.5 free lengths) from the gripping point"),
    (
        "identify/markers.csv",
        lines(lambda r: [r[0], *(x.split(",")[0] + "," * 6 for x in r[1:])]),
        "no marker is seen in any of 5 rows",
    ),
    (
        "identify/markers.csv",
        lines(lambda r: [r[0], *(f"{9 + i},0,0,0,0,0,0" for i in range(3))]),
        "without overlap; put both on one clock",
    ),
    ("identify/markers.csv", lines(lambda r: [x.rsplit(",", 2)[0] for x in r]), "x2_m is missing"),
]


@pytest.mark.parametrize(("file", "edit", "message"), MISTAKES, ids=[m[2][-28:] for m in MISTAKES])
def test_a_mistake_is_named_with_place_and_remedy(
    tmp_path: Path, file: str, edit: Edit, message: str
) -> None:
    write_study(study(), tmp_path)
    path = tmp_path / file
    path.write_text(edit(path.read_text(encoding="utf-8")), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_study(tmp_path)
    assert message in str(caught.value)
    assert f"{tmp_path}" in str(caught.value)


@pytest.mark.parametrize("edge", [",,", ", ,"])
def test_empty_columns_of_a_spreadsheet_are_no_columns(tmp_path: Path, edge: str) -> None:
    write_study(study(), tmp_path)
    for file in tmp_path.glob("*/*.csv"):
        header, *rows = file.read_text().splitlines()
        first, rest = header.split(",", 1)
        padded = [f"{first},,{rest}{edge}"]
        padded += [x.replace(",", ",,", 1) + (edge if i % 2 else "") for i, x in enumerate(rows)]
        file.write_text("\n".join(padded) + "\n")
    same(read_study(tmp_path), study())


def test_on_a_full_disk_the_former_study_stays(tmp_path: Path, full_disk: None) -> None:
    few, long = trial(), trial(rows=8, seed=1)  # of its tables only that of the markers is too long
    write_study(study(few), tmp_path / "study")
    with pytest.raises(OSError, match="too large"):
        write_study(study(long), tmp_path / "study")
    same(read_study(tmp_path / "study"), study(few))
    with pytest.raises(OSError, match="too large"):
        write_study(study(long), tmp_path / "new")
    assert [p.name for p in tmp_path.iterdir()] == ["study"]


def test_mistakes_in_several_trials_are_told_at_once(tmp_path: Path) -> None:
    write_study(study(trial("a"), trial("b")), tmp_path)
    for name in "ab":
        (tmp_path / name / "markers.csv").unlink()
    with pytest.raises(InputError) as caught:
        read_study(tmp_path)
    assert [p.path.parent.name for p in caught.value.problems] == ["a", "b"]


def test_a_spreadsheet_with_byte_order_mark_and_blank_lines_is_read(tmp_path: Path) -> None:
    write_study(study(), tmp_path)
    path = tmp_path / "identify" / "grip.csv"
    path.write_text("\ufeff" + path.read_text(encoding="utf-8") + "\n,,,\n", encoding="utf-8")
    same(read_study(tmp_path), study())


def test_a_cycle_stands_for_its_study_and_a_folder_of_cycles_is_told_what_to_name(
    tmp_path: Path,
) -> None:
    write_study(study(), tmp_path / "runs" / "one" / "study")
    assert study_folder(tmp_path / "runs" / "one") == tmp_path / "runs" / "one" / "study"
    assert study_folder(tmp_path / "runs" / "one" / "study").name == "study"
    assert study_folder(tmp_path / "runs" / "one" / "study" / "study.yaml").name == "study"
    with pytest.raises(InputError, match=r"is a file; give the folder that holds study\.yaml"):
        study_folder(next((tmp_path / "runs" / "one" / "study").glob("*/markers.csv")))
    with pytest.raises(InputError, match=r"holds recorded cycles, not a study; name one of them"):
        study_folder(tmp_path / "runs")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: text[: text[:-1].rindex("\n") + 1], "has 4 rows, 5 were recorded: "),
        (lambda text: text.replace("0.0", "0.1", 1), "was changed: "),
        (lambda text: "", "has 0 rows, 5 were recorded: "),
    ],
)
@pytest.mark.parametrize("file", ["grip.csv", "markers.csv"])
def test_a_recorded_table_is_as_it_was_written(tmp_path, change, said, file):
    """A cut at the end of a line, as a copy that was interrupted, is no shorter swing."""
    write_study(study(trial("a"), trial("b", seed=1)), tmp_path, recorded=True)
    same(read_study(tmp_path), study(trial("a"), trial("b", seed=1)))
    table = tmp_path / "b" / file
    table.write_text(change(table.read_text()))
    with pytest.raises(InputError) as refused:
        read_study(tmp_path)
    (problem,) = refused.value.problems
    assert problem.path == table
    assert problem.message.startswith(said)


def test_a_recorded_table_may_be_cut_on_purpose(tmp_path):
    """Neither a study without that entry nor one that a person made is held to it."""
    write_study(study(trial("a", rows=6)), tmp_path, recorded=True)
    header, markers = tmp_path / "study.yaml", tmp_path / "a" / "markers.csv"
    markers.write_text("".join(markers.read_text().splitlines(keepends=True)[:-1]))
    header.write_text(header.read_text().split("tables:")[0])
    assert len(read_study(tmp_path).trials[0].markers.t_s) == 5
    write_study(study(), tmp_path)
    assert "tables" not in header.read_text()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (study(trial("../away")), r"trials\[0\]\.name: '\.\./away' names a folder"),
        (study(trial(""), trial("b")), r"trials\[0\]\.name: '' names a folder"),
        (study(trial("a"), trial("a", seed=1)), r"trials\[1\]\.name: 'a' is also trial 1"),
        (
            study(replace(trial(), role="train")),
            r"trials\[0\]\.role: input should be 'fit' or 'validate' \(got 'train'",
        ),  # type: ignore[arg-type]
        (
            study(replace(trial(), start="rest")),
            r"trials\[0\]\.start: input should be 'equilibrium'.*got 'rest'",
        ),  # type: ignore[arg-type]
        (study(trial(markers=2)), r"xy_m has shape \(5, 2, 2\), needs \(5, 3, 2\)"),
        (replace(study(), cable=Cable(100, 0.0074, 0.016, 1e-4)), "give metres, not millimetres"),
        (replace(study(), trials=()), r"trials: "),
        (study(replace(trial(), start="held", release_s=99.0)), "release_s: 99 s is outside"),
    ],
)
def test_a_study_that_no_reader_accepts_is_not_written(
    wrong: Study, said: str, tmp_path: Path
) -> None:
    """`../away` was written outside the folder, and of two trials of one name one was kept."""
    with pytest.raises(ValueError, match=said):
        write_study(wrong, tmp_path / "study")
    assert not [*tmp_path.iterdir()]


def test_a_folder_may_be_given_as_text(tmp_path: Path) -> None:
    write_study(study(), str(tmp_path / "study"))
    same(read_study(tmp_path / "study"), study())
