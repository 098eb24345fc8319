"""Structured documents as records of numbers: JSON, JSON lines, XML, YAML of OpenCV and ROS."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError
from cell.files.text_file import read_text
from cell.study.imports.capture import CapturedColumn, number
from cell.study.imports.text_content import head_of
from cell.study.imports.units import split_unit
from cell.study.table import MAX_BYTES, MAX_ROWS

#: Axes by the size of an array's last dimension: positions, or quaternions.
AXES = {2: "xy", 3: "xyz", 4: "xyzw"}
#: Keys of a record that identify its point.
_LABELS = ("name", "label", "id", "child_frame_id", "marker_id", "tag_id")
#: Name of the corners of a tag, whose mean is its place.
CORNERS = re.compile(r"(?:.* )?corners")
_MAX_DEPTH, FEWEST_RECORDS = 8, 3
#: OpenCV's first line, which is no YAML, its matrices, and its word for no number.
_OF_OPENCV = re.compile(r"%YAML:[\d.]+")
_TAG, _NAN = re.compile(r"!!opencv-\S+"), re.compile(r"\.Nan\b")
_DECLARATION = re.compile(r"<\?.*?\?>", re.DOTALL)
#: Entries of a mapping of this program.
_OF_MAPPING = re.compile(r"^(format|trials) *:", re.MULTILINE)

#: A message in a line: perhaps its topic, and JSON; the least share of such lines in a
#: text; and a topic with another payload.
_MESSAGE = re.compile(r"(?:(?P<topic>[^\s{}\[\]\",;]+)\s+)?(?P<content>\{.*\})")
_MOST_LINES = 0.5
_OTHER_PAYLOAD = re.compile(r"[^\s{}\[\]\",;]+\s+[^{]*")
#: First line and entry of each document of a YAML text after the first; an entry of a transform.
_NEXT_YAML = re.compile(r"^---[ \t]*\n[A-Za-z_]\w*:\s", re.MULTILINE)
_YAML_FRAME = re.compile(r"^[ -]*child_frame_id:\s", re.MULTILINE)
#: Form of a document by the ending of its name.
_FORMS = {".jsonl": "lines", ".ndjson": "lines", ".json": "json", ".yml": "yaml", ".yaml": "yaml",
          ".xml": "xml"}  # fmt: skip

Cell = tuple[CapturedColumn, float | str]


@dataclass(frozen=True, eq=False)
class StructuredDocument:
    """Content of a document.

    records  each with the number of its line, or of the record; they are all alike, or of streams
    counted  what the numbers count: `line` or `record`
    note     on a line that is not read; empty = there is none
    """

    content: Any
    records: list[tuple[int, Any]]
    counted: str
    note: str = ""

    @property
    def whole(self) -> Any:
        """The content, or a list of all records where each line is one."""
        return self.content or [record for _, record in self.records]


def is_xml(path: Path) -> bool:
    """Whether a file begins as XML does."""
    return path.is_file() and path.read_bytes()[:99].lstrip(b"\xef\xbb\xbf \r\n\t")[:1] == b"<"


def is_yaml_data(path: Path) -> bool:
    """Whether a YAML file holds measurements: OpenCV's, or one without the entries of a mapping."""
    text = path.read_text("utf-8-sig", errors="replace") if path.is_file() else "format:"
    return bool(_OF_OPENCV.match(text)) or not _OF_MAPPING.search(text)


def form_of(path: Path) -> str:
    """Form of a document by its ending, else by its beginning; lines of JSON may be called .json.

    Empty = it is no document.
    """
    form = _FORMS.get(path.suffix.lower(), "")
    return form if form not in ("", "json") else form_in_text(path) or form


def form_in_text(path: Path) -> str:
    """Form of a document by its beginning: `lines`, `json`, `yaml`, `xml`; empty = it is none."""
    head = head_of(path).lstrip("\ufeff \r\n\t")
    complete, _, _ = head.rpartition("\n")
    lines = [line for line in complete.splitlines() if line.strip()]
    messages = sum(_message(line) is not None for line in lines)
    if messages >= max(FEWEST_RECORDS, _MOST_LINES * len(lines)):
        return "lines"
    if head[:1] == "<":
        return "xml"
    if re.match(r"\{\s*\"|\[\s*\{", head):
        return "json"
    is_yaml = len(_NEXT_YAML.findall(head)) >= FEWEST_RECORDS or _YAML_FRAME.search(head)
    return "yaml" if is_yaml else ""


def _message(line: str) -> Any:
    """The content of a line, with its topic if it has one; None = the line is no message."""
    if (match := _MESSAGE.fullmatch(line.strip())) is None:
        return None
    try:
        content = json.loads(match["content"])
    except (ValueError, RecursionError):
        return None
    return content if match["topic"] is None else {"topic": match["topic"], "payload": content}


def read_document(path: Path) -> StructuredDocument:
    """The records of a document.  Raises InputError: it is damaged, or has too many."""
    state = path.stat() if path.is_file() else None
    return _read(path, *((state.st_mtime_ns, state.st_size) if state else (0, 0)))


@lru_cache(maxsize=4)
def _read(path: Path, changed_ns: int, size: int) -> StructuredDocument:
    """The records of a document as it is now: each trial of a file, and its gripper, asks for it.

    changed_ns, size  of the file, which tell that it has changed
    """
    text, form = read_text(path, MAX_BYTES), form_of(path)
    if form == "lines":
        document = _of_lines(path, text)
    elif form == "yaml":
        document = _document(_parse_yaml(path, text))
    elif form == "json":
        document = _document(_upright(_parse_json(path, text, None)))
    else:
        document = _parse_xml(path, text)
    if len(document.records) > MAX_ROWS:
        raise InputError.at(path, f"has {len(document.records)} records, limit {MAX_ROWS}; cut it")
    return document


def _of_lines(path: Path, text: str) -> StructuredDocument:
    """A record per line; none of a topic with another payload.

    raises  InputError: a line is neither, except the last one, which may be torn
    """
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    records, note = list[tuple[int, Any]](), ""
    for i, line in lines:
        if (record := _message(line)) is not None:
            records.append((i, record))
        elif i == lines[-1][0] and len(records) >= FEWEST_RECORDS:
            note = f"{path}:{i}: the last line is torn; it is not read"
        elif _OTHER_PAYLOAD.fullmatch(line) is None:
            records.append((i, _parse_json(path, line, i)))
    return StructuredDocument(None, records, "line", note)


def _upright(content: Any) -> Any:
    """Records of columns that are mappings of rows' labels to values; other content unchanged.

    source  pandas, `DataFrame.to_json` without an orient
    """
    columns = list(content.values()) if isinstance(content, Mapping) else []
    if not columns or any(not isinstance(c, Mapping) or c.keys() != columns[0].keys()
                          for c in columns):  # fmt: skip
        return content
    plain = not any(isinstance(v, Mapping | list) for c in columns for v in c.values())
    if not plain or len(columns[0]) <= len(columns):
        return content
    rows = list(columns[0])
    counted = rows == [str(k) for k in range(len(rows))]
    return [({} if counted else {"index": row}) | {n: c[row] for n, c in content.items()}
            for row in rows]  # fmt: skip


def _document(content: Any) -> StructuredDocument:
    records = max(record_lists(content).values(), key=len, default=[])
    return StructuredDocument(content, list(enumerate(records, 1)), "record")


def _parse_json(path: Path, text: str, line: int | None) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        at = line if line is not None else getattr(error, "lineno", 1)
        message = f"is no JSON ({error}); save it again, or remove the line"
        raise InputError.at(path, message, line=at) from error


def _parse_yaml(path: Path, text: str) -> Any:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        bare = _NAN.sub(".nan", _TAG.sub("", _OF_OPENCV.sub("", text, count=1)))
        parts = [part for part in YAML(typ="safe").load_all(bare) if part is not None]
        return _with_matrices(parts[0] if len(parts) == 1 else parts)
    except (YAMLError, ValueError, RecursionError) as error:
        line = getattr(getattr(error, "problem_mark", None), "line", 0) + 1
        message = "is no YAML; save it again"
        raise InputError.at(path, message, line=line) from error


def _with_matrices(content: Any) -> Any:
    """The content with OpenCV's matrices as lists of rows, or as a list if one-dimensional."""
    if isinstance(content, list):
        return [_with_matrices(item) for item in content]
    if not isinstance(content, Mapping):
        return content
    if {"rows", "cols", "data"} <= set(content):
        values = np.array(content["data"], dtype=np.float64)
        return values.reshape(int(content["rows"]), -1).squeeze().tolist()
    return {str(key): _with_matrices(item) for key, item in content.items()}


def _parse_xml(path: Path, text: str) -> StructuredDocument:
    """Records of one tree, or of a log of many, whose last line may be incomplete."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError.at(path, "defines entities, which are not read; export plain XML")
    bare = _DECLARATION.sub("", text).rstrip()
    try:
        try:
            return _document(_element(ElementTree.fromstring(f"<_>{bare}</_>")))
        except ElementTree.ParseError:
            complete = bare.rpartition("\n")[0] or bare
            return _document(_element(ElementTree.fromstring(f"<_>{complete}</_>")))
    except (ElementTree.ParseError, RecursionError) as error:
        line = getattr(error, "position", (1, 0))[0]
        raise InputError.at(path, f"is no XML ({error}); save it again", line=line) from error


def _element(element: ElementTree.Element) -> Any:
    """An element as plain data: its attributes and its children by name, else its text."""
    children: dict[str, list[Any]] = {}
    for child in element:
        children.setdefault(child.tag.rpartition("}")[2], []).append(_element(child))
    entries = element.attrib | {k: v[0] if len(v) == 1 else v for k, v in children.items()}
    return entries or (element.text or "").strip() or None


def record_lists(content: Any, name: str = "", depth: int = 0) -> dict[str, list[Any]]:
    """Lists of records, or of entries with the same keys, by the keys on the way to them."""
    if isinstance(content, list):
        return {name: content} if all(isinstance(c, dict) for c in content) else {}
    if not isinstance(content, dict) or depth > _MAX_DEPTH:
        return {}
    each = [c for c in content.values() if isinstance(c, dict)]
    alike = len({frozenset(c) for c in each}) == 1 and len(each) >= FEWEST_RECORDS
    lists = {name: each} if alike else {}
    for key, value in content.items():
        lists |= record_lists(value, f"{name}_{key}".strip("_"), depth + 1)
    return lists


def cells(content: Any, depth: int = 0, name: str = "") -> Iterator[Cell]:
    """Every number and word of a record, by the names on the way to it."""
    if depth > _MAX_DEPTH:
        return
    if isinstance(content, Mapping):
        for key, item in content.items():
            if key == "corners" and "center" in content:
                continue  # the same place
            bare, unit = split_unit(name)
            path = f"{bare} {key} {unit}" if unit and not split_unit(key)[1] else f"{name} {key}"
            yield from cells(item, depth + 1, path.strip())
    elif isinstance(content, list):
        if CORNERS.fullmatch(name) and (corners := _corners(content)) is not None:
            content = corners.mean(axis=0).tolist()
        plain = all(item is None or isinstance(item, int | float) for item in content)
        axes = AXES.get(len(content), "") if plain else ""
        bare, unit = split_unit(name)
        for i, item in enumerate(content):
            label = axes[i] if axes else _label(item, i)
            yield from cells(item, depth + 1, f"{bare} {label} {unit}".strip())
    elif isinstance(content, bool):
        yield CapturedColumn(name), float(content)
    elif content is None:
        return
    elif isinstance(content, int | float):
        yield CapturedColumn(*split_unit(name)), float(content)
    else:
        value = number(str(content), ".")
        yield CapturedColumn(*split_unit(name)), str(content) if value is None else value


def _corners(content: list[Any]) -> FloatArray | None:
    """(4, 2) corners of a square tag; None = it is another list."""
    try:
        corners = np.squeeze(np.array(content, dtype=np.float64))
    except (TypeError, ValueError):  # no numbers, or lists of several lengths
        return None
    return corners if corners.shape == (4, 2) else None


def _label(item: Any, index: int) -> str:
    if not isinstance(item, Mapping):
        return str(index)
    candidates = (item[key] for key in _LABELS if key in item)
    return str(next((s for s in candidates if isinstance(s, str | int)), index))
