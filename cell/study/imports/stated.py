"""What the user states about cable and files, and what the files themselves state."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cell.files.input_error import InputError
from cell.files.words import first_of
from cell.study.imports.capture import Capture, ImportFindings
from cell.study.imports.groups import Tree
from cell.study.imports.remarks import stated_pixel_m
from cell.study.imports.sheets import cell_text
from cell.study.imports.units import METRES, unit_of

#: Names of the cable's parameters that a file may state; maximum relative rounding error.
OF_CABLE = ("free_length_m", "line_density_kg_per_m", "width_m", "thickness_m", "diameter_m")
_ROUNDED = 0.02


@dataclass(frozen=True)
class Stated:
    """What the user states about cable and files; None = not stated.

    arc_lengths_m  of the markers, from the gripper on
    """

    name: str
    free_length_m: float | None = None
    line_density_kg_per_m: float | None = None
    width_m: float | None = None
    thickness_m: float | None = None
    diameter_m: float | None = None
    rate_hz: float | None = None
    clamp_angle_rad: float | None = None
    arc_lengths_m: tuple[float, ...] | None = None


def with_files(stated: Stated, captures: Sequence[Capture], findings: ImportFindings) -> Stated:
    """Add what files state about the cable where the user does not.

    findings  findings about it are added
    raises    InputError: a file contradicts the user or another file
    """
    for name in OF_CABLE:
        user_value = getattr(stated, name)
        known, source = user_value, f"--{name.rpartition('_m')[0] or name}"
        source = {"line_density_kg_per_m": "--line-density"}.get(name, source.replace("_", "-"))
        for capture in captures:
            value = dict(capture.of_cable).get(name)
            if value is None:
                continue
            if known is not None and abs(value - known) > _ROUNDED * known:
                message = f"states {name} {value:g}, {source} is {known:g}; correct one of them"
                raise InputError.at(capture.path, message)
            if known is None:
                known, source = value, capture.path.name
        if known is not None and user_value is None:
            stated = replace(stated, **{name: known})
            findings.stated(f"cable.{name}", f"{name} is {known:g}, as {source} says")
    return stated


#: Names of numbers that are rates, of units, and of lengths of pixels.
_RATE = re.compile(r"(frame_?rate|sampl(e|ing)_?rate|rate|frequency|freq|fps|fs)(_hz)?")
_UNIT = re.compile(r"(length_?)?units?")
_PIXEL = re.compile(r".*(_per_(px|pixel)|(px|pixels?)_per_).*")
#: Maximum number of names in a note.
_MAX_NAMES = 6


@dataclass(frozen=True)
class ArrayFacts:
    """Rate, unit of length, length of a pixel and cable of a file, as in its `Capture`."""

    rate_hz: float | None
    unit: str
    pixel_m: float | None
    of_cable: tuple[tuple[str, float], ...]


def facts_of(path: Path, arrays: Tree) -> tuple[ArrayFacts, list[str]]:
    """What the scalars of a file state, also those of texts of JSON; and notes on what is not read.

    raises  InputError: two lengths of a pixel are stated
    """
    scalars = {
        key[-1].lower(): cell_text(v.item()) if v.dtype.kind in "OUS" else v.item()
        for key, v in arrays.items()
        if v.size == 1
    }
    notes: list[str] = []
    for name, content in _objects(scalars).items():
        stated = {str(key).lower(): value for key, value in content.items()}
        others = [key for key in stated if not _is_known(key)]
        scalars = stated | scalars
        if others:
            shown = first_of(others, _MAX_NAMES)
            notes.append(f"{path}: {name} states {shown}, which is not read")
    numbers = {n: float(v) for n, v in scalars.items()
               if isinstance(v, int | float) and not isinstance(v, bool) and v > 0.0}  # fmt: skip
    pixels = [(1, (f"{n}: {v:.12g}",)) for n, v in numbers.items() if _PIXEL.fullmatch(n)]
    units = (unit_of(v) for n, v in scalars.items() if isinstance(v, str) and _UNIT.fullmatch(n))
    facts = ArrayFacts(
        next((v for n, v in numbers.items() if _RATE.fullmatch(n)), None),
        next((unit for unit in units if unit in METRES), ""),
        stated_pixel_m(path, pixels),
        tuple((name, numbers[name]) for name in OF_CABLE if name in numbers),
    )
    return facts, notes


def _is_known(name: str) -> bool:
    return name in OF_CABLE or any(form.fullmatch(name) for form in (_RATE, _UNIT, _PIXEL))


def _objects(scalars: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The objects that texts of JSON hold, by the texts' names."""
    objects = {}
    for name, text in scalars.items():
        if isinstance(text, str) and text.lstrip().startswith("{"):
            try:
                objects[name] = json.loads(text)
            except ValueError:  # a text that only begins like one
                continue
    return objects
