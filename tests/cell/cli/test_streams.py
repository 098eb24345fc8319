"""Whatever standard output is, a command ends with the right code and without a traceback."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

CONFIG = Path(__file__).parents[3] / "config" / "fake.yaml"
CELL = [sys.executable, "-c", "from cell.cli import main; main()"]


def test_a_full_disk_behind_the_output_is_said() -> None:
    with Path("/dev/full").open("w") as full:
        for command in (["schema"], ["check", "-c", str(CONFIG)], ["--help"]):
            done = subprocess.run(
                [*CELL, *command], stdout=full, stderr=subprocess.PIPE, text=True, check=False
            )
            assert done.returncode == 1
            assert done.stderr == "the output cannot be written: No space left on device\n"


def test_a_record_without_room_is_not_said_to_be_the_output() -> None:
    program = (
        "from cell.cli.streams import usable_streams\n"
        "from cell.records.folder import RecordError\n"
        "with usable_streams():\n    print('result')\n    raise RecordError('no room: x')"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (1, "result\n", "no room: x\n")


@pytest.mark.parametrize(
    ("command", "code"),
    [
        (["schema"], 0),
        (["--help"], 0),
        (["effects"], 0),
        (["effects", "--json"], 0),
        (["list", "."], 0),
        (["look", "none"], 2),
    ],
)
def test_a_reader_that_goes_away_changes_no_code(command: list[str], code: int) -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as closed:
        done = subprocess.run(
            [*CELL, *command], stdout=closed, stderr=subprocess.PIPE, text=True, check=False
        )
    assert (done.returncode, done.stderr.count("\n")) == (code, 1 if code else 0)


def test_the_code_of_a_result_that_nobody_reads_is_that_of_the_work() -> None:
    program = (
        "from cell.cli.output import deliver, print_json, show\n"
        "from cell.cli.streams import usable_streams\n"
        "with usable_streams():\n"
        "    {}\n    raise SystemExit(7)"
    )
    printing = ("show('result')", "print_json({})", "deliver(lambda: print('result'))")
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as closed:
        for printed in printing:
            command = [sys.executable, "-c", program.format(printed)]
            done = subprocess.run(command, stdout=closed, stderr=subprocess.PIPE, check=False)
            assert (done.returncode, done.stderr) == (7, b""), printed


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_signs_that_a_terminal_lacks_become_plain_ones(tmp_path: Path, encoding: str) -> None:
    environment = os.environ | {"PYTHONIOENCODING": encoding}
    done = subprocess.run(
        [*CELL, "check", "-c", str(CONFIG)], env=environment, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr
    said = done.stdout.decode(encoding)
    assert ("0 … 40 mm" if encoding == "utf-8" else "0 ... 40 mm") in said


CLOSED = "the output cannot be written: it is closed\n"


@pytest.mark.parametrize(
    ("command", "said", "code"),
    [
        (["--help"], CLOSED, 1),
        (["effects"], CLOSED, 1),
        (["check", "-c", "none.yaml"], "none.yaml:1:1: cannot be read: ", 2),
    ],
    ids=["unwatched", "watched", "refused"],
)
def test_a_closed_output_is_said(command: list[str], said: str, code: int) -> None:
    done = _behind(">&-", command)
    assert done.returncode == code
    assert done.stderr.startswith(said) and done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("errors", "given", "code"), [("2>&-", "none.yaml", 2), ("2>/dev/full", str(CONFIG), 0)]
)
def test_errors_that_nobody_hears_change_nothing(errors: str, given: str, code: int) -> None:
    done = _behind(errors, ["check", "-c", given])
    assert (done.returncode, bool(done.stdout)) == (code, code == 0)


@pytest.mark.parametrize("errors", ["2>&-", "2>/dev/full"])
def test_a_refusal_that_nobody_hears_has_its_code(errors: str) -> None:
    done = _behind(errors, ["list", "none"])
    assert (done.returncode, done.stdout) == (2, "")


def test_without_an_input_nothing_is_asked(tmp_path: Path) -> None:
    written = tmp_path / "cell.yaml"
    done = _behind("<&-", ["init", "-o", str(written)])
    assert (done.returncode, done.stderr) == (0, "")
    assert written.exists()


def _behind(redirection: str, command: list[str]) -> subprocess.CompletedProcess[str]:
    """A command as a shell starts it with some of its streams closed or full."""
    return subprocess.run(
        ["bash", "-c", f'"$@" {redirection}', "bash", *CELL, *command],
        capture_output=True,
        text=True,
        check=False,
    )


PRINTING = '''
from cell.cable.effects import Effect, Parameter

print("hello module")


class Pull(Effect):
    """Constant pull to the side, per metre."""

    name = "pull"
    parameters = (Parameter("pull_n_m", "N/m", -1.0, 1.0, 0.0, (5e-3,)),)

    def force(cable, at, p):
        print("hello hook")
        return p.pull_n_m, 0.0
'''


def test_what_an_own_effect_prints_is_no_part_of_the_json(tmp_path: Path) -> None:
    path = tmp_path / "pull.py"
    path.write_text(PRINTING)
    command = [*CELL, "effects", "--try", str(path), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["format"] == "cable-effects/1"
    assert "hello module" in done.stderr and "hello hook" in done.stderr
