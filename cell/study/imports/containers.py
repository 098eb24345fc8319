"""Files of arrays: spreadsheets (.xlsx), MATLAB's .mat, Parquet, NumPy's .npy and .npz, HDF5."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.files.input_error import InputError
from cell.study.imports.capture import NOT_SEEN, Capture, CapturedColumn, is_number
from cell.study.imports.column_names import ColumnKind, meaning
from cell.study.imports.delimited import Row, captured
from cell.study.imports.header import read_header
from cell.study.imports.long_tables import pivoted
from cell.study.imports.units import METRES, unit_of
from cell.study.table import MAX_ROWS
from drivers.installing import install_extra

#: Arrays by their path within a file, the outermost name first.
Tree = dict[tuple[str, ...], NDArray[Any]]

#: Coordinates of an array whose last dimension has so many: places, or quaternions.
_AXES = {2: "xy", 3: "xyz", 4: "xyzw"}
#: Names of arrays of text that name the points of another one, and of numbers that are rates.
_LABELS = re.compile(r"labels?|(node|marker|point|body|column)_?names?|names?|columns|keypoints")
_OF_PANDAS = re.compile(r"values_block_\d+")
_RATE = re.compile(r"(frame_?rate|sampl(e|ing)_?rate|rate|frequency|freq|fps|fs)(_hz)?")
_UNIT = re.compile(r"(length_?)?units?")
#: Rows of a sheet in which its table begins.
_MOST_HEADER = 200
#: Fewest numbers that are rows of a trial.
_FEWEST_ROWS = 3


def read_container(path: Path) -> Capture:
    """Read the numbers of a file of arrays: one row per time, columns named by place and axis.

    raises  InputError: it cannot be read, holds no table, or a library is missing
    """
    if not path.is_file():
        raise InputError.at(path, "cannot be read: there is no such file; check the name")
    ending = path.suffix.lower()
    read = _READERS[ending]
    try:
        return read(path)
    except ImportError as error:
        library = str(error.name or "a library").split(".")[0]
        message = f"needs {library} to be read: {install_extra('import')}"
        raise InputError.at(path, message) from error
    except InputError:
        raise
    except Exception as error:  # of a damaged file its reader raises what it likes
        message = f"is damaged, or is no {ending} file ({error}); save it again"
        raise InputError.at(path, message) from error


def _sheet(path: Path) -> Capture:
    """The first sheet that holds a table."""
    from openpyxl import load_workbook

    book = load_workbook(path, read_only=True, data_only=True)
    try:
        for page in book.worksheets:
            each = enumerate(page.iter_rows(values_only=True), 1)
            rows = [Row(line, tuple(_word(cell) for cell in cells)) for line, cells in each]
            if (made := _table_of_sheet(path, [row for row in rows if not row.blank])) is not None:
                return made
    finally:
        book.close()
    raise InputError.at(path, "no sheet holds rows of numbers; give a line of names above them")


def _table_of_sheet(path: Path, rows: Sequence[Row]) -> Capture | None:
    """The table that begins in the first row with two numbers, and no more other words."""
    first = next((i for i, row in enumerate(rows[:_MOST_HEADER]) if _begins_table(row)), None)
    if first is None:
        return None
    width = max(i for i, cell in enumerate(rows[first].cells, 1) if cell)
    for row in rows[:first]:
        named = [i for i, cell in enumerate(row.cells, 1) if cell]
        width = max(width, len(named) if len(named) > 2 else 0)
    above = [(row.line, row.cells[:width]) for row in rows[:first]]
    table = [Row(row.line, row.cells[:width]) for row in rows[first:]]
    header = read_header(path, above, table[0].cells)
    return pivoted(*captured(path, header, table, "."))


def _begins_table(row: Row) -> bool:
    filled = [cell for cell in row.cells if cell.lower() not in NOT_SEEN]
    numbers = sum(is_number(cell, ".") for cell in filled)
    return numbers >= 2 and 2 * numbers >= len(filled)


def _word(cell: object) -> str:
    """A cell as text that `number` reads."""
    if cell is None:
        return ""
    return str(int(cell)) if isinstance(cell, bool) else str(cell).strip()


def _mat(path: Path) -> Capture:
    """MATLAB's file; from version 7.3 on it is HDF5 with its dimensions reversed."""
    with path.open("rb") as stream:
        newest = b"MATLAB 7.3" in stream.read(128)
    if newest:
        return _capture(path, *_hdf5_tree(path, reverse=True))
    from scipy.io import loadmat

    content = loadmat(path, simplify_cells=True)
    return _capture(path, _flat({k: v for k, v in content.items() if not k.startswith("__")}), {})


def _parquet(path: Path) -> Capture:
    from pyarrow.parquet import read_table

    table = read_table(path)
    columns: Tree = {}
    for name in table.column_names:
        values = table.column(name).to_pylist()
        if values and any(isinstance(v, list) for v in values):
            size = max(len(v) for v in values if isinstance(v, list))
            values = [v if isinstance(v, list) else [None] * size for v in values]
            columns[(name,)] = np.array(values, dtype=np.float64)
        else:
            columns[(name,)] = _series(values)
    return _capture(path, columns, {})


def _series(values: Sequence[object]) -> NDArray[Any]:
    """Numbers where all are; else words."""
    if all(v is None or isinstance(v, bool | int | float | datetime) for v in values):
        seconds = [v.timestamp() if isinstance(v, datetime) else v for v in values]
        return np.array(seconds, dtype=np.float64)
    return np.array([_word(v) for v in values], dtype=object)


def _npy(path: Path) -> Capture:
    values = np.load(path, allow_pickle=False)
    if values.dtype.names is None:
        raise InputError.at(
            path, f"has no names for its {values.shape[-1] if values.ndim else 0} columns; save it "
            "as a structured array, or as a table with a line of names",
        )  # fmt: skip
    return _capture(path, _flat({n: values[n] for n in values.dtype.names}), {})


def _npz(path: Path) -> Capture:
    with np.load(path, allow_pickle=False) as store:
        return _capture(path, _flat({name: store[name] for name in store.files}), {})


def _hdf5(path: Path) -> Capture:
    return _capture(path, *_hdf5_tree(path, reverse=False))


def _hdf5_tree(path: Path, reverse: bool) -> tuple[Tree, dict[tuple[str, ...], str]]:
    """Arrays, and the units that are attributes of some."""
    import h5py

    tree: Tree = {}
    units: dict[tuple[str, ...], str] = {}

    def keep(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or name.startswith("#"):
            return
        key = tuple(name.split("/"))
        values = item.asstr()[()] if h5py.check_string_dtype(item.dtype) else item[()]
        values = np.asarray(values)
        if values.dtype.names is not None:
            _check_names(path, values.dtype.names)
            tree.update({(*key, n): values[n] for n in values.dtype.names})
            return
        tree[key] = values.T if reverse else values
        said = next((item.attrs[k] for k in ("units", "unit") if k in item.attrs), "")
        units[key] = unit_of(said.decode() if isinstance(said, bytes) else str(said))

    with h5py.File(path, "r") as store:
        store.visititems(keep)
    return tree, units


def _check_names(path: Path, names: Sequence[str]) -> None:
    """Raise InputError where only pandas knows what the columns are called."""
    if any(_OF_PANDAS.fullmatch(name) for name in names):
        message = "is a table of pandas, which alone knows the names of its columns; save it as "
        raise InputError.at(path, f"{message}CSV: DataFrame.to_csv, of DeepLabCut save_as_csv=True")


def _flat(content: Mapping[str, Any], above: tuple[str, ...] = ()) -> Tree:
    """Arrays of structures within structures."""
    found: Tree = {}
    for name, value in content.items():
        key = (*above, str(name))
        if isinstance(value, Mapping):
            found |= _flat(value, key)
            continue
        if isinstance(value, list) and all(isinstance(item, Mapping) for item in value):
            found |= _flat({_called(item, k): item for k, item in enumerate(value)}, key)
            continue
        values = np.asarray(value)
        if values.dtype.names is not None:
            found |= _flat({n: values[n] for n in values.dtype.names}, key)
        else:
            found[key] = values
    return found


def _called(item: Mapping[str, Any], number: int) -> str:
    """What a structure of a list calls itself, else its number."""
    said = (value for name, value in item.items() if _LABELS.fullmatch(str(name).lower()))
    return next((value for value in said if isinstance(value, str) and value), str(number))


def _check_one_trial(path: Path, keys: Collection[tuple[str, ...]]) -> None:
    """Raise InputError where groups have times of their own."""
    groups = {key[:-1] for key in keys if meaning(CapturedColumn(key[-1])).kind is ColumnKind.TIME}
    if len(groups) > 1:
        names = " and ".join(sorted("/".join(group) or "its top" for group in groups)[:3])
        message = f"holds times in {names}: these are several recordings; save each in a file of "
        raise InputError.at(path, f"{message}its own, and give that of the gripper with --hand")


def _capture(path: Path, tree: Tree, units: Mapping[tuple[str, ...], str]) -> Capture:
    """Columns of all arrays that have as many rows as most have."""
    arrays = {key: np.squeeze(values) for key, values in tree.items()}
    numbers = {k: v for k, v in arrays.items() if v.dtype.kind in "fiub" and v.ndim >= 1}
    lengths = Counter(n for v in numbers.values() for n in set(v.shape) if n >= _FEWEST_ROWS)
    if not lengths:
        raise InputError.at(path, "holds no arrays of numbers; save times and places of markers")
    rows = max(lengths, key=lambda n: (lengths[n], n))
    if rows > MAX_ROWS:
        raise InputError.at(path, f"has {rows} rows, limit {MAX_ROWS}; cut it to the motion")
    words = {key: [_word(v) for v in value.ravel()] for key, value in arrays.items()
             if value.dtype.kind in "OUS" and value.ndim <= 1}  # fmt: skip
    _check_one_trial(path, [k for k, v in numbers.items() if v.ndim == 1])
    columns: list[CapturedColumn] = []
    series: list[NDArray[Any]] = []
    left_out: list[str] = []
    for key, values in numbers.items():
        if rows not in values.shape or values.ndim > 3:
            left_out.append("/".join(key))
            continue
        along = values.shape.index(rows)
        values = np.moveaxis(values, along, 0).astype(np.float64)
        for name, column in _columns(key, values, _labels(key, values.shape, words)):
            columns.append(CapturedColumn(name, units.get(key, "")))
            series.append(column)
    notes = [f"{path}: {n} is no series of {rows} rows; it is not read" for n in left_out]
    made = Capture(
        path, tuple(_distinct(columns)), np.column_stack(series), np.arange(1, rows + 1),
        _rate_hz(arrays), _unit(words), notes=tuple(notes), counted="row",
    )  # fmt: skip
    of_rows = {_name(k): w for k, w in words.items() if len(w) == rows}
    return pivoted(made, of_rows)


def _name(key: tuple[str, ...]) -> str:
    """The innermost two names: a group's is that of a point, or of the whole."""
    return " ".join(key[-2:])


def _columns(
    key: tuple[str, ...], values: NDArray[np.float64], labels: Sequence[str] | None
) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Names and series of an array (rows, …): coordinates last, points before them."""
    name, own = _name(key), key[-1]
    if values.ndim == 1:
        yield name, values
        return
    if values.ndim == 2:
        if labels is not None and len(labels) == values.shape[1]:
            yield from ((f"{label} {own}", values[:, k]) for k, label in enumerate(labels))
            return
        point = f"{labels[0]} {own}" if labels is not None and len(labels) == 1 else name
        yield from _of_point(point, values)
        return
    points = values.shape[1:]
    if (points[0] in _AXES and points[1] not in _AXES) or (
        labels is not None and len(labels) == points[1] != points[0]
    ):
        values = values.transpose(0, 2, 1)
    for k in range(values.shape[1]):
        named = labels is not None and len(labels) == values.shape[1]
        point = f"{labels[k]} {own}" if labels is not None and named else f"{name} {k}"
        yield from _of_point(point, values[:, k])


def _of_point(point: str, values: NDArray[np.float64]) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Names and series of the coordinates (rows, d) of a point, or of other numbers of it."""
    titles = _AXES.get(values.shape[1]) or [str(k) for k in range(values.shape[1])]
    yield from ((f"{point} {title}", values[:, k]) for k, title in enumerate(titles))


def _labels(
    key: tuple[str, ...], shape: Sequence[int], words: Mapping[tuple[str, ...], Sequence[str]]
) -> Sequence[str] | None:
    """Names of points that stand in the same group as an array."""
    for other, found in words.items():
        fits = len(found) in shape or (len(found) == 1 and len(shape) > 1)
        if other[:-1] == key[:-1] and _LABELS.fullmatch(other[-1].lower()) and fits:
            return found
    return None


def _distinct(columns: Sequence[CapturedColumn]) -> Iterator[CapturedColumn]:
    """Columns with names of their own; of a repeated one the first keeps it."""
    seen: Counter[str] = Counter()
    for column in columns:
        seen[column.name] += 1
        count = seen[column.name]
        yield column if count == 1 else CapturedColumn(f"{column.name} #{count}", column.unit)


def _rate_hz(arrays: Tree) -> float | None:
    """Rows a second that a single number states."""
    for key, value in arrays.items():
        if value.ndim == 0 and value.dtype.kind in "fiu" and _RATE.fullmatch(key[-1].lower()):
            return float(value) if float(value) > 0.0 else None
    return None


def _unit(words: Mapping[tuple[str, ...], Sequence[str]]) -> str:
    """Unit of length that a text states."""
    said = [unit_of(found[0]) for key, found in words.items()
            if len(found) == 1 and _UNIT.fullmatch(key[-1].lower())]  # fmt: skip
    return next((unit for unit in said if unit in METRES), "")


_READERS: dict[str, Callable[[Path], Capture]] = {
    ".xlsx": _sheet, ".mat": _mat, ".parquet": _parquet, ".npy": _npy, ".npz": _npz,
    ".h5": _hdf5, ".hdf5": _hdf5,
}  # fmt: skip
#: Endings of names of files of arrays.
CONTAINERS = tuple(_READERS)
