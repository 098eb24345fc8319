"""The folder that a cycle leaves behind, written while it happens and readable at any moment.

runs/<time>-<n>/
  state.json      where the cycle is, or was when it ended; `closed` once nothing more comes
  settings.yaml   as resolved
  study/          identification and execution, in the form cable-study/1
  model.json      this cable's parameters
  result.json     how it ended
  *.png           pictures with what was seen and predicted drawn over them
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from cell.files.located import InputError, Problem
from cell.records.result import Result
from cell.study.data import Study
from cell.study.folder import read_study, write_study

FORMAT = "cable-cycle/1"


class Record:
    """Writes one cycle's folder.  Every file is replaced whole, so that none is ever half there."""

    def __init__(self, runs: Path, cycle: int, started: datetime) -> None:
        """Create `runs/<time>-<cycle>`.  Raises OSError: it cannot be made, or is there already."""
        self.folder = runs / f"{started:%Y%m%dT%H%M%S}.{started.microsecond // 1000:03d}-{cycle}"
        self.folder.mkdir(parents=True)
        self._state: dict[str, Any] = {"format": FORMAT, "cycle": cycle, "closed": False}

    def state(self, **entries: Any) -> None:
        """Replace entries of `state.json`."""
        self._state.update(entries)
        self._write("state.json", _json(self._state))

    def settings(self, settings: Mapping[str, Any]) -> None:
        """Settings as resolved."""
        text = yaml.safe_dump(dict(settings), sort_keys=False, allow_unicode=True)
        self._write("settings.yaml", text.encode())

    def study(self, study: Study) -> None:
        """What was measured so far; replaces what was there."""
        write_study(study, self.folder / "study")

    def model(self, model: Mapping[str, Any]) -> None:
        """This cable's parameters."""
        self._write("model.json", _json(model))

    def pictures(self, images: Mapping[str, NDArray[np.uint8]]) -> None:
        """Pictures (H, W, 3), blue first, each as its name with .png."""
        for name, image in images.items():
            done, data = cv2.imencode(".png", image)
            if not done:
                raise ValueError(f"picture {name} of shape {image.shape} cannot be encoded")
            self._write(f"{name}.png", data.tobytes())

    def close(self, result: Result) -> None:
        """Write the result and the mark that nothing more comes."""
        self._write("result.json", _json(result.to_json()))
        self.state(closed=True, outcome=result.outcome.value)

    def _write(self, name: str, data: bytes) -> None:
        part = self.folder / f"{name}.part"
        part.write_bytes(data)
        part.replace(self.folder / name)


@dataclass(frozen=True)
class Recorded:
    """What a folder holds; None = the cycle did not come so far.

    closed   whether the cycle ended by itself, with a result, and was not killed
    step     the step in which it ended, or was killed
    """

    folder: Path
    cycle: int
    closed: bool
    step: str | None
    state: Mapping[str, Any]
    study: Study | None
    model: Mapping[str, Any] | None
    result: Result | None


def read_record(folder: Path) -> Recorded:
    """Read a cycle's folder, however the cycle ended.

    raises  InputError: it is not such a folder, or a file in it was changed and is wrong now
    """
    state = _read_json(folder / "state.json")
    if state is None:
        raise InputError(
            [Problem(folder / "state.json", 1, None, "", "is missing: not a cycle's folder")]
        )
    if state.get("format") != FORMAT:
        message = f"format is {state.get('format')!r}, not {FORMAT!r}"
        raise InputError([Problem(folder / "state.json", 1, None, "", message)])
    result = _read_json(folder / "result.json")
    return Recorded(
        folder=folder,
        cycle=int(state["cycle"]),
        closed=bool(state["closed"]),
        step=state.get("step"),
        state=state,
        study=read_study(folder / "study") if (folder / "study" / "study.yaml").exists() else None,
        model=_read_json(folder / "model.json"),
        result=None if result is None else Result.from_json(result),
    )


def _read_json(path: Path) -> dict[str, Any] | None:
    if not path.exists():
        return None
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise InputError(
            [Problem(path, error.lineno, error.colno, "", f"is not JSON: {error.msg}")]
        ) from error
    if not isinstance(data, dict):
        raise InputError([Problem(path, 1, 1, "", "must hold a JSON object")])
    return data


def _json(data: Mapping[str, Any]) -> bytes:
    return (json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()
