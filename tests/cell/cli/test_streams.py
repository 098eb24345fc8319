"""Whatever standard output is, a command ends with the right code and without a traceback."""

from __future__ import annotations

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


def test_a_reader_that_goes_away_needs_no_message() -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as closed:
        done = subprocess.run(
            [*CELL, "schema"], stdout=closed, stderr=subprocess.PIPE, text=True, check=False
        )
    assert (done.returncode, done.stderr) == (1, "")


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_signs_that_a_terminal_lacks_become_plain_ones(tmp_path: Path, encoding: str) -> None:
    environment = os.environ | {"PYTHONIOENCODING": encoding}
    done = subprocess.run(
        [*CELL, "check", "-c", str(CONFIG)], env=environment, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr
    said = done.stdout.decode(encoding)
    assert ("0 … 40 mm" if encoding == "utf-8" else "0 ... 40 mm") in said
