"""A result is printed and its files are written, whichever of the two cannot be done."""

from __future__ import annotations

import errno
import json
import os
import signal
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from cell.cli import app
from cell.cli.output import deliver
from cell.files.atomic import write_atomic


def test_a_result_is_printed_before_its_files_are_written(tmp_path: Path) -> None:
    done: list[str] = []
    deliver(lambda: done.append("printed"), (tmp_path / "a", lambda path: done.append(path.name)))
    assert done == ["printed", "a"]


def test_what_cannot_be_printed_is_written(tmp_path: Path) -> None:
    def printed() -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        deliver(printed, (tmp_path / "a.txt", lambda path: write_atomic(path, "all")))
    assert (tmp_path / "a.txt").read_text() == "all"


def test_a_file_that_cannot_be_written_keeps_no_other_from_it(
    tmp_path: Path, full_disk: None, capsys: pytest.CaptureFixture[str]
) -> None:
    long, short = tmp_path / "long.txt", tmp_path / "short.txt"
    with pytest.raises(typer.Exit) as ended:
        deliver(
            lambda: print("result"),
            (long, lambda path: write_atomic(path, "x" * 5000)),
            (short, lambda path: write_atomic(path, "all")),
        )
    said = capsys.readouterr()
    assert (ended.value.exit_code, said.out) == (1, "result\n")
    assert said.err.startswith(f"{long}: cannot be written: File too large; ")
    assert [p.name for p in tmp_path.iterdir()] == ["short.txt"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_who_ends_the_printing_or_the_writing_gets_the_files(tmp_path: Path, number: int) -> None:
    def give() -> None:
        os.kill(os.getpid(), number)

    def write(path: Path) -> None:
        give()
        write_atomic(path, "all")

    former = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        deliver(lambda: None, (tmp_path / "b.txt", write))
        with pytest.raises(typer.Exit) as ended:
            deliver(give, (tmp_path / "a.txt", write))
    finally:
        for s, handler in former.items():
            signal.signal(s, handler)
    assert ended.value.exit_code == 128 + number
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.txt", "b.txt"]


def test_on_a_full_disk_a_table_is_printed(tmp_path: Path, full_disk: None) -> None:
    done = CliRunner().invoke(app, ["effects", "-o", str(tmp_path / "effects.json")])
    assert done.exit_code == 1
    assert "tip_mass" in done.stdout
    assert "cannot be written: File too large; make room there" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_on_a_full_disk_no_settings_are_begun(tmp_path: Path, full_disk: None) -> None:
    done = CliRunner().invoke(app, ["init", "-y", "-o", str(tmp_path / "cell.yaml")])
    assert done.exit_code == 2
    assert "cannot be written: File too large" in done.stderr
    assert list(tmp_path.iterdir()) == []


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
