"""What single numbers and texts of a file of arrays state of all its arrays."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cell.files.words import first_of
from cell.study.imports.groups import Tree
from cell.study.imports.remarks import stated_pixel_m
from cell.study.imports.sheets import cell_text
from cell.study.imports.stated import OF_CABLE
from cell.study.imports.units import METRES, unit_of

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
