"""Reads a file of measurements by its kind: C3D, TRC, documents, recordings, arrays, tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np

from cell.files.input_error import InputError
from cell.study.imports import delimited
from cell.study.imports.capture import Capture, CapturedColumn, TextForm, number
from cell.study.imports.containers import (
    CONTAINERS,
    capture_of,
    flat,
    is_text_of_arrays,
    parts_of,
    read_container,
)
from cell.study.imports.delimited import read_delimited
from cell.study.imports.documents import (
    CORNERS,
    FEWEST_RECORDS,
    cells,
    form_in_text,
    is_xml,
    read_document,
)
from cell.study.imports.groups import FilePart, Tree, Units, split_part, with_part
from cell.study.imports.long_tables import one_row_per_time, pivoted
from cell.study.imports.mcap_file import read_mcap
from cell.study.imports.other_kinds import EXPORTS, OF_BAG, bag_error
from cell.study.imports.repairs import (
    in_millimetres,
    with_displacements,
    with_one_unit,
    with_whole_tracks,
    without_codes,
    without_held,
    without_unseen,
)
from cell.study.imports.robot_poses import with_quaternions
from cell.study.imports.sheets import WITH_SHEETS, has_sheets
from cell.study.imports.side_by_side import parts_of_text, read_block
from cell.study.imports.text_content import is_text, text_of
from cell.study.imports.transforms import holds_transforms, transform_notes, transforms_tree
from cell.study.imports.units import METRES, unit_of
from drivers.installing import install_extra


def read_records(path: Path) -> Capture:
    """Read records, one per time or one per time and point, or a document of arrays.

    raises  InputError: it is damaged, or holds no records of numbers
    """
    document = read_document(path)
    content, records = document.content, document.records
    if isinstance(content, dict) and OF_BAG in content:
        raise bag_error(path, "describes")
    frames, units = transforms_tree(path, document.whole)
    if frames:
        return capture_of(path, *_single_source(frames, units)).noted(*transform_notes(path))
    arrays = flat(_without_nulls(content)) if isinstance(content, dict) else {}
    series = [v for v in arrays.values() if v.ndim > 0 and v.dtype.kind in "fiu"]
    longest = max((len(v) for v in series), default=0)
    if longest >= max(len(records), FEWEST_RECORDS):
        return capture_of(path, arrays, {})
    table = _table(path, records, document.counted)
    return table.noted(document.note) if document.note else table


def _single_source(tree: Tree, units: Units) -> tuple[Tree, Units]:
    """The series of a source without its name; those of several with it."""
    if len({key[0] for key in tree}) > 1:
        return tree, units
    return {key[1:]: v for key, v in tree.items()}, {key[1:]: u for key, u in units.items()}


def _without_nulls(content: Any) -> Any:
    """Content with nan in place of nulls in lists."""
    if isinstance(content, dict):
        return {key: _without_nulls(value) for key, value in content.items()}
    if isinstance(content, list) and not any(isinstance(c, dict) for c in content):
        return [np.nan if c is None else _without_nulls(c) for c in content]
    return content


def _table(path: Path, records: Sequence[tuple[int, Any]], counted: str) -> Capture:
    rows = [dict(cells(record)) for _, record in records]
    columns = list(dict.fromkeys(column for row in rows for column in row))
    text_names = {c.name for row in rows for c, value in row.items() if isinstance(value, str)}
    numeric = [c for c in columns if c.name not in text_names]
    if len(rows) < FEWEST_RECORDS or not numeric:
        message = "holds no list of records with numbers; give one record per time, each with its "
        raise InputError.at(path, f"{message}time and the places of the points")
    values = np.array([[row.get(c, np.nan) for c in numeric] for row in rows], dtype=np.float64)
    lines = np.array([i for i, _ in records], dtype=np.intp)
    labels = {
        c.name: [str(row.get(c, "")) for row in rows] for c in columns if c.name in text_names
    }  # fmt: skip
    has_corners = any(CORNERS.fullmatch(c.name.removesuffix(" x")) for c in numeric)
    notes = (f"{path}: the mean of a tag's four corners is its place",) if has_corners else ()
    return pivoted(
        Capture(path, tuple(numeric), values, lines, notes=notes, counted=counted), labels
    )


#: Keys that the second line may hold; the third has their values.
_KEYS = ("DataRate", "Units")


def read_trc(path: Path) -> Capture:
    """Read a TRC file: columns Frame, Time and X, Y, Z of every marker.

    raises  InputError: it is no TRC file, or a line is wrong
    source  OpenSim, "Marker (.trc) files"
    """
    text, notes = text_of(path)
    lines = text.splitlines()
    if len(lines) < 5 or not lines[0].startswith("PathFileType"):
        message = "is no TRC file: its first line does not begin with PathFileType"
        raise InputError.at(path, f"{message}; export it again")
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    missing = [key for key in _KEYS if not header.get(key, "").strip()]
    if missing:
        message = f"{missing[0]} is not stated; add it to lines 2 and 3"
        raise InputError.at(path, message, line=2)
    rate_hz = number(header["DataRate"], ".")
    unit = unit_of(header["Units"])
    if rate_hz is None or not rate_hz > 0.0:
        message = f"DataRate {header['DataRate']!r} is no rate; give frames a second"
        raise InputError.at(path, message, line=3)
    if unit not in METRES:
        message = f"Units {header['Units']!r} is no length; give one of {', '.join(METRES)}"
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
    return Capture(path, columns, values, numbers, rate_hz, unit, notes=tuple(notes))


def _rows(path: Path, lines: list[str], names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Values and line numbers of the rows below the header."""
    rows, numbers = [], []
    for line, text in enumerate(lines[5:], 6):
        cells = text.split("\t")
        while len(cells) > len(names) and not cells[-1].strip():
            cells.pop()
        if not any(c.strip() for c in cells):
            continue
        # Cells missing at the end of a line: the last markers are not seen.
        cells += [""] * (len(names) - len(cells) if len(cells) > 1 else 0)
        if len(cells) != len(names):
            message = f"has {len(cells)} cells between tabs, the header names {len(names)} columns"
            raise InputError.at(path, f"{message}; mend the line", line=line)
        row = [number(c, ".") for c in cells]
        if None in row:
            bad = row.index(None)
            message = f"{cells[bad]!r} is not a number; give one, or nothing where nothing was seen"
            raise InputError.at(path, message, line=line, key=names[bad])
        rows.append(row)
        numbers.append(line)
    if not rows:
        message = "has no rows below its header; export it again"
        raise InputError.at(path, message, line=len(lines))
    return np.array(rows, dtype=np.float64), np.array(numbers, dtype=np.intp)


def read_c3d(path: Path) -> Capture:
    """Read the points of a C3D file: columns Time and X, Y, Z of every point.

    raises  InputError: it is no C3D file or has no points, or ezc3d is not installed
    """
    try:
        import ezc3d
    except ImportError as error:
        message = f"needs ezc3d to be read: {install_extra('import')}"
        raise InputError.at(path, message) from error
    if not path.is_file():
        raise InputError.at(path, "cannot be read: there is no such file; check the name")
    try:
        content = ezc3d.c3d(str(path))
    except Exception as error:  # the C++ reader raises any exception for a damaged file
        message = f"is no C3D file or is damaged ({error}); export it again"
        raise InputError.at(path, message) from error
    parameters = content["parameters"]["POINT"]
    xyz = np.asarray(content["data"]["points"][:3], dtype=np.float64)  # (3, points, frames)
    if xyz.shape[1] == 0 or xyz.shape[2] == 0:
        raise InputError.at(path, "holds no points; export the places of markers")
    rate_hz = float(parameters["RATE"]["value"][0])
    if not rate_hz > 0.0:
        raise InputError.at(path, f"POINT:RATE is {rate_hz:g}; export it with frames a second")
    labels = [str(label).strip() for label in parameters["LABELS"]["value"]]
    labels += [f"point {i}" for i in range(len(labels), xyz.shape[1])]
    labels = labels[: xyz.shape[1]]
    twice = next((label for label in labels if labels.count(label) > 1), None)
    if twice is not None:
        message = f"{twice!r} labels two points; give each a label of its own and export it again"
        raise InputError.at(path, message)
    units = parameters.get("UNITS", {"value": []})["value"]
    unit = unit_of(str(units[0])) if len(units) else ""
    residuals = np.asarray(content["data"]["meta_points"]["residuals"], dtype=np.float64)
    xyz[:, (residuals < 0.0).reshape(xyz.shape[1:])] = np.nan  # marks points that were not seen
    frames = _first_frame(content) + np.arange(xyz.shape[2])
    columns = [CapturedColumn("Time", "s")]
    columns += [CapturedColumn(f"{label} {axis}", unit) for label in labels for axis in "XYZ"]
    values = np.column_stack([frames / rate_hz, xyz.transpose(2, 1, 0).reshape(len(frames), -1)])
    return Capture(path, tuple(columns), values, frames + 1, rate_hz, unit, counted="frame")


def _first_frame(content: Any) -> int:
    """Number of the first frame, counted from 0; the time of frame 0 is 0.

    source  C3D file format, "Limitations": beyond 65,535 frames the parameters have two words
    """
    words = content["parameters"].get("TRIAL", {}).get("ACTUAL_START_FIELD", {}).get("value", ())
    if len(words) == 2:
        low, high = (int(word) % 2**16 for word in words)
        return max(low + 2**16 * high - 1, 0)
    return max(int(content["header"]["points"]["first_frame"]), 0)


#: Endings of names of text tables.
TABLES = (".csv", ".tsv", ".txt", ".dat", ".asc", ".tab", ".log", ".sto", ".mot", ".lvm",
          ".rpt", ".itx", ".prn", ".out")  # fmt: skip
_READERS = {".trc": read_trc, ".c3d": read_c3d, ".mcap": read_mcap}
_READERS |= dict.fromkeys(CONTAINERS, read_container)
_READERS |= dict.fromkeys((".json", ".jsonl", ".ndjson", ".xml", ".yml", ".yaml"), read_records)
KINDS = (*TABLES, *_READERS)


def read_capture(path: Path, form: TextForm | None = None) -> Capture:
    """Read a table, a TRC, C3D or MCAP file, or a file of arrays, by the ending of its name.

    form    of a text table; None = detected from the text
    raises  InputError: it cannot be read
    """
    file, part = split_part(path)
    ending = file.suffix.lower()
    if part and _is_table(file):
        capture = read_block(file, part, form)
    elif part:
        capture = _of_part(path, file)
    elif ending in _READERS and not (ending in WITH_SHEETS and not has_sheets(file)):
        capture = _READERS[ending](path)
    elif _is_document(path):
        capture = read_records(path)
    elif is_text_of_arrays(file):
        capture = read_container(path)
    elif ending in TABLES:
        capture = read_delimited(path, form)
    else:
        capture = _of_unknown_kind(path, form)
    return _cleaned(capture)


def _is_document(path: Path) -> bool:
    """Whether a text is a document by its content, whatever its ending."""
    return is_xml(path) or bool(form_in_text(path))


def _is_table(path: Path) -> bool:
    """Whether a file is a table of text."""
    is_other = path.suffix.lower() in _READERS or _is_document(path) or is_text_of_arrays(path)
    return not is_other and is_text(path)


def parts_in_file(path: Path) -> list[FilePart]:
    """Trials that are parts of a file of any kind; empty = the file is one, or a part itself.

    raises  InputError: it cannot be read, or its groups are ambiguous
    """
    file, part = split_part(path)
    return parts_of_text(file) if not part and _is_table(file) else parts_of(path)


def _of_part(path: Path, file: Path) -> Capture:
    """A part of a file; the last trial's with the note on the document's last line."""
    capture = read_container(path)
    if holds_transforms(file) and path == with_part(file, parts_of(file)[0].markers):
        capture = capture.noted(*transform_notes(file))
    note = read_document(file).note if form_in_text(file) == "lines" else ""
    is_last = bool(note) and path == with_part(file, parts_of(file)[-1].markers)
    return capture.noted(note) if is_last else capture


def read_frames(paths: Sequence[Path], numbers: Sequence[int], form: TextForm | None) -> Capture:
    """Read text tables of one frame each.  Raises InputError, as `read_capture`."""
    return _cleaned(delimited.read_frames(paths, numbers, form))


#: Repairs of a file, in their order; each adds a note of what it changes.
_REPAIRS = (
    without_codes,
    one_row_per_time,
    without_unseen,
    with_displacements,
    without_held,
    in_millimetres,
    with_one_unit,
    with_whole_tracks,
    with_quaternions,
)


def _cleaned(capture: Capture) -> Capture:
    return reduce(lambda cleaned, repair: repair(cleaned), _REPAIRS, capture)


def _of_unknown_kind(path: Path, form: TextForm | None) -> Capture:
    """A text table with an unknown ending.  Raises InputError: it is none."""
    ending = path.suffix.lower() or "no ending"
    if not path.exists():
        raise InputError.at(path, "cannot be read: there is no such file; check the name")
    if ending in EXPORTS and not is_text(path):
        raise InputError.at(path, f"is not read: it is {EXPORTS[ending].format(path)}")
    if not is_text(path):
        message = f"{ending} is no kind of file that is read; give "
        message += f"{', '.join(KINDS)}, or a video with --config and --hand"
        raise InputError.at(path, message)
    try:
        capture = read_delimited(path, form)
    except InputError as error:
        message = f"; {ending} is no kind that is known, and was tried as a table of text: export "
        message += "a CSV with a line of names, of times and places"
        raise InputError(
            [replace(p, message=p.message + message) for p in error.problems]
        ) from error
    note = f"{path}: {ending} is no kind that is known: it is read as a table of text"
    return replace(capture, notes=(note, *capture.notes))
