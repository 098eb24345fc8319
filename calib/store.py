"""A calibration on disk: YAML that a person can read and write, checked when it is read.

format: cell-calibration/1
date: 2025-03-14
camera:
  homography: [[2.0e-4, 0, -0.2], [0, -2.0e-4, 0.1], [0, 0, 1]]   # pixel → plane, m
  # or, square to the plane:  metres_per_pixel, origin_column_px, origin_row_px
  latency_s: 0.004            # from the middle of the exposure to the frame's time stamp
  rms_error_m: 3.0e-5         # on points that were not used for the calibration
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calib.plane import PlaneView

FORMAT = "cell-calibration/1"
_SCALE_KEYS = ("metres_per_pixel", "origin_column_px", "origin_row_px")


class CalibrationError(ValueError):
    """A calibration file cannot be used: which file, which key, why, and the remedy.

    Scenario: a homography typed with a row missing; a file of another format.
    """


@dataclass(frozen=True)
class Calibration:
    """Where pixels lie in the plane, how late frames are, and how good that is known to be.

    latency_s    from the middle of the exposure to the frame's time stamp
    rms_error_m  on points not used for the calibration; nan = never measured
    """

    view: PlaneView
    latency_s: float
    date: date
    rms_error_m: float


def load_calibration(path: Path) -> Calibration:
    """Calibration from a YAML file.  Raises CalibrationError, naming file, key and value."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise CalibrationError(f"{path}: {error.strerror}; calibrate the camera first") from error
    try:
        tree = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise CalibrationError(f"{path}: not YAML: {error}") from error
    top = _mapping(path, "", tree, {"format", "date", "camera"})
    if top.get("format") != FORMAT:
        raise CalibrationError(f"{path}: format: {top.get('format')!r}; must be {FORMAT!r}")
    if type(top.get("date")) is not date:
        raise CalibrationError(f"{path}: date: {top.get('date')!r}; must be like 2025-03-14")
    known = {"homography", "latency_s", "rms_error_m", *_SCALE_KEYS}
    camera = _mapping(path, "camera", top.get("camera"), known)
    rms = _number(path, "camera.rms_error_m", camera.get("rms_error_m", float("nan")), nan=True)
    if rms < 0.0:
        raise CalibrationError(f"{path}: camera.rms_error_m: {rms}; must be ≥ 0")
    latency = _number(path, "camera.latency_s", camera.get("latency_s", 0.0))
    return Calibration(_view(path, camera), latency, top["date"], rms)


def save_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration; `load_calibration` gives the same numbers back."""
    tree = {
        "format": FORMAT,
        "date": calibration.date,
        "camera": {
            "homography": np.asarray(calibration.view.homography).tolist(),
            "latency_s": float(calibration.latency_s),
            "rms_error_m": float(calibration.rms_error_m),
        },
    }
    path.write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")


def _view(path: Path, camera: Mapping[str, Any]) -> PlaneView:
    scale_keys = [key for key in _SCALE_KEYS if key in camera]
    if "homography" in camera:
        if scale_keys:
            raise CalibrationError(
                f"{path}: camera: both homography and {scale_keys[0]}; keep one of them"
            )
        rows = camera["homography"]
        if not (
            isinstance(rows, list)
            and len(rows) == 3
            and all(isinstance(row, list) and len(row) == 3 for row in rows)
        ):
            raise CalibrationError(f"{path}: camera.homography: {rows!r}; must be 3 rows of 3")
        h = np.array(
            [
                [
                    _number(path, f"camera.homography[{i}][{j}]", value)
                    for j, value in enumerate(row)
                ]
                for i, row in enumerate(rows)
            ]
        )
        size = np.prod(np.linalg.norm(h, axis=1))
        if not abs(np.linalg.det(h)) > 1e-9 * size:
            raise CalibrationError(f"{path}: camera.homography: cannot be inverted; calibrate anew")
        return PlaneView(h)
    missing = [key for key in _SCALE_KEYS if key not in camera]
    if missing:
        raise CalibrationError(f"{path}: camera: needs homography, or {', '.join(missing)} as well")
    scale, column, row = (_number(path, f"camera.{key}", camera[key]) for key in _SCALE_KEYS)
    if not scale > 0.0:
        raise CalibrationError(f"{path}: camera.metres_per_pixel: {scale}; must be > 0")
    return PlaneView.from_scale(scale, column, row)


def _mapping(path: Path, name: str, value: object, known: set[str]) -> Mapping[str, Any]:
    where = f"{path}: {name}" if name else f"{path}"
    if not isinstance(value, dict):
        raise CalibrationError(f"{where}: must be a mapping with {', '.join(sorted(known))}")
    for key in value:
        if key not in known:
            raise CalibrationError(
                f"{where}: unknown key {key!r}; known are {', '.join(sorted(known))}"
            )
    return value


def _number(path: Path, name: str, value: object, *, nan: bool = False) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        hint = "; write 1.0e-4, with a point" if isinstance(value, str) else ""
        raise CalibrationError(f"{path}: {name}: {value!r} is not a number{hint}")
    if not (np.isfinite(value) or (nan and np.isnan(value))):
        raise CalibrationError(f"{path}: {name}: {value} is not finite")
    return float(value)
