"""Files of named series: LabVIEW's .tdms, Igor's texts of waves, Octave's texts of variables.

source  NI, "TDMS File Format Internal Structure": wf_increment, wf_start_offset, wf_start_time and
        unit_string of a channel
source  WaveMetrics, Igor Pro, "Igor Text File Format": WAVES, BEGIN, END, X and SetScale
source  GNU Octave, libinterp/octave-value: `save_ascii` of each type
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.study.imports.capture import number
from cell.study.imports.contents import HAND
from cell.study.imports.groups import Tree, Units, times_in
from cell.study.imports.text_content import head_of, text_of
from cell.study.imports.units import unit_of

#: Name of the times of a group without any.
_TIME = "time"


@dataclass(frozen=True, eq=False)
class Waveform:
    """A series (rows, …) with the times start + row · step; step None = it states no times.

    unit       of the values; empty = none is stated
    step_unit  of start and step; empty = none is stated
    """

    name: str
    values: NDArray[Any]
    unit: str = ""
    start: float = 0.0
    step: float | None = None
    step_unit: str = ""


def waveform_tree(groups: Mapping[tuple[str, ...], Sequence[Waveform]]) -> tuple[Tree, Units]:
    """Series by group and name, with the times that they state; and the units.

    The series of a group that differ in number, start or step of rows are in a group each, which
    is named after the gripper if a series of it is, else after the first series.
    """
    tree: Tree = {}
    units: Units = {}
    for group, waves in groups.items():
        scales: dict[tuple[Any, ...], list[Waveform]] = {}
        for wave in waves:
            scale = (len(wave.values), wave.start, wave.step, wave.step_unit)
            scales.setdefault(scale, []).append(wave)
        titles: Counter[str] = Counter()
        for (rows, start, step, unit), members in scales.items():
            key = group
            if len(scales) > 1:
                titles[title := _title(members)] += 1
                key = (*group, title if titles[title] == 1 else f"{title}_{titles[title]}")
            names: Tree = {(wave.name,): wave.values for wave in members}
            if step is not None and not times_in(names):
                tree[*key, _TIME] = start + step * np.arange(rows)
                units[*key, _TIME] = unit
            tree |= {(*key, wave.name): wave.values for wave in members}
            units |= {(*key, wave.name): wave.unit for wave in members}
    return tree, units


def _title(waves: Sequence[Waveform]) -> str:
    """A word for a gripper in a name of a series; else the name of the first."""
    words = (word for w in waves for word in re.findall(r"[^\W\d_]+", w.name.lower()))
    return next((word for word in words if word in HAND), waves[0].name)


# --- LabVIEW --------------------------------------------------------------------------------------

_STEP, _OFFSET, _START = "wf_increment", "wf_start_offset", "wf_start_time"
_SECOND = np.timedelta64(1, "s")


def tdms_tree(path: Path) -> tuple[Tree, Units]:
    """Channels by group and name, and numbers that file and groups state; and the units.

    Times begin at the earliest start of a waveform in the file.
    """
    import nptdms

    file = nptdms.TdmsFile.read(path)
    channels = {(g.name,): [c for c in g.channels() if len(c)] for g in file.groups()}
    starts = {
        (c.group_name, c.name): np.datetime64(c.properties[_START])
        for of_group in channels.values()
        for c in of_group
        if c.properties.get(_START) is not None
    }
    first = min(starts.values(), default=None)

    def waveform(channel: Any) -> Waveform:
        stated = channel.properties
        values, is_date = _numbers(channel[:])
        unit = "s" if is_date else unit_of(str(stated.get("unit_string", "")))
        if not float(stated.get(_STEP, 0.0)) > 0.0:
            return Waveform(channel.name, values, unit)
        began = starts.get((channel.group_name, channel.name), first)
        delay_s = 0.0 if began is None or first is None else float((began - first) / _SECOND)
        start = delay_s + float(stated.get(_OFFSET, 0.0))
        return Waveform(channel.name, values, unit, start, float(stated[_STEP]), "s")

    tree, units = waveform_tree({g: [waveform(c) for c in of] for g, of in channels.items()})
    facts = {(): file.properties} | {(g.name,): g.properties for g in file.groups()}
    for group, properties in facts.items():
        for name, value in properties.items():
            if isinstance(value, int | float | np.number):
                tree.setdefault((*group, name), np.asarray(value))
    return tree, units


def _numbers(values: NDArray[Any]) -> tuple[NDArray[Any], bool]:
    """Values of a channel, dates as seconds since 1970; and whether they are dates."""
    if values.dtype.kind != "M":
        return values, False
    return (values - np.datetime64(0, "s")) / _SECOND, True


# --- Igor -----------------------------------------------------------------------------------------

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


# --- Octave ---------------------------------------------------------------------------------------

_OCTAVE = re.compile(r"(?:#.*\n)*?# name: .*\n# type: ")
_VARIABLE = re.compile(r"^# name: (.*)$", re.MULTILINE)
_PROPERTY = re.compile(r"^# ([\w ]+): (.*)$", re.MULTILINE)


def is_octave_text(path: Path) -> bool:
    """Whether a file begins with the name and the type of a variable."""
    return _OCTAVE.match(head_of(path)) is not None


def octave_variables(path: Path) -> dict[str, Any]:
    """Variables by name; a structure, or what a cell holds, is a dictionary.

    raises  InputError: the file cannot be read.  ValueError: a variable has another number of
            values than its size says
    """
    _, *parts = _VARIABLE.split(text_of(path)[0])
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
