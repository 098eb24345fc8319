"""Texts of messages, whatever their ending: InfluxDB's lines, JSON with topics, transforms.

source  InfluxDB, "Line protocol": measurement, tags, fields, and a time in nanoseconds, as in
        `cable,marker=m1,run=a x_mm=1.0,y_mm=2.0 1719403200437000000`
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from cell.study.imports.capture import number
from cell.study.imports.documents import form_in_text
from cell.study.imports.groups import Tree
from cell.study.imports.streams import streams_tree
from cell.study.imports.text_content import head_of, text_of
from cell.study.imports.transforms import holds_transforms

_PART = r"(?:\\.|[^,=\s\\])+"
_VALUE = r"(?:\"(?:\\.|[^\"\\])*\"|[^,\s\"]+)"
_LINE = re.compile(
    rf"({_PART})((?:,{_PART}={_PART})*)\s+({_PART}={_VALUE}(?:,{_PART}={_VALUE})*)\s+(-?\d+)"
)
_PAIR = re.compile(rf"({_PART})=({_VALUE})")
#: Lines to test at the start, and the fraction of them that must match the protocol.
_HEAD_LINES, _MIN_FRACTION = 100, 0.8


@dataclass(frozen=True)
class _Record:
    measurement: str
    tags: dict[str, str]
    fields: dict[str, float]
    time_ns: int


def is_of_messages(path: Path) -> bool:
    """Whether a file holds messages: lines of InfluxDB's protocol, JSON, or transforms."""
    return _is_of_influx(path) or form_in_text(path) in ("lines", "json") or holds_transforms(path)


def _is_of_influx(path: Path) -> bool:
    lines = [s for s in head_of(path).splitlines()[:_HEAD_LINES] if s and s[0] != "#"]
    count = sum(_LINE.fullmatch(line.strip()) is not None for line in lines)
    return count > 2 and count >= _MIN_FRACTION * len(lines)


def messages_tree(path: Path) -> tuple[Tree, dict[tuple[str, ...], str]]:
    """Series by run, measurement, and point with field, times in ns; or by topic and clock.

    A tag identifies runs if the time spans of its values do not overlap.  Other tags with several
    values name points.

    raises  InputError: the file cannot be read
    """
    if not _is_of_influx(path):
        return streams_tree(path)
    records = list(_records(text_of(path)[0]))
    spans = _spans(records)
    run_tags = [tag for tag, values in spans.items() if _consecutive(values)]
    point_tags = [tag for tag, values in spans.items() if tag not in run_tags and len(values) > 1]
    tables: dict[tuple[str, ...], list[_Record]] = {}
    for record in records:
        run = tuple(record.tags[tag] for tag in run_tags if tag in record.tags)
        tables.setdefault((*run, record.measurement), []).append(record)
    tree: Tree = {}
    units: dict[tuple[str, ...], str] = {}
    for key, group in sorted(tables.items(), key=lambda of: min(r.time_ns for r in of[1])):
        times = sorted({record.time_ns for record in group})
        row_of = {time: i for i, time in enumerate(times)}
        tree[*key, "time"] = np.array(times, dtype=np.int64)
        units[*key, "time"] = "ns"
        for record in group:
            point = " ".join(value for tag, value in record.tags.items() if tag in point_tags)
            for field, value in record.fields.items():
                name = (*key, f"{point} {field}".strip())
                series = tree.setdefault(name, np.full(len(times), np.nan))
                series[row_of[record.time_ns]] = value
    return tree, units


def _records(text: str) -> Iterator[_Record]:
    for line in text.splitlines():
        if (match := _LINE.fullmatch(line.strip())) is None:
            continue
        measurement, tags, fields, time = match.groups()
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
            by_value = spans.setdefault(tag, {})
            first, last = by_value.get(value, (record.time_ns, record.time_ns))
            by_value[value] = min(first, record.time_ns), max(last, record.time_ns)
    return spans


def _consecutive(spans: Mapping[str, tuple[int, int]]) -> bool:
    """Whether there are several time spans, none of which overlap."""
    ordered = sorted(spans.values())
    return len(ordered) > 1 and all(a[1] < b[0] for a, b in pairwise(ordered))
