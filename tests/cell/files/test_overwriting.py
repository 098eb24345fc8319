"""A command overwrites what a command wrote, and what else there is only with --force."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from cell.cli import app
from cell.files.overwriting import (
    CommandLine,
    check_distinct,
    check_new_study,
    check_output,
)
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
        ["fit", str(tmp_path), "-o", str(header), "--force"],
        ["diagnose", str(tmp_path), "--json", str(header)],
        ["discover", str(tmp_path), "-o", str(header)],
        ["suggest", str(tmp_path), "-o", str(header)],
        ["effects", "--json", str(header)],
        ["study", str(tmp_path), "-o", str(tmp_path), "--force"],
    ):
        done = CliRunner().invoke(app, command)
        assert done.exit_code == 2
        assert "is read by this command" in done.stderr or "give another name" in done.stderr
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


MODEL = '{\n "format": "identified-cable/1"}'


@pytest.mark.parametrize("force", [[], ["--force"]], ids=["", "forced"])
@pytest.mark.parametrize(
    "command",
    [
        ["export", "m.json", "--to", "json", "-o", "m.json"],
        ["compare", "a", "--model", "m.json", "-o", "m.json"],
        ["compare", "a", "--model=m.json", "--report", "m.json"],
        ["diagnose", "a", "--prior", "m.json", "-o", "a/../m.json"],
        ["discover", "a", "--prior", "m.json", "-o", "law.py", "--json", "m.json"],
        ["suggest", "a", "--prior", "m.json", "-o", "m.json"],
        ["fit", "a", "--profile", "m.json", "--prior", "m.json"],
        ["fit", "--from", "m.json", "-o", "m.json"],
        ["identify", "--all", "m.json", "--csv", "m.json", "--force"],
        ["replay", "m.json", "--json", "m.json"],
        ["power", "a", "--try", "tip_mass", "--motion", "m.json", "-o", "m.json"],
    ],
    ids=lambda command: command[0],
)
def test_no_input_is_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: list[str], force: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a").mkdir()
    model = tmp_path / "m.json"
    model.write_text(MODEL)
    done = CliRunner().invoke(app, [*command, *force])
    assert (done.exit_code, model.read_text()) == (2, MODEL)
    assert "m.json: is read by this command; give the result another name" in done.stderr


@pytest.mark.parametrize(
    ("command", "why"),
    [
        (["power", "a", "--try", "tip_mass=2e-6", "-o", "m.json"], "a result of another kind"),
        (["fit", "a", "-o", "a/report.html"], "a result of another kind"),
        (["fit", "a", "-o", "cycle/model.json"], "is part of a cycle's record; give another name"),
        (["fit", "a", "-o", "a/t.csv", "--force"], "this command reads its folder"),
        (["fit", "cycle", "-o", "cycle/model.json", "--force"], "this command reads its folder"),
        (["look", "a", "--json", "m.json"], "a result of another kind"),
    ],
)
def test_what_another_command_wrote_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: list[str], why: str
) -> None:
    monkeypatch.chdir(tmp_path)
    texts = {
        "m.json": MODEL,
        "a/study.yaml": "format: cable-study/1\n",
        "a/t.csv": "t_s,x_m\n",
        "a/report.html": page(Path(), "page.html", "A report"),
        "cycle/state.json": "{}",
        "cycle/model.json": MODEL,
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 2
    assert why in done.stderr
    assert {name: (tmp_path / name).read_text() for name in texts} == texts
    for own in ("m.json", "a/model.json"):  # the same command may write it again
        Path(own).write_text(MODEL)
        check_output(Path(own), command=CommandLine("fit", ["a", "-o", own]))


def test_a_bundle_is_written_again(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    command = ["bundle", "--runs", str(tmp_path / "runs"), "-n", "0"]
    command += ["-o", str(tmp_path / "b.zip")]
    assert [CliRunner().invoke(app, command).exit_code for _ in range(2)] == [0, 0]
    (tmp_path / "b.zip").write_bytes(b"PK\x03\x04 and no more")
    assert "not written by this program" in CliRunner().invoke(app, command).stderr
