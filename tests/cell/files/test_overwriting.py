"""A command overwrites what a command wrote, and what else there is only with --force."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from cell.cli import app
from cell.files.overwriting import check_distinct, check_new_study, check_output
from cell.files.page import page


@pytest.mark.parametrize(
    "text",
    [
        "",
        '{\n "format": "cable-individual/1",\n',
        '{"format": "cable-diagnosis/1"}',
        "format: cell-motion/1\n",
        '"""Law inferred from the residuals of study s."""\n',
        page(Path(), "page.html", "One of the program's pages"),
    ],
)
def test_what_commands_write_may_be_written_again(tmp_path: Path, text: str) -> None:
    path = tmp_path / "file"
    path.write_text(text)
    check_output(path)


@pytest.mark.parametrize(
    "text", ["format: cable-study/1\n", '{"format": "theirs/1"}', "t_s,x_m\n", '"""Mine."""\n']
)
def test_what_is_somebody_s_may_not(tmp_path: Path, text: str) -> None:
    path = tmp_path / "file"
    path.write_text(text)
    with pytest.raises(ValueError, match="was not written by this program; give another name, or"):
        check_output(path)
    check_output(path, force=True)
    with pytest.raises(ValueError, match="is a pipe or a device"):
        check_output(Path("/dev/null"), force=True)


def test_a_study_is_not_gathered_over_another_one(tmp_path: Path) -> None:
    (tmp_path / "study.yaml").write_text("format: cable-study/1\n")
    with pytest.raises(ValueError, match="holds a study already; give another folder, or --force"):
        check_new_study(tmp_path)
    check_new_study(tmp_path, force=True)
    with pytest.raises(ValueError, match="is a file; give the name of a folder"):
        check_new_study(tmp_path / "study.yaml")


def test_the_commands_harm_no_study(tmp_path: Path) -> None:
    header = tmp_path / "study.yaml"
    header.write_text("format: cable-study/1\n")
    for command in (
        ["fit", str(tmp_path), "-o", str(header)],
        ["diagnose", str(tmp_path), "--json", str(header)],
        ["discover", str(tmp_path), "-o", str(header)],
        ["suggest", str(tmp_path), "-o", str(header)],
        ["effects", "--json", str(header)],
        ["study", str(tmp_path), "-o", str(tmp_path)],
    ):
        done = CliRunner().invoke(app, command)
        assert done.exit_code == 2
        assert "--force" in done.stderr
        assert header.read_text() == "format: cable-study/1\n"
    listed = CliRunner().invoke(app, ["effects", "--json", str(header), "--force"])
    assert listed.exit_code == 0
    again = CliRunner().invoke(app, ["effects", "--json", str(header)])
    assert again.exit_code == 0


def test_two_results_in_one_file_are_refused(tmp_path: Path) -> None:
    """The second took the place of the first, without a word."""
    a, same = tmp_path / "a.json", tmp_path / "below" / ".." / "a.json"
    check_distinct([a, tmp_path / "b.json"])
    with pytest.raises(ValueError, match="is given for two results"):
        check_distinct([a, same])
