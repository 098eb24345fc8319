"""Octave's text files of variables, as `save -text` writes them.

source  GNU Octave, libinterp/octave-value: `save_ascii` of each type
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from cell.study.imports.text_content import head_of, text_of

_FIRST = re.compile(r"(?:#.*\n)*?# name: .*\n# type: ")
_NAME = re.compile(r"^# name: (.*)$", re.MULTILINE)
_PROPERTY = re.compile(r"^# ([\w ]+): (.*)$", re.MULTILINE)


def is_octave_text(path: Path) -> bool:
    """Whether a file begins with the name and the type of a variable."""
    return _FIRST.match(head_of(path)) is not None


def octave_variables(path: Path) -> dict[str, Any]:
    """Variables by name; a structure, or what a cell holds, is a dictionary.

    raises  InputError: the file cannot be read.  ValueError: a variable has another number of
            values than its size says
    """
    _, *parts = _NAME.split(text_of(path)[0])
    return dict(_variables(zip(parts[::2], parts[1::2], strict=True)))


def _variables(parts: Iterator[tuple[str, str]]) -> Iterator[tuple[str, Any]]:
    for name, text in parts:
        stated = dict(_PROPERTY.findall(text))
        if "struct" in stated["type"] or stated["type"] == "cell":
            length = stated.get("length") or int(stated["rows"]) * int(stated["columns"])
            yield name, dict(_variables(islice(parts, int(length))))
            continue
        try:
            yield name, _value(stated, [v for v in text.splitlines() if v and v[0] != "#"])
        except ValueError as error:
            raise ValueError(f"{name!r}: {error}") from error


def _value(stated: dict[str, str], lines: list[str]) -> Any:
    kind = stated["type"]
    if kind.endswith("string"):
        return "\n".join(lines)
    numbers = np.array([np.nan if v == "NA" else float(v) for v in " ".join(lines).split()])
    if kind.endswith("range"):
        base, limit, step = numbers[:3]
        return base + step * np.arange(int(np.floor((limit - base) / step + 1e-9)) + 1)
    if "ndims" in stated:  # column by column
        count = int(stated["ndims"])
        return numbers[count:].reshape(numbers[:count].astype(int), order="F")
    if "rows" in stated:
        return numbers.reshape(int(stated["rows"]), int(stated["columns"]))
    return numbers.squeeze()
