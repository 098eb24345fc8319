"""A user's own check is read from a file, and refused with file, line and remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

from cell.files.input_error import InputError
from cell.lab.data.check import read_own_checks
from cell.workers.shipping import pack, unpack

CHECK = '''"""Is the tip as noisy as the rest?"""

import numpy as np


def statistic(residuals):
    return sum(np.nanmean(r.white[:, 0] ** 2) for r in residuals)
'''


def written(folder: Path, text: str, name: str = "tip.py") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_a_check_has_the_name_of_its_file_and_asks(tmp_path: Path) -> None:
    (check,) = read_own_checks([written(tmp_path, CHECK)])
    assert (check.name, check.question, check.line) == (
        "tip",
        "Is the tip as noisy as the rest?",
        6,
    )
    assert check.of([]) == 0.0


def test_a_check_goes_to_a_worker_without_its_file(tmp_path: Path) -> None:
    (check,) = read_own_checks([written(tmp_path, CHECK)])
    packed = pack(check)
    check.file.unlink()
    again = unpack(packed)
    assert (again.name, again.question, again.line) == (check.name, check.question, check.line)
    assert again.of([]) == 0.0


@pytest.mark.parametrize(
    ("text", "place", "said"),
    [
        ("def statistic(r): return 1.0", ":1: docstring", "must ask a question"),
        ('"""A tip."""\ndef statistic(r): return 1.0', ":1: docstring", "must ask a question"),
        ('"""A tip?"""\n', ":1: statistic", "is missing; write a function"),
        ('"""A tip?"""\ndef statistic(r):', ":2: file", "is not Python"),
        ('"""A tip?"""\n1 / 0\ndef statistic(r): return 1.0', ":2: file", "ZeroDivisionError"),
        ('"""A tip?"""\nexit()\ndef statistic(r): return 1.0', ":2: file", "SystemExit"),
    ],
)
def test_what_is_no_check_is_refused(text: str, place: str, said: str, tmp_path: Path) -> None:
    path = written(tmp_path, text)
    with pytest.raises(InputError, match=said) as caught:
        read_own_checks([path])
    assert f"{path}{place}" in str(caught.value)


@pytest.mark.parametrize(
    ("body", "line", "said"),
    [
        ("return residuals[0].whyte", 5, "AttributeError|IndexError"),
        ("return None", 4, "TypeError"),
        ("return float('nan')", 4, "gives nan; give a number for every study"),
    ],
)
def test_a_statistic_that_fails_is_told_with_its_line(
    body: str, line: int, said: str, tmp_path: Path
) -> None:
    text = f'"""A tip?"""\n\n\ndef statistic(residuals):\n    {body}\n'
    (check,) = read_own_checks([written(tmp_path, text)])
    with pytest.raises(InputError, match=said) as caught:
        check.of([])
    assert f"tip.py:{line}: statistic" in str(caught.value)


def test_names_are_taken_once(tmp_path: Path) -> None:
    path = written(tmp_path, CHECK)
    with pytest.raises(InputError, match="'tip' is taken; rename the file"):
        read_own_checks([path, path])
    with pytest.raises(InputError, match="'ties' is taken"):
        read_own_checks([written(tmp_path, CHECK, "ties.py")], ["ties"])
    with pytest.raises(FileNotFoundError, match=r"none\.py: no such file"):
        read_own_checks([tmp_path / "none.py"])
    with pytest.raises(InputError, match="must be a Python file"):
        read_own_checks([written(tmp_path, CHECK, "tip.txt")])
