"""Series of steady rates, each with its own start and step, as tables with times."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.study.imports.contents import HAND
from cell.study.imports.groups import Tree, Units, times_in

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
