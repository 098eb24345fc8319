"""LabVIEW's .tdms: channels in groups, each with its unit and the times of its waveform.

source  NI, "TDMS File Format Internal Structure"; properties wf_increment, wf_start_offset,
        wf_start_time and unit_string of a channel
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.study.imports.groups import Tree, Units
from cell.study.imports.units import unit_of
from cell.study.imports.waveforms import Waveform, waveform_tree

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
