"""What is wrong with a file or a mapping is refused with file, line, value and remedy."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from shutil import copytree

import pytest
from typer.testing import CliRunner

from cell.cli import app
from tests.cell.study.imports.made import CABLE, long_table, made, run, wide_metres

Lines = list[str]


def cell(line: int, column: int, value: str) -> Callable[[Lines], Lines]:
    """Another content of a cell; lines count from 1, columns from 0."""

    def edit(lines: Lines) -> Lines:
        cells = lines[line - 1].split(",")
        cells[column] = value
        return [*lines[: line - 1], ",".join(cells), *lines[line:]]

    return edit


def every(column: int, change: Callable[[int, float], float]) -> Callable[[Lines], Lines]:
    """Other numbers in a column: of the row's number, from 0, and the number that stands there."""

    def edit(lines: Lines) -> Lines:
        rows = [line.split(",") for line in lines[1:]]
        for k, row in enumerate(rows):
            row[column] = repr(change(k, float(row[column])))
        return [lines[0], *(",".join(row) for row in rows)]

    return edit


def both(*edits: Callable[[Lines], Lines]) -> Callable[[Lines], Lines]:
    def edit(lines: Lines) -> Lines:
        for one in edits:
            lines = one(lines)
        return lines

    return edit


def exchanged(lines: Lines) -> Lines:
    """From line 150 on the tip and the marker before it have each other's numbers."""
    rows = [line.split(",") for line in lines]
    for row in rows[149:]:
        row[4:6], row[6:8] = row[6:8], row[4:6]
    return [",".join(row) for row in rows]


def lost_hand(lines: Lines) -> Lines:
    """The gripper is not seen while it goes down."""
    rows = [line.split(",") for line in lines]
    for row in rows[90:130]:
        row[1:4] = ["", "", ""]
    return [",".join(row) for row in rows]


def renamed(old: str, new: str) -> Callable[[Lines], Lines]:
    return lambda lines: [lines[0].replace(old, new), *lines[1:]]


#: Columns: t_s, hand_x_m, hand_y_m, hand_angle_rad, tip_x_m, tip_y_m, m4_x_m …
MALFORMED: list[tuple[str, Callable[[Lines], Lines], str, str]] = [
    ("back in time", lambda x: [*x[:50], x[60], *x[50:]], "trial.csv:52", "times must rise"),
    (
        "two rows of one time",
        lambda x: [*x[:50], x[49].replace(",0", ",1", 1), *x[50:]],
        "trial.csv:51",
        "remove what is there",
    ),
    (
        "a recording again",
        lambda x: [*x, *x[1:]],
        "trial.csv:362",
        "another recording begins here: save each in a file of its own",
    ),
    ("a word", cell(40, 5, "abc"), "trial.csv:40", "'abc' is not a number"),
    ("a unit in a cell", cell(40, 5, "12 mm"), "trial.csv:40", "its unit in the column's name"),
    ("a decimal comma", cell(40, 5, "0,05"), "trial.csv:40", "no separator within a number"),
    ("thousands", cell(40, 5, '"1,234"'), "trial.csv:40", "separators of thousands"),
    ("a short row", lambda x: [*x[:20], "0.1,0.2", *x[21:]], "trial.csv:21", "one for each column"),
    ("a remark", lambda x: [*x[:20], "lost the tip here", *x[20:]], "trial.csv:21", "remove"),
    ("too few names", renamed("t_s,hand_x_m,", ""), "trial.csv:1", "give one name for each"),
    ("names of rows", lambda x: [x[0], *(f'"{k}",{r}' for k, r in enumerate(x[1:]))], "trial.csv:1",
     "row.names = FALSE"),
    ("no names", lambda x: x[1:], "trial.csv:1", "put a line of names there"),
    ("a name twice", renamed("m4_x_m", "tip_x_m"), "trial.csv:1", "a name of its own"),
    ("no time", cell(30, 0, ""), "trial.csv:30", "every row needs its time"),
    ("no points", lambda x: [",".join("abcdefghijklmn"), *x[1:]], "trial.csv:2", "tip_x and tip_y"),
    ("no numbers", lambda x: ["nothing", "here"], "trial.csv:1", "a line of names and numbers"),
    ("milliseconds as s", every(0, lambda _, v: 1e3 * v), "trial.csv:361", "seconds_per_unit"),
    ("degrees as rad", every(3, lambda _, v: 57.3 * v), "trial.csv", "0.0174533 for degrees"),
    ("exchanged", exchanged, "trial.csv:150", "exchange the columns of the two"),
    ("the gripper lost", lost_hand, "trial.csv:131", "cut the trial before it or after it"),
    (
        "one marker as two",
        lambda x: [",".join([*r.split(",")[:6], *r.split(",")[4:6], *r.split(",")[8:]]) if k else r
                   for k, r in enumerate(x)],
        "trial.csv:2",
        "remove the columns of one",
    ),
    (
        "a marker that jumps",
        every(4, lambda k, v: v + 0.06 * (k % 3 == 0)),
        "trial.csv:2",
        "a marker jumps or is named wrongly",
    ),
    (
        "a marker that slips too often",
        every(6, lambda k, v: v + 0.004 * (k % 25 == 25 // 2)),
        "trial.csv:14",
        "mend how the marker is tracked",
    ),
    (
        "millimetres as m",
        both(*(every(c, lambda _, v: 1e3 * v) for c in (1, 2, *range(4, 14)))),
        "import.yaml:",
        "give 0.001 for millimetres",
    ),
    (
        "the cable beyond the gripper",
        both(*(every(c, lambda _, v: v + 0.1) for c in range(4, 14, 2))),
        "import.yaml:",
        "is not on the cable",
    ),
]  # fmt: skip


def refused(file: Path, *more: str) -> str:
    """What the command that refuses it says; the first where it can, else the second."""
    runner = CliRunner()
    folder = file.parent / "study"
    proposed = runner.invoke(app, ["import", str(file), "-o", str(folder), *CABLE, *more])
    if proposed.exit_code == 2:
        assert not folder.exists(), "nothing is written of a file that cannot be read"
        return proposed.output
    written = runner.invoke(app, ["import", str(folder / "import.yaml")])
    assert written.exit_code == 2, proposed.output + written.output
    assert not (folder / "study.yaml").exists()
    return written.output


@pytest.mark.parametrize(
    ("edit", "place", "remedy"), [m[1:] for m in MALFORMED], ids=[m[0] for m in MALFORMED]
)
def test_a_malformed_table_is_refused_with_line_and_remedy(
    edit: Callable[[Lines], Lines], place: str, remedy: str, tmp_path: Path
) -> None:
    (name,) = wide_metres(made(), tmp_path)
    file = Path(name)
    file.write_text("\n".join(edit(file.read_text().splitlines())) + "\n")
    said = refused(file)
    assert re.search(re.escape(place) + r"\d*\b", said), said
    assert remedy in said.replace("\n", " "), said


def test_decimal_commas_that_are_not_quoted_are_told_as_such(tmp_path: Path) -> None:
    file = tmp_path / "trial.csv"
    rows = [f"{k},{k}0,5,{k}1,5" for k in range(20)]
    file.write_text("\n".join(["frame,tip_x,tip_y", *rows]) + "\n")
    assert "quote decimal commas" in refused(file)


def test_a_preview_is_there_of_what_is_refused(tmp_path: Path) -> None:
    (name,) = wide_metres(made(), tmp_path)
    file = Path(name)
    file.write_text("\n".join(exchanged(file.read_text().splitlines())) + "\n")
    assert "To be mended:" in run(name, "-o", tmp_path / "s", *CABLE, code=1)
    preview = (tmp_path / "s" / "preview.html").read_text()
    assert "To be mended" in preview
    assert "as proposed, before it is written" in preview, "it stays when the study is written"


@pytest.mark.parametrize(
    ("name", "content", "remedy"),
    [
        ("trial.numbers", b"PK\x03\x04\x14\0", "give .csv"),
        ("trial.ods", b"PK\x03\x04\x14\0", "save it again"),
        ("trial.db", b"SQLite format 3\0", "save it again"),
        ("trial.xlsx", b"PK", "save it again"),
        ("trial.c3d", b"\x02\x50" + b"\0" * 600, "export it again"),
        ("trial.mcap", b"\x89MCAP0\r\nxx", "record it again"),
        ("trial.trc", b"PathFileType\t4\nDataRate\tUnits\n100\t\n\n\n", "add it to lines 2 and 3"),
        ("trial.csv", b"t;Gr\x81\x8d\xe1e", "save it as UTF-8"),  # of no code page of Windows
        ("trial.csv", b"", "a line of names and numbers"),
    ],
)
def test_a_file_of_no_known_kind_is_refused(
    name: str, content: bytes, remedy: str, tmp_path: Path
) -> None:
    file = tmp_path / name
    file.write_bytes(content)
    assert remedy in refused(file)


def test_a_long_table_with_a_marker_twice_at_one_time_is_refused(tmp_path: Path) -> None:
    (name,) = long_table(made(), tmp_path)
    file = Path(name)
    lines = file.read_text().splitlines()
    other = lines[39].replace(",-", ",")  # once more, with other places
    file.write_text("\n".join([*lines[:40], other, *lines[40:]]) + "\n")
    said = refused(file)
    assert "long.csv:41" in said
    assert "first in line 40" in said


@pytest.fixture(scope="module")
def proposed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a file, and in `s` the mapping that is proposed for it."""
    folder = tmp_path_factory.mktemp("proposed")
    (name,) = wide_metres(made(), folder)
    run(name, "-o", folder / "s", *CABLE)
    return folder


@pytest.mark.parametrize(
    ("old", "new", "key", "remedy"),
    [
        ("right: [1.0, 0.0]", "right: [0.5, 0.0]", "axes.right", "has length 0.5"),
        ("right: [1.0, 0.0]", "right: [0.0, 1.0]", "axes.up", "give directions at a right angle"),
        ("right: [1.0, 0.0]", "right: [1.0, 0.0, 0.0]", "axes.right", "one for each column"),
        ("right: [1.0, 0.0]", "right: [-1.0, 0.0]", "trial.csv:2", "change the sign of x_m"),
        ("up: [0.0, 1.0]", "upp: [0.0, 1.0]", "axes.upp", "did you mean 'up'?"),
        ("tip_x_m, tip_y_m", "tip_x, tip_y_m", "trial.csv", "did you mean 'tip_x_m'?"),
        ("width_m: 0.016, ", "", "cable", "diameter_m of a round one"),
        ("metres_per_unit: 1.0", "metres_per_unit: 0.001", "metres_per_unit", "give 1,"),
        ("metres_per_unit: 1.0", "metres_per_unit:", "metres_per_unit", "give 0.001 for milli"),
        ("radians_per_unit: 1.0", "radians_per_unit: 60.0", "hand_angle_rad", "limit ±2π"),
        ("column: hand_angle_rad, radians_per_unit: 1.0", "offset_rad: 0.1", "hand.angle",
         "give one of constant_rad"),
        ("file: ../trial.csv", "file: ../trial2.csv", "trial2.csv", "check the name"),
    ],
)  # fmt: skip
def test_a_mapping_that_is_wrong_or_contradicts_the_file_is_refused(
    old: str, new: str, key: str, remedy: str, proposed: Path, tmp_path: Path
) -> None:
    copytree(proposed, tmp_path, dirs_exist_ok=True)
    mapping = tmp_path / "s" / "import.yaml"
    text = mapping.read_text()
    assert old in text, text
    mapping.write_text(text.replace(old, new))
    said = run(mapping, code=2)
    assert key in said and remedy in said, said


def test_what_only_a_person_knows_is_asked_for_at_its_place(tmp_path: Path) -> None:
    (name,) = wide_metres(made(), tmp_path)
    assert "To be filled in:" in run(name, "-o", tmp_path / "s", code=1)
    said = run(tmp_path / "s" / "import.yaml", code=2)
    assert re.search(r"import\.yaml:\d+:\d+: cable\.line_density_kg_per_m: .*weigh a piece", said)
    assert re.search(r"import\.yaml:\d+:\d+: cable: .*diameter_m of a round one", said)
