"""C3D files of motion capture, read by ezc3d."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cell.files.input_error import InputError
from cell.study.imports.capture import Capture, CapturedColumn
from cell.study.imports.units import unit_of


def read_c3d(path: Path) -> Capture:
    """Read the points of a C3D file: columns Time and X, Y, Z of every point.

    raises  InputError: it is no C3D file or has no points, or ezc3d is not installed
    """
    try:
        import ezc3d
    except ImportError as error:
        message = "needs ezc3d to be read: pip install 'cable-cell[import]'"
        raise InputError.at(path, message) from error
    if not path.is_file():
        raise InputError.at(path, "cannot be read: there is no such file; check the name")
    try:
        content = ezc3d.c3d(str(path))
    except Exception as error:  # its reader, in C++, raises what it likes of a damaged file
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
    frames = np.arange(xyz.shape[2])
    columns = [CapturedColumn("Time", "s")]
    columns += [CapturedColumn(f"{label} {axis}", unit) for label in labels for axis in "XYZ"]
    values = np.column_stack([frames / rate_hz, xyz.transpose(2, 1, 0).reshape(len(frames), -1)])
    return Capture(path, tuple(columns), values, frames + 1, rate_hz, unit, counted="frame")
