"""Files of arrays: MATLAB's .mat, Parquet, NumPy's .npy and .npz, HDF5, netCDF; their parts."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cell.files.input_error import InputError
from cell.study.imports.capture import Capture, CapturedColumn
from cell.study.imports.contents import contents
from cell.study.imports.documents import AXES
from cell.study.imports.groups import (
    LABELS,
    PART,
    WITHIN,
    FilePart,
    Tree,
    Units,
    apart_by_length,
    by_trials,
    coordinates_in_rows,
    group_of,
    labels,
    of_points,
    split_part,
    time_groups,
    trials_in,
    with_trials_first,
    within,
)
from cell.study.imports.long_tables import pivoted
from cell.study.imports.message_text import is_of_messages, messages_tree
from cell.study.imports.named_series import (
    igor_tree,
    is_igor_text,
    is_octave_text,
    octave_variables,
    tdms_tree,
)
from cell.study.imports.sheets import (
    WITH_SHEETS,
    cell_text,
    has_sheets,
    read_sheet,
    trials_in_sheets,
)
from cell.study.imports.stated import facts_of
from cell.study.imports.streams import streams_tree
from cell.study.imports.units import METRES, RADIANS, SECONDS, split_unit, unit_of
from cell.study.table import MAX_ROWS
from drivers.installing import install_extra

_Read = TypeVar("_Read")

#: Minimum number of rows of a trial.
_FEWEST_ROWS = 3


def read_container(path: Path) -> Capture:
    """Read the numbers of a file of arrays: one row per time, columns named by place and axis.

    path    of the file, or of a part of it, as `trials.h5#first.camera`
    raises  InputError: it cannot be read, holds no table, or a library is missing
    """
    file, part = split_part(path)
    if has_sheets(file):
        return _read_checked(file, lambda f: read_sheet(f, part))
    tree, units = _read_checked(file, _tree)
    if part:
        capture = _capture_of_part(path, part, tree, units)
        note = f"{path}: a stream of its own, by its topic, its clock or events around a trial"
        in_streams = _TREES.get(file.suffix.lower()) is streams_tree
        return capture.noted(note) if in_streams else capture
    return _read_checked(file, lambda f: capture_of(f, tree, units))


def _tree(path: Path) -> tuple[Tree, Units]:
    if is_octave_text(path):  # which may be called .mat
        return flat(octave_variables(path)), {}
    if is_igor_text(path):
        return igor_tree(path)
    return by_trials(*_TREES.get(path.suffix.lower(), messages_tree)(path))


def is_text_of_arrays(path: Path) -> bool:
    """Whether a text holds named series: of Octave, of Igor, or of a line protocol."""
    return is_octave_text(path) or is_igor_text(path) or is_of_messages(path)


def parts_of(path: Path) -> list[FilePart]:
    """Trials that are parts of a file of arrays; empty = the file is one, or a part itself.

    raises  InputError: it cannot be read, or its groups are ambiguous
    """
    file, part = split_part(path)
    if has_sheets(file) and not part:
        return _read_checked(file, trials_in_sheets)
    if part or not (file.suffix.lower() in _TREES or is_text_of_arrays(file)):
        return []
    tree, units = _read_checked(file, _tree)

    def shows_points(group: tuple[str, ...]) -> bool:
        try:
            capture = _capture_of_part(path, WITHIN.join(group), tree, units)
        except InputError:
            return False
        return bool(contents(capture).points)

    trials = trials_in(tree, shows_points)
    if trials == []:  # markers and gripper may be in one group, each with its times
        trials = trials_in(apart_by_length(tree), shows_points)
        trials = trials if trials and all(trial.gripper for trial in trials) else []
    return trials or []


def _capture_of_part(path: Path, part: str, tree: Tree, units: Units) -> Capture:
    """Columns of the arrays of one group.  Raises InputError: there is none."""
    group = group_of(tree, part)
    if group is None:
        tree = apart_by_length(tree)
        group = group_of(tree, part)
    if group is None:
        available = ", ".join(WITHIN.join(g) for g in time_groups(tree)) or "none"
        raise InputError.at(path, f"has no part {part!r} with times; it has {available}")
    arrays, above = within(tree, group), group[:-1]  # a gripper's group keeps its own name
    of_key = {key: units.get((*group, *key), units.get((*above, *key), "")) for key in arrays}
    return capture_of(path, arrays, of_key)


def _read_checked(path: Path, read: Callable[[Path], _Read]) -> _Read:
    """Result of a reader.  Raises InputError: for every error of the reader."""
    if not path.is_file():
        raise InputError.at(path, "cannot be read: there is no such file; check the name")
    try:
        return read(path)
    except ImportError as error:
        library = str(error.name or "a library").split(".")[0]
        message = f"needs {library} to be read: {install_extra('import')}"
        raise InputError.at(path, message) from error
    except InputError:
        raise
    except Exception as error:  # a reader may raise anything for a damaged file
        message = f"is damaged, or is no {path.suffix.lower()} file ({error}); save it again"
        raise InputError.at(path, message) from error


def _mat(path: Path) -> tuple[Tree, Units]:
    """MATLAB's file; from version 7.3 on it is HDF5 with its dimensions reversed."""
    with path.open("rb") as stream:
        is_hdf5 = b"MATLAB 7.3" in stream.read(128)
    if is_hdf5:
        return hdf5_tree(path, reverse=True)
    from scipy.io import loadmat

    content = loadmat(path, simplify_cells=True)
    return flat({k: v for k, v in content.items() if not k.startswith("__")}), {}


def _arrow(form: str, path: Path) -> tuple[Tree, Units]:
    """Columns of a table of Arrow's; form: the module that reads it."""
    table, columns = import_module(f"pyarrow.{form}").read_table(path), Tree()
    units: Units = {}
    is_duration, is_date = (getattr(import_module("pyarrow.types"), f"is_{kind}")
                            for kind in ("duration", "timestamp"))  # fmt: skip
    for name in table.column_names:
        column = table.column(name)
        if is_duration(column.type) or is_date(column.type):
            counts = column.cast("int64").to_numpy()  # nan where null
            columns[(name,)] = counts * SECONDS[column.type.unit.replace("us", "µs")]
            units |= {(name,): "s"} if is_duration(column.type) else {}
            continue
        values = column.to_pylist()
        if values and any(isinstance(v, list) for v in values):
            size = max(len(v) for v in values if isinstance(v, list))
            values = [v if isinstance(v, list) else [None] * size for v in values]
            columns[(name,)] = np.array(values, dtype=np.float64)
        else:
            columns[(name,)] = _series(values)
    return columns, units


def _series(values: Sequence[object]) -> NDArray[Any]:
    """Numbers if all values are; else words."""
    if all(v is None or isinstance(v, bool | int | float) for v in values):
        return np.array(values, dtype=np.float64)
    return np.array([cell_text(v) for v in values], dtype=object)


def _npy(path: Path) -> tuple[Tree, Units]:
    values = np.load(path, allow_pickle=False)
    if values.dtype.names is None:
        raise InputError.at(
            path, f"has no names for its {values.shape[-1] if values.ndim else 0} columns; save it "
            "as a structured array, or as a table with a line of names",
        )  # fmt: skip
    return flat({n: values[n] for n in values.dtype.names}), {}


def _npz(path: Path) -> tuple[Tree, Units]:
    """Arrays of numbers and words; those of Python objects, which run code when read, are empty."""
    arrays: dict[str, Any] = {}
    with np.load(path, allow_pickle=False) as store:
        for name in store.files:
            try:
                arrays[name] = store[name]
            except ValueError as error:
                if not str(error).startswith("Object arrays"):
                    raise
                arrays[name] = np.empty(0, dtype=object)
    return flat(arrays), {}


#: Names of arrays that hold the columns of a table of pandas.
_OF_PANDAS = re.compile(r"values_block_\d+")


def hdf5_tree(path: Path, reverse: bool = False) -> tuple[Tree, Units]:
    """Arrays, numeric attributes of groups, and the units of the arrays."""
    import h5py

    tree: Tree = {}
    units: Units = {}

    def collect(name: str, item: Any) -> None:
        key = tuple(name.split("/")) if name else ()
        if isinstance(item, h5py.Group) and not name.startswith("#"):
            numbers = {n: np.asarray(v) for n, v in item.attrs.items() if np.ndim(v) == 0}
            tree.update({(*key, n): v for n, v in numbers.items() if v.dtype.kind in "fiu"})
        if not isinstance(item, h5py.Dataset) or name.startswith("#"):
            return
        values = _hdf5_values(store, item)
        if values.dtype.names is not None:
            _check_names(path, values.dtype.names)
            tree.update({(*key, n): values[n] for n in values.dtype.names})
            return
        tree[key] = values.T if reverse else with_trials_first(values, _dimensions(item))
        unit = next((item.attrs[k] for k in ("units", "unit") if k in item.attrs), "")
        text = unit.decode() if isinstance(unit, bytes) else str(unit)
        units[key] = unit_of(text.partition(" since ")[0])

    with h5py.File(path, "r") as store:
        collect("", store)
        store.visititems(collect)
    return tree, units


def _hdf5_values(store: Any, item: Any) -> NDArray[Any]:
    """Values of a dataset; MATLAB's texts, and its cells of texts, as words."""
    import h5py

    if h5py.check_string_dtype(item.dtype):
        return np.asarray(item.asstr()[()])
    if _is_matlab_text(item):
        return np.array(_matlab_text(item), dtype=object)
    values = np.asarray(item[()])
    if h5py.check_ref_dtype(item.dtype) is not h5py.Reference:
        return values
    cells = [store[reference] for reference in values.ravel()]
    if not cells or not all(map(_is_matlab_text, cells)):
        return values
    return np.array([_matlab_text(cell) for cell in cells], dtype=object)


def _is_matlab_text(item: Any) -> bool:
    return bool(item.attrs.get("MATLAB_class") == b"char")


def _matlab_text(item: Any) -> str:
    """Characters of a row, which are numbers; none where MATLAB stores the size of an empty text.

    source  MATLAB, MAT-file version 7.3: attribute MATLAB_empty
    """
    empty = "MATLAB_empty" in item.attrs
    return "" if empty else "".join(map(chr, np.asarray(item[()]).ravel()))


def _dimensions(item: Any) -> list[str]:
    """Names of a dataset's dimensions; empty = none is stated."""
    return [dim[0].name.rpartition("/")[2] if len(dim) else "" for dim in item.dims]


def _check_names(path: Path, names: Sequence[str]) -> None:
    """Raise InputError if only pandas can read the names of the columns."""
    if any(_OF_PANDAS.fullmatch(name) for name in names):
        message = "is a table of pandas, which alone knows the names of its columns; save it as "
        raise InputError.at(path, f"{message}CSV: DataFrame.to_csv, of DeepLabCut save_as_csv=True")


def flat(content: Mapping[str, Any], above: tuple[str, ...] = ()) -> Tree:
    """Arrays of structures within structures."""
    arrays: Tree = {}
    for name, value in content.items():
        key = (*above, str(name))
        if isinstance(value, Mapping):
            arrays |= flat(value, key)
            continue
        if isinstance(value, list) and all(isinstance(item, Mapping) for item in value):
            arrays |= flat({_item_label(item, k): item for k, item in enumerate(value)}, key)
            continue
        values = np.asarray(value)
        if values.dtype.names is not None:
            arrays |= flat({n: values[n] for n in values.dtype.names}, key)
        else:
            arrays[key] = values
    return arrays


def _item_label(item: Mapping[str, Any], number: int) -> str:
    """Label of a structure in a list, else its number."""
    candidates = (value for name, value in item.items() if LABELS.fullmatch(str(name).lower()))
    return next((value for value in candidates if isinstance(value, str) and value), str(number))


def _check_one_trial(path: Path, tree: Tree) -> None:
    groups = [WITHIN.join(group) or "its top" for group in time_groups(tree)]
    if len(groups) > 1:
        raise InputError.at(
            path, f"holds times in {' and '.join(groups[:3])}: these are several recordings; save "
            "each in a file of its own, and give that of the gripper with --hand, or name them "
            f"{path.name}{PART}{groups[0]}",
        )  # fmt: skip


def capture_of(path: Path, tree: Tree, units: Units) -> Capture:
    """Columns of all arrays with the most frequent number of rows."""
    arrays = {key: np.squeeze(values) for key, values in tree.items()}
    facts, notes = facts_of(path, arrays)
    numbers = {k: v for k, v in arrays.items() if v.dtype.kind in "fiub" and v.ndim >= 1}
    lengths = Counter(n for v in numbers.values() for n in set(v.shape) if n >= _FEWEST_ROWS)
    if not lengths:
        raise InputError.at(path, "holds no arrays of numbers; save times and places of markers")
    rows = max(lengths, key=lambda n: (lengths[n], n))
    if rows > MAX_ROWS:
        raise InputError.at(path, f"has {rows} rows, limit {MAX_ROWS}; cut it to the motion")
    texts = {key: [cell_text(v) for v in value.ravel()] for key, value in arrays.items()
             if value.dtype.kind in "OUS" and value.ndim <= 1}  # fmt: skip
    _check_one_trial(path, tree)
    names = of_points(texts, arrays)
    columns: list[CapturedColumn] = []
    series: list[NDArray[Any]] = []
    left_out: list[str] = []
    for key, values in numbers.items():
        if rows not in values.shape or values.ndim > 3:
            left_out.append("/".join(key))
            continue
        along = values.shape.index(rows)
        values = np.moveaxis(values, along, 0).astype(np.float64)
        shapes = [v.shape for k, v in numbers.items() if k[:-1] == key[:-1]]
        for name, column in _columns(key, values, labels(key, values.shape, names, shapes)):
            columns.append(CapturedColumn(name, units.get(key, "") or _unit_in_name(key[-1], name)))
            series.append(column)
    notes += [f"{path}: {n} is no series of {rows} rows; it is not read" for n in left_out]
    notes += [
        f"{path}: {'/'.join(key)} holds no numbers but objects of Python; it is not read"
        for key, value in arrays.items()
        if value.dtype == object and not value.size
    ]
    capture = Capture(
        path, tuple(_unique(columns)), np.column_stack(series), np.arange(1, rows + 1),
        facts.rate_hz, facts.unit, notes=tuple(notes), of_cable=facts.of_cable,
        counted="row", pixel_m=facts.pixel_m,
    )  # fmt: skip
    of_rows = {_name(k): w for k, w in texts.items() if len(w) == rows}
    return pivoted(capture, of_rows)


def _name(key: tuple[str, ...]) -> str:
    """The innermost two names: of a group (a point or the recording) and of the array."""
    return " ".join(key[-2:])


def _columns(
    key: tuple[str, ...], values: NDArray[np.float64], titles: Sequence[str] | None
) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Names and series of an array (rows, …): coordinates last, points before them."""
    name, own = _name(key), key[-1]
    if values.ndim == 1:
        yield name, values
        return
    if values.ndim == 2:
        if titles is not None and len(titles) == values.shape[1]:
            yield from ((_with_name(own, label), values[:, k]) for k, label in enumerate(titles))
            return
        if (coordinates := coordinates_in_rows(own, values)) is None:
            point = f"{titles[0]} {own}" if titles is not None and len(titles) == 1 else name
            yield from _of_point(point, values)
            return
        values = values.reshape(len(values), -1, coordinates)
    points = values.shape[1:]
    if _are_poses(values):  # column by column, as robots write them
        columns = values.transpose(0, 2, 1).reshape(len(values), -1)
        yield from ((f"{name} {k}", columns[:, k]) for k in range(columns.shape[1]))
        return
    if (points[0] in AXES and points[1] not in AXES) or (
        titles is not None and len(titles) == points[1] != points[0]
    ):
        values = values.transpose(0, 2, 1)
    for k in range(values.shape[1]):
        named = titles is not None and len(titles) == values.shape[1]
        point = f"{titles[k]} {own}" if titles is not None and named else f"{name} {k}"
        yield from _of_point(point, values[:, k])


def _unit_in_name(array: str, column: str) -> str:
    """Unit of length or angle, or px, at the end of an array's name, where its column has none."""
    unit = "" if split_unit(column)[1] else split_unit(array)[1]
    return unit if unit in METRES or unit in RADIANS or unit == "px" else ""


def _with_name(own: str, label: str) -> str:
    """A column's name with that of its array, and its unit at the end."""
    bare, unit = split_unit(label)
    return f"{bare} {own} [{unit}]" if unit else f"{bare} {own}"


def _are_poses(values: NDArray[np.float64]) -> bool:
    """Whether matrices (rows, 4, 4) have the last row of a pose, or (rows, 3, 3) are rotations."""
    if values.shape[1:] == (4, 4):
        known = values[np.isfinite(values).all(axis=(1, 2))]
        return len(known) > 0 and bool(np.allclose(known[:, 3], [0.0, 0.0, 0.0, 1.0]))
    if values.shape[1:] != (3, 3):
        return False
    known = values[np.isfinite(values).all(axis=(1, 2))]
    square = known @ known.transpose(0, 2, 1)
    return len(known) > 0 and bool(np.allclose(square, np.eye(3), atol=1e-3))


def _of_point(point: str, values: NDArray[np.float64]) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Names and series of the coordinates (rows, d) of a point, or of other numbers of it."""
    titles = AXES.get(values.shape[1]) or [str(k) for k in range(values.shape[1])]
    yield from ((f"{point} {title}", values[:, k]) for k, title in enumerate(titles))


def _unique(columns: Sequence[CapturedColumn]) -> Iterator[CapturedColumn]:
    """Columns with unique names; repeated ones are numbered from the second on."""
    counts: Counter[str] = Counter()
    for column in columns:
        counts[column.name] += 1
        count = counts[column.name]
        yield column if count == 1 else CapturedColumn(f"{column.name} #{count}", column.unit)


_TREES: dict[str, Callable[[Path], tuple[Tree, Units]]] = {
    ".mat": _mat, ".parquet": partial(_arrow, "parquet"), ".npy": _npy, ".npz": _npz,
    ".h5": hdf5_tree, ".hdf5": hdf5_tree, ".nc": hdf5_tree,
    ".feather": partial(_arrow, "feather"), ".arrow": partial(_arrow, "feather"),
    ".tdms": tdms_tree, ".json": streams_tree, ".jsonl": streams_tree, ".ndjson": streams_tree,
}  # fmt: skip
#: Endings of names of files of arrays.
CONTAINERS = (*WITH_SHEETS, *_TREES)
