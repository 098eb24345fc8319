"""Calibrations on disk: one YAML file each, readable for a person, protected by a hash.

format: cell-calibration/2
kind: cell                       # camera, cell, time or grip
made: 2026-03-14T09:26:53+00:00
how: {poses: 30, held_out: 6}
devices: {camera: '40312345', width_px: 1280, height_px: 1024}
error: {map_95_m: 3.1e-05}       # its known uncertainty
result: {…}                      # the numbers themselves
covariance: [[…]]                # of the result, if it has one
hash: sha256 of all above
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from drivers.interfaces import FloatArray

FORMAT = "cell-calibration/2"
KINDS = ("camera", "cell", "time", "grip")

_KEYS = ("format", "kind", "made", "how", "devices", "error", "result", "covariance", "hash")


class CalibrationFileError(ValueError):
    """A calibration file cannot be used: which file, which key, why, and the remedy.

    Scenario: a file of another format; a number changed by hand, to which the stated error no
    longer applies.
    """


@dataclass(frozen=True, eq=False)
class StoredCalibration:
    """A stored calibration: kind, date, method, devices, stated errors, result."""

    kind: str
    made: datetime
    how: Mapping[str, Any]
    devices: Mapping[str, Any]
    error: Mapping[str, float]
    result: Mapping[str, Any]
    covariance: FloatArray = field(default_factory=lambda: np.empty((0, 0)))

    def age_h(self, now: datetime) -> float:
        """Hours since it was made."""
        return (now - self.made).total_seconds() / 3600.0

    def number(self, name: str) -> float:
        """A number of the result.  Raises CalibrationFileError: it is none."""
        value = self.result.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise CalibrationFileError(self._wrong(f"{name} = {value!r} is no number"))
        return float(value)

    def array(self, name: str, shape: tuple[int, ...]) -> FloatArray:
        """An array of the result.  Raises CalibrationFileError: wrong shape, or not finite."""
        try:
            value = np.asarray(self.result.get(name), dtype=np.float64)
        except (TypeError, ValueError):
            value = np.empty(0)
        if value.shape != shape or not np.all(np.isfinite(value)):
            raise CalibrationFileError(self._wrong(f"{name} must be {shape} finite numbers"))
        return value

    def _wrong(self, problem: str) -> str:
        """Message about an entry of the result that cannot be used, with the remedy."""
        return f"{self.kind}: result.{problem}; run `cell calibrate {self.kind}` again"


def save(path: Path, stored: StoredCalibration) -> None:
    """Write a calibration atomically; `load` returns the same numbers."""
    tree = _tree(stored)
    tree["hash"] = _hash(tree)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    text = yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, default_flow_style=None)
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError):  # which knows no name when a disk is full
            raise type(error)(error.errno, error.strerror, str(path)) from error
        raise


def load(path: Path, kind: str) -> StoredCalibration:
    """A calibration of a given kind.  Raises CalibrationFileError, naming file, key and remedy."""
    remedy = f"run `cell calibrate {kind}`"
    if path.is_dir():
        raise CalibrationFileError(f"{path}: is a folder; remove it, then {remedy}")
    try:
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise CalibrationFileError(f"{path}: {error.strerror}; {remedy}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise CalibrationFileError(f"{path}: not YAML: {error}; {remedy}") from error
    if not isinstance(tree, dict) or tree.get("format") != FORMAT:
        form = tree.get("format") if isinstance(tree, dict) else None
        raise CalibrationFileError(f"{path}: format: {form!r}; must be {FORMAT!r}; {remedy}")
    missing = [key for key in _KEYS if key not in tree]
    if missing:
        raise CalibrationFileError(f"{path}: {missing[0]}: missing; {remedy}")
    if tree["kind"] != kind:
        raise CalibrationFileError(f"{path}: kind: {tree['kind']!r}; must be {kind!r}; {remedy}")
    stated_hash = tree.pop("hash")
    if stated_hash != _hash(tree):
        raise CalibrationFileError(
            f"{path}: hash: was changed since it was made, so that nothing says how good it is; "
            f"{remedy}, or type the numbers into the settings"
        )
    for key in ("how", "devices", "error", "result"):
        if not isinstance(tree[key], dict):
            raise CalibrationFileError(f"{path}: {key}: must be a mapping; {remedy}")
    try:
        made = datetime.fromisoformat(str(tree["made"]))
    except ValueError as error:
        raise CalibrationFileError(
            f"{path}: made: {tree['made']!r} is no time; {remedy}"
        ) from error
    covariance = np.asarray(tree["covariance"] or np.empty((0, 0)), dtype=np.float64)
    return StoredCalibration(
        kind, made.replace(tzinfo=made.tzinfo or UTC), tree["how"], tree["devices"],
        tree["error"], tree["result"], covariance,
    )  # fmt: skip


def _tree(stored: StoredCalibration) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "kind": stored.kind,
        "made": stored.made.isoformat(timespec="seconds"),
        "how": _plain(stored.how),
        "devices": _plain(stored.devices),
        "error": _plain(stored.error),
        "result": _plain(stored.result),
        "covariance": _plain(stored.covariance),
    }


def _plain(value: Any) -> Any:
    """The value in Python's own types."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.floating | np.integer):
        return value.item()
    return value


def _hash(tree: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(tree, sort_keys=True, default=str).encode()).hexdigest()
