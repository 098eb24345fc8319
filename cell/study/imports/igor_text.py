"""Igor's text files of waves: blocks `WAVES … BEGIN … END`, and their scales.

source  WaveMetrics, Igor Pro, "Igor Text File Format": WAVES, BEGIN, END, X and SetScale
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cell.study.imports.capture import number
from cell.study.imports.groups import Tree, Units
from cell.study.imports.text_content import head_of, text_of
from cell.study.imports.units import unit_of
from cell.study.imports.waveforms import Waveform, waveform_tree

_FIRST = re.compile(r"\s*IGOR\s*[\r\n]")
_WAVES = re.compile(r"WAVES(?P<flags>(?:\s*/[A-Z]+(?:=\([^)]*\))?)*)\s+(?P<names>.+)", re.I)
_SIZES = re.compile(r"/N=\(([\d,\s]+)\)", re.I)
_TEXT_FLAG = re.compile(r"/T\b", re.I)
_NAME = re.compile(r"'[^']+'|[^\s,']+")
_CELL = re.compile(r"[,\s]+")
#: Of a dimension (x), or of the values (d, and y of waves of one dimension).
_SCALE = re.compile(
    r"SetScale\s*(?:/(?P<form>[PI]))?\s+(?P<of>[xyd])\s+(?P<first>[^,]+),(?P<second>[^,]+),"
    r"\s*\"(?P<unit>[^\"]*)\"\s*,(?P<names>[^;]+)",
    re.IGNORECASE,
)
#: Igor's unit of dates, which are seconds.
_DATE = "dat"


def is_igor_text(path: Path) -> bool:
    """Whether a file begins as Igor's text files do."""
    return _FIRST.match(head_of(path)) is not None


def igor_tree(path: Path) -> tuple[Tree, Units]:
    """The waves of all blocks, those of each scale in a group with its times; and the units.

    raises  InputError: the file cannot be read.  ValueError: a block is damaged
    """
    lines = list(enumerate(text_of(path)[0].splitlines(), 1))
    waves: dict[str, Waveform] = {}
    position = iter(lines)
    for line, text in position:
        text = text.strip()
        if match := _WAVES.fullmatch(text):
            names = [name.strip("'") for name in _NAME.findall(match["names"])]
            rows = list(_rows(position, line))
            if not _TEXT_FLAG.search(match["flags"]):
                values = _values(rows, len(names), _SIZES.search(match["flags"]))
                waves |= {n: Waveform(n, v) for n, v in zip(names, values, strict=True)}
        elif text[:1].upper() == "X":
            for scale in _SCALE.finditer(text):
                for name in (n.strip("'") for n in _NAME.findall(scale["names"])):
                    if name in waves:
                        waves[name] = _scaled(waves[name], scale)
    return waveform_tree({(): list(waves.values())})


def _rows(lines: Iterator[tuple[int, str]], first: int) -> Iterator[tuple[int, str]]:
    """The lines between BEGIN and END.  Raises ValueError: one of both is missing."""
    begins = next((text.strip() for _, text in lines if text.strip()), "")
    if begins.upper() != "BEGIN":
        raise ValueError(f"line {first}: no BEGIN follows WAVES")
    for line, text in lines:
        if text.strip().upper() == "END":
            return
        if text.strip():
            yield line, text
    raise ValueError(f"line {first}: no END follows BEGIN")


def _values(
    rows: list[tuple[int, str]], count: int, sizes: re.Match[str] | None
) -> list[NDArray[np.float64]]:
    """Values of the waves of a block; of a matrix, which is alone in it, row by row.

    raises  ValueError: a row is not of numbers, or has another number of them than the first
    """
    size = [int(n) for n in sizes[1].split(",")] if sizes else []
    width = size[1] if len(size) > 1 else count
    if len(size) > 2 or (len(size) == 2 and count != 1):
        raise ValueError("holds a wave of more than two dimensions; save its layers")
    table = np.full((len(rows), width), np.nan)
    for k, (line, text) in enumerate(rows):
        cells = text.strip("\r\n").split("\t")
        cells = cells[1:] if len(cells) > width and not cells[0].strip() else cells
        cells = cells if len(cells) == width else _CELL.split(text.strip())
        numbers = [number(cell, ".") for cell in cells]
        if len(numbers) != width or None in numbers:
            raise ValueError(f"line {line}: is no row of {width} numbers")
        table[k] = np.array(numbers, dtype=np.float64)
    return [table] if len(size) > 1 else list(table.T)


def _scaled(wave: Waveform, scale: re.Match[str]) -> Waveform:
    """A wave with a scale: of its rows, or of the unit of its values."""
    if scale["of"].lower() != "x":
        is_unit = scale["of"].lower() == "d" or wave.values.ndim == 1
        return replace(wave, unit=unit_of(scale["unit"])) if is_unit else wave
    first, second, count = float(scale["first"]), float(scale["second"]), len(wave.values)
    form = (scale["form"] or "").upper()
    if form != "P":  # the second is the end: of the last row, or of the one after it
        second = (second - first) / max(count - (form == "I"), 1)
    unit = "s" if scale["unit"] == _DATE else unit_of(scale["unit"])
    is_scaled = bool(unit) or (first, second) != (0.0, 1.0)
    return replace(wave, start=first, step=second, step_unit=unit) if is_scaled else wave
