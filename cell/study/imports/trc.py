"""TRC files of motion capture: five lines of header, then frame, time and places of markers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cell.files.input_error import InputError
from cell.files.text_file import read_text
from cell.study.imports.capture import Capture, CapturedColumn
from cell.study.imports.cells import number
from cell.study.imports.units import METRES, unit_of
from cell.study.table import MAX_BYTES

#: Keys that the second line may hold; the third has their values.
_KEYS = ("DataRate", "Units")


def read_trc(path: Path) -> Capture:
    """Read a TRC file: columns Frame, Time and X, Y, Z of every marker.

    raises  InputError: it is no TRC file, or a line is wrong
    source  OpenSim, "Marker (.trc) files"
    """
    lines = read_text(path, MAX_BYTES).splitlines()
    if len(lines) < 5 or not lines[0].startswith("PathFileType"):
        message = "is no TRC file: its first line does not begin with PathFileType"
        raise InputError.at(path, f"{message}; export it again")
    said = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    missing = [key for key in _KEYS if not said.get(key, "").strip()]
    if missing:
        message = f"{missing[0]} is not stated; add it to lines 2 and 3"
        raise InputError.at(path, message, line=2)
    rate_hz = number(said["DataRate"], ".")
    unit = unit_of(said["Units"])
    if rate_hz is None or not rate_hz > 0.0:
        message = f"DataRate {said['DataRate']!r} is no rate; give frames a second"
        raise InputError.at(path, message, line=3)
    if unit not in METRES:
        message = f"Units {said['Units']!r} is no length; give one of {', '.join(METRES)}"
        raise InputError.at(path, message, line=3)
    markers = [name.strip() for name in lines[3].split("\t")[2:] if name.strip()]
    twice = next((m for m in markers if markers.count(m) > 1), None)
    if twice is not None:
        message = f"{twice!r} names two markers; give each a name of its own"
        raise InputError.at(path, message, line=4)
    names = ["Frame", "Time", *(f"{m} {axis}" for m in markers for axis in "XYZ")]
    values, numbers = _rows(path, lines, names)
    units = ["", "s", *[unit] * (3 * len(markers))]
    columns = tuple(CapturedColumn(n, u) for n, u in zip(names, units, strict=True))
    return Capture(path, columns, values, numbers, rate_hz, unit)


def _rows(path: Path, lines: list[str], names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Values and line numbers of the rows below the header."""
    rows, numbers = [], []
    for line, text in enumerate(lines[5:], 6):
        cells = text.split("\t")
        while len(cells) > len(names) and not cells[-1].strip():
            cells.pop()
        if not any(c.strip() for c in cells):
            continue
        # Nothing at the end of a line: the last markers are not seen.
        cells += [""] * (len(names) - len(cells) if len(cells) > 1 else 0)
        if len(cells) != len(names):
            message = f"has {len(cells)} cells between tabs, the header names {len(names)} columns"
            raise InputError.at(path, f"{message}; mend the line", line=line)
        found = [number(c, ".") for c in cells]
        if None in found:
            bad = found.index(None)
            message = f"{cells[bad]!r} is not a number; give one, or nothing where nothing was seen"
            raise InputError.at(path, message, line=line, key=names[bad])
        rows.append(found)
        numbers.append(line)
    if not rows:
        message = "has no rows below its header; export it again"
        raise InputError.at(path, message, line=len(lines))
    return np.array(rows, dtype=np.float64), np.array(numbers, dtype=np.intp)
