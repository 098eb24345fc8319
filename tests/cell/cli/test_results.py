"""--json prints a result and -o writes it, both at once too, in every command that has a result."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cell.cli import app

EVERYWHERE = ["fit", "compare", "diagnose", "effects", "discover", "suggest", "power", "identify"]


@pytest.mark.parametrize("command", EVERYWHERE)
def test_every_command_of_the_lab_has_both(command: str) -> None:
    words = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "200"}).stdout
    assert "--json" in words and "--out" in words and "-o" in words and "--force" in words


def test_printed_and_written_at_once_are_the_same(tmp_path: Path) -> None:
    path = tmp_path / "effects.json"
    done = CliRunner().invoke(app, ["effects", "--json", "-o", str(path)])
    assert done.exit_code == 0
    assert json.loads(done.stdout) == json.loads(path.read_text())
    old = CliRunner().invoke(app, ["effects", "--json", str(tmp_path / "old.json")])
    assert old.exit_code == 0
    assert json.loads((tmp_path / "old.json").read_text()) == json.loads(done.stdout)


def test_what_the_program_did_not_write_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "mine.txt"
    path.write_text("mine")
    done = CliRunner().invoke(app, ["identify", str(tmp_path), "-o", str(path)])
    assert (done.exit_code, path.read_text()) == (2, "mine")
    assert str(path) in done.stderr and "--force" in done.stderr
