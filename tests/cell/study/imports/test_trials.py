"""Files of one study may have rates and forms of their own; each is read by its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.study.folder import read_study
from cell.study.imports.delimited import read_delimited
from cell.study.imports.mapping import read_mapping
from cell.study.imports.trials import unique_names
from tests.cell.study.imports.corpus.swing import RATE_HZ
from tests.cell.study.imports.corpus.text import nexus
from tests.cell.study.imports.made import CABLE, digits, made, run, text, two_files, wide_metres


def in_folder(folder: Path, name: str) -> Path:
    (folder / name).mkdir()
    return folder / name


def vicon(folder: Path) -> str:
    return str(nexus(replace(made(), name="vicon"), folder))


def at_rate(file: str, rate_hz: float) -> str:
    """The same rows, said to be taken at another rate."""
    lines = Path(file).read_text().splitlines()
    lines[1] = f"{rate_hz:g}"
    Path(file).write_text("\n".join(lines) + "\n")
    return file


def test_a_trial_is_named_in_plain_letters_after_its_file() -> None:
    labels = ["mätning 1", "mätning_1", "Øre", "%"]
    assert unique_names(labels) == ["matning_1", "matning_1_2", "re", "trial"]


def test_each_file_goes_by_the_rate_that_it_states(tmp_path: Path) -> None:
    """A third file of 250 rows a second was read at the 200 of the first: 1.25 times as slow."""
    files = [vicon(in_folder(tmp_path, name)) for name in "ab"]
    at_rate(files[1], 250.0)
    said = run(*files, "-o", str(tmp_path / "s"), *CABLE)
    assert "vicon.csv: time is in column 'Frame', 0.004 s a unit (250 rows a second" in said
    run(str(tmp_path / "s" / "import.yaml"))
    first, second = read_study(tmp_path / "s").trials
    last = len(made().t_s) - 1
    assert first.markers.t_s[-1] == pytest.approx(last / RATE_HZ)
    assert second.markers.t_s[-1] == second.grip.t_s[-1] == pytest.approx(last / 250.0)


def test_a_rate_that_the_mapping_has_otherwise_is_told(tmp_path: Path) -> None:
    file = vicon(tmp_path)
    run(file, "-o", str(tmp_path / "s"), *CABLE)
    at_rate(file, 250.0)
    said = run(str(tmp_path / "s" / "import.yaml"))
    assert "states 250 rows a second, the mapping makes 200" in said
    assert "seconds_per_unit: 0.004" in said


def test_a_rate_is_asked_for_where_one_file_has_none(tmp_path: Path) -> None:
    files = [vicon(in_folder(tmp_path, name)) for name in "ab"]
    for file in files:
        lines = Path(file).read_text().splitlines()
        Path(file).write_text("\n".join(lines[2:]) + "\n")
    run(*files, "-o", str(tmp_path / "s"), *CABLE, code=1)
    mapping = tmp_path / "s" / "import.yaml"
    own = mapping.read_text().replace("name: vicon,", "name: vicon, seconds_per_unit: 0.005,")
    mapping.write_text(own)
    assert "time.seconds_per_unit: is not known from the file" in run(str(mapping), code=2)
    mapping.write_text(own.replace("name: vicon_2,", "name: vicon_2, seconds_per_unit: 0.004,"))
    run(str(mapping))


def as_german(file: str) -> None:
    """The same table between semicolons, with decimal commas."""
    written = Path(file).read_text()
    Path(file).write_text(written.replace(",", ";").replace(".", ","))


def test_each_file_is_read_in_the_form_that_it_has(tmp_path: Path) -> None:
    """The proposal showed a second file of decimal commas; the next step held it for empty."""
    pairs = [two_files(made(), in_folder(tmp_path, name)) for name in "ab"]
    for number in (0, 2):
        as_german(pairs[1][number])
    hands = [word for pair in pairs for word in pair[1:3]]
    files = [pairs[0][0], pairs[1][0], *hands, "--rate", "200"]
    said = run(*files, "-o", str(tmp_path / "s"), *CABLE)
    assert "robot.csv: cells are separated by ';', the decimal mark is ','" in said
    run(str(tmp_path / "s" / "import.yaml"))
    first, second = read_study(tmp_path / "s").trials
    np.testing.assert_array_equal(first.markers.xy_m, second.markers.xy_m)
    np.testing.assert_array_equal(first.grip.angle_rad, second.grip.angle_rad)


def test_a_table_of_another_form_than_is_said_is_refused_for_this(tmp_path: Path) -> None:
    (file,) = wide_metres(made(), tmp_path)
    run(file, "-o", str(tmp_path / "s"), *CABLE)
    form = read_delimited(Path(file)).form
    as_german(file)
    mapping = tmp_path / "s" / "import.yaml"
    assert read_mapping(mapping).mapping.text is not None
    assert form != read_delimited(Path(file)).form
    said = run(str(mapping), code=2)
    assert "it seems to be one between ';' with ','" in said
    assert "text: {separator: ';', decimal: ','}" in said


def counted_rows(folder: Path, early_rows: int = 0) -> list[str]:
    """Markers at 200 rows a second, and a gripper whose file has no time and begins earlier."""
    m = made()
    markers, hand, *_ = two_files(m, folder)[::2]
    places = np.concatenate([np.repeat(m.gripper_m[:1], early_rows, axis=0), m.gripper_m])
    rows = [["TCP x [m]", "TCP y [m]"], *digits(places, 7)]
    Path(hand).write_text(text(rows))
    return [markers, "--hand", hand, "--rate", "200"]


def test_the_beginning_is_not_guessed_before_the_hand_s_times_are_known(tmp_path: Path) -> None:
    """The gripper rested for as many seconds as it had rows: the cable was said to be let go."""
    said = run(*counted_rows(tmp_path), "-o", tmp_path / "s", *CABLE, code=1)
    assert "let go" not in said and "Odd:" not in said
    assert "whether both clocks agree is not known before the gripper's path is" in said
    mapping = tmp_path / "s" / "import.yaml"
    written = mapping.read_text()
    mapping.write_text(written.replace("seconds_per_unit: null", "seconds_per_unit: 0.005"))
    assert "let go" not in run(mapping)
    assert read_study(tmp_path / "s").trials[0].start == "equilibrium"
    late = "start: held, release_s: 99,"
    mapping.write_text(mapping.read_text().replace("start: equilibrium,", late))
    assert "release_s: 99 s is outside the record" in run(mapping, "--force", code=2)
    held = "start: held, release_s: 0.4,"
    mapping.write_text(mapping.read_text().replace(late, held))
    said = run(mapping, "--force")
    assert "let go at 0.4 s, yet its gripper moves by 51 mm from 0.4" in said
    (note,) = read_study(tmp_path / "s").notes
    assert "yet its gripper moves by 51 mm" in note


@pytest.mark.parametrize(("early_rows", "word"), [(80, "subtract 0.4 s from"), (0, "add this to")])
def test_clocks_that_differ_are_refused_by_the_mapping_s_entries(
    early_rows: int, word: str, tmp_path: Path
) -> None:
    """It was a note, of a file that the study does not have yet."""
    run(*counted_rows(tmp_path, early_rows), "-o", tmp_path / "s", *CABLE, code=1)
    mapping = tmp_path / "s" / "import.yaml"
    written = mapping.read_text().replace("seconds_per_unit: null", "seconds_per_unit: 0.005")
    if not early_rows:
        written = written.replace("role: fit,", "role: fit, clock_offset_s: -0.35,")
    mapping.write_text(written)
    said = run(mapping, code=2)
    assert f"{word} clock_offset_s of the trial" in said
    assert "markers.csv" not in said.replace(f"{tmp_path}/markers.csv", "")
    if early_rows:
        mapping.write_text(written.replace("role: fit,", "role: fit, clock_offset_s: -0.4,"))
        run(mapping)


def test_a_folder_without_pictures_names_its_tables(tmp_path: Path) -> None:
    """Every folder was taken for a film."""
    assert "give files of measurements" in run(tmp_path, "-o", tmp_path / "s", code=2)
    for name in ("a.csv", "b.csv", "c.trc", "notes.doc"):
        (tmp_path / name).touch()
    said = run(tmp_path, "-o", tmp_path / "s", code=2)
    assert f"{tmp_path}: is a folder without pictures" in said
    assert f"give its files: {tmp_path}/*.csv {tmp_path}/*.trc" in said
    (tmp_path / "0001.PNG").touch()
    assert "a video needs --config and --hand" in run(tmp_path, "-o", tmp_path / "s", code=2)
