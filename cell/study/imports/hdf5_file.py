"""Arrays of an HDF5 file, also of netCDF 4 and of MATLAB from version 7.3 on."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.files.input_error import InputError
from cell.study.imports.groups import Tree, Units
from cell.study.imports.trial_dimension import with_trials_first
from cell.study.imports.units import unit_of

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
