"""Line protocol of measurements: `cable,marker=m1,run=a x_mm=1.0,y_mm=2.0 1719403200437000000`.

source  InfluxDB, "Line protocol": measurement, tags, fields, and a time in nanoseconds
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from cell.study.imports.capture import number
from cell.study.imports.groups import Tree
from cell.study.imports.text_content import text_of

_PART = r"(?:\\.|[^,=\s\\])+"
_VALUE = r"(?:\"(?:\\.|[^\"\\])*\"|[^,\s\"]+)"
_LINE = re.compile(
    rf"({_PART})((?:,{_PART}={_PART})*)\s+({_PART}={_VALUE}(?:,{_PART}={_VALUE})*)\s+(-?\d+)"
)
_PAIR = re.compile(rf"({_PART})=({_VALUE})")
#: Lines of the beginning that are looked at, and the share of them that must be of the protocol.
_HEAD_BYTES, _LOOKED_AT, _SHARE = 1 << 15, 100, 0.8


@dataclass(frozen=True)
class _Record:
    measurement: str
    tags: dict[str, str]
    fields: dict[str, float]
    time_ns: int


def is_line_protocol(path: Path) -> bool:
    """Whether a text holds lines of the protocol."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES).decode("utf-8-sig", errors="replace")
    except OSError:  # whoever reads it says why
        return False
    lines = [s for s in head.splitlines()[:_LOOKED_AT] if s and s[0] != "#"]
    count = sum(_LINE.fullmatch(line.strip()) is not None for line in lines)
    return count > 2 and count >= _SHARE * len(lines)


def line_protocol_tree(path: Path) -> tuple[Tree, dict[tuple[str, ...], str]]:
    """Series by run, measurement, and point with field; their times are in ns.

    A tag is a run's if no two of its values have times in common; else it names points, unless it
    has one value only.

    raises  InputError: the file cannot be read
    """
    records = list(_records(text_of(path)[0]))
    spans = _spans(records)
    runs = [tag for tag, of_tag in spans.items() if _follow(of_tag)]
    names = [tag for tag, of_tag in spans.items() if tag not in runs and len(of_tag) > 1]
    tables: dict[tuple[str, ...], list[_Record]] = {}
    for record in records:
        run = tuple(record.tags[tag] for tag in runs if tag in record.tags)
        tables.setdefault((*run, record.measurement), []).append(record)
    tree: Tree = {}
    units: dict[tuple[str, ...], str] = {}
    for key, found in sorted(tables.items(), key=lambda of: min(r.time_ns for r in of[1])):
        times = sorted({record.time_ns for record in found})
        place = {time: i for i, time in enumerate(times)}
        tree[*key, "time"] = np.array(times, dtype=np.int64)
        units[*key, "time"] = "ns"
        for record in found:
            point = " ".join(value for tag, value in record.tags.items() if tag in names)
            for field, value in record.fields.items():
                name = (*key, f"{point} {field}".strip())
                series = tree.setdefault(name, np.full(len(times), np.nan))
                series[place[record.time_ns]] = value
    return tree, units


def _records(text: str) -> Iterator[_Record]:
    for line in text.splitlines():
        if (found := _LINE.fullmatch(line.strip())) is None:
            continue
        measurement, tags, fields, time = found.groups()
        values = {_bare(k): number(v.rstrip("iu"), ".") for k, v in _PAIR.findall(fields)}
        numbers = {k: v for k, v in values.items() if v is not None}
        if numbers:
            labels = {_bare(k): _bare(v) for k, v in _PAIR.findall(tags)}
            yield _Record(_bare(measurement), labels, numbers, int(time))


def _bare(text: str) -> str:
    return re.sub(r"\\(.)", r"\1", text)


def _spans(records: Sequence[_Record]) -> dict[str, dict[str, tuple[int, int]]]:
    """First and last time of every value of every tag, ns."""
    spans: dict[str, dict[str, tuple[int, int]]] = {}
    for record in records:
        for tag, value in record.tags.items():
            of_tag = spans.setdefault(tag, {})
            first, last = of_tag.get(value, (record.time_ns, record.time_ns))
            of_tag[value] = min(first, record.time_ns), max(last, record.time_ns)
    return spans


def _follow(spans: Mapping[str, tuple[int, int]]) -> bool:
    """Whether values follow one another in time."""
    each = sorted(spans.values())
    return len(each) > 1 and all(a[1] < b[0] for a, b in pairwise(each))
