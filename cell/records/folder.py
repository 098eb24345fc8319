"""The folder of a cycle's records, written while it happens and readable at any moment.

runs/<time>-<n>/
  state.json      where the cycle is, or was when it ended; `closed` once nothing more comes
  settings.yaml   as resolved
  study/          identification and execution, in the form cable-study/1
  model.json      this cable's parameters
  result.json     how it ended
  *.jpg           pictures with an overlay of detections and predictions
  reserve         room on the disk for the cycle's end; gone when it is closed

The past cycles in a folder of such folders are summarised by their outcomes and pictures.
"""

from __future__ import annotations

import json
import re
import reprlib
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from cell.files.atomic import free_bytes, write_atomic
from cell.files.input_error import InputError
from cell.files.text_file import MAX_JSON_BYTES, read_json_object, read_text
from cell.files.yaml_document import MAX_PROBLEMS, Document, document_of, yaml_text
from cell.records.result import Result, result_adapter
from cell.study.data import Study
from cell.study.folder import read_study, write_study

#: JPEG quality of pictures with an overlay: an eighth of the bytes of PNG, without visible loss.
JPEG_QUALITY = 90

FORMAT = "cable-cycle/1"
_TIME = "%Y%m%dT%H%M%S.%f"
_NAME = re.compile(r"(\d{8}T\d{6}\.\d{3})-(\d+)")
_AS_WRITTEN = "give the file as it was written, or leave the folder out"

#: Enough for state and result, which are written when a cycle ends.
RESERVE_BYTES = 64 * 1024
_RESERVE = "reserve"
#: With less on the disk no cycle begins: tables, pictures and a model take up to 4 MB.
LEAST_FREE_BYTES = 8 * 2**20


class RecordError(OSError):
    """A cycle's folder cannot be written.  Scenario: the disk fills up while a cable swings."""


class Record:
    """Writes one cycle's folder.  Every file is replaced atomically.

    Room for the result is reserved at the beginning, and used when the disk is full.

    raises  RecordError, from every method
    """

    def __init__(self, runs: Path, cycle: int, started: datetime) -> None:
        """Create `runs/<local time>-<cycle>`.  Raises RecordError also if it is there already."""
        self.folder = runs / f"{started:%Y%m%dT%H%M%S}.{started.microsecond // 1000:03d}-{cycle}"
        self._reserve = self.folder / _RESERVE
        with self._write_errors():
            self.folder.mkdir(parents=True)
            write_atomic(self._reserve, bytes(RESERVE_BYTES))
        at = started.astimezone(UTC).isoformat()
        self._state: dict[str, Any] = {"format": FORMAT, "cycle": cycle, "closed": False}
        self._state["started"] = at
        self._writer = ThreadPoolExecutor(1, "state.json")
        self._written: Future[None] | None = None

    def check_room(self) -> None:
        """Raise RecordError if the disk has no room for the record of a cycle."""
        free = free_bytes(self.folder)
        if free < LEAST_FREE_BYTES:
            raise RecordError(
                f"{free / 1e6:.1f} MB are free on the disk of {self.folder}, the record of a cycle "
                f"needs {LEAST_FREE_BYTES / 1e6:.1f} MB"
            )

    def state(self, **entries: Any) -> None:
        """Replace entries of `state.json`."""
        self._write_state(entries).result()

    def state_soon(self, **entries: Any) -> None:
        """Replace entries of `state.json` in a thread: a waiting gripper waits for no disk.

        raises  RecordError: the state before could not be written
        """
        before = self._written
        self._written = self._write_state(entries)
        if before is not None and before.done():
            before.result()

    def settings(self, settings: Mapping[str, Any]) -> None:
        """Settings as resolved."""
        self._write("settings.yaml", _yaml_of(json.dumps(settings)))

    def study(self, study: Study) -> None:
        """Write the trials so far as a study; replaces an earlier one."""
        with self._write_errors():
            write_study(study, self.folder / "study", recorded=True)

    def model(self, model: Mapping[str, Any]) -> None:
        """This cable's parameters."""
        self._write("model.json", _json(model))

    def pictures(self, images: Mapping[str, NDArray[np.uint8]]) -> None:
        """Pictures (H, W, 3), blue first, each as its name with .jpg."""
        for name, image in images.items():
            done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            if not done:
                raise ValueError(f"picture {name} of shape {image.shape} cannot be encoded")
            self._write(f"{name}.jpg", data.tobytes())

    def close(self, result: Result) -> None:
        """Write the result and the mark that the record is complete."""
        self.use_reserve()
        self._write("result.json", _json(result.to_json()))
        self.state(closed=True, outcome=result.outcome.value)
        self._writer.shutdown()

    def use_reserve(self) -> None:
        """Free the room that was reserved: the cycle is about to end."""
        with self._write_errors():
            self._reserve.unlink(missing_ok=True)

    def _write_state(self, entries: Mapping[str, Any]) -> Future[None]:
        self._state.update(entries)
        return self._writer.submit(self._write, "state.json", _json(self._state))

    def _write(self, name: str, content: str | bytes) -> None:
        with self._write_errors():
            write_atomic(self.folder / name, content)

    @contextmanager
    def _write_errors(self) -> Iterator[None]:
        """Turn an OSError into RecordError, with the folder."""
        try:
            yield
        except OSError as error:
            cause = f"the record cannot be written: {error.strerror or error}: {self.folder}"
            raise RecordError(cause) from error


class LaterRecord(Record):
    """Record of a cycle that is being prepared: its folder is created when the cycle begins.

    Until then its state is kept in memory; there are neither studies nor pictures yet.
    """

    def __init__(self, runs: Path, cycle: int) -> None:
        self.folder = runs
        self._cycle = cycle
        self._state: dict[str, Any] = {}

    def state(self, **entries: Any) -> None:
        """Keep entries of the state for the folder."""
        self._state.update(entries)

    state_soon = state

    def opened(self, started: datetime) -> Record:
        """The record with its folder.  Raises RecordError."""
        record = Record(self.folder, self._cycle, started)
        if self._state:
            record.state(**self._state)
        return record

    def close(self, result: Result) -> None:
        """Do nothing: there is no folder."""

    def use_reserve(self) -> None:
        """Do nothing: there is no reserve."""

    def _write(self, name: str, content: str | bytes) -> None:
        """Do nothing: there is no folder."""


@lru_cache(maxsize=8)
def _yaml_of(settings: str) -> str:
    """Settings in JSON as YAML; those of a product stay the same from cycle to cycle."""
    return yaml_text(json.loads(settings))


def acknowledge_record(folder: Path, by: str, note: str) -> None:
    """Mark that a person has acknowledged the end of a cycle.

    A state that cannot be read is renamed to `state.json.unreadable`.
    raises  RecordError
    """
    path = folder / "state.json"
    number = cycle_of(folder)
    state: dict[str, Any] = {"format": FORMAT}
    if number is not None:
        state |= {"cycle": number, "closed": False}
    try:
        try:
            state = {**(read_state(folder) or state)}
        except InputError:
            path.replace(path.with_name(f"{path.name}.unreadable"))
        state["acknowledged"] = {"by": by, "note": note}
        write_atomic(path, _json(state))
    except OSError as error:
        raise RecordError(f"the record cannot be written: {error.strerror}: {path}") from error


@dataclass(frozen=True)
class Recorded:
    """The content of a cycle's folder; None = the cycle did not come so far.

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


def cycle_of(folder: Path) -> int | None:
    """Number of the cycle of a folder, from its name; None = it is no cycle's folder."""
    name = _NAME.fullmatch(folder.name)
    if name is None or not folder.is_dir():
        return None
    try:
        datetime.strptime(name[1], _TIME)
    except ValueError:
        return None
    return int(name[2])


def started_of(folder: Path, state: Mapping[str, Any] | None) -> datetime:
    """When the cycle of a folder began, with a time zone.

    Folders of older versions have it in their name only, in local time.
    raises  ValueError: the folder's name is no cycle's
    """
    with suppress(KeyError, TypeError, ValueError, OverflowError):
        return datetime.fromisoformat((state or {})["started"]).astimezone()
    return datetime.strptime(folder.name.rpartition("-")[0], _TIME).astimezone()


def pictures_in(folder: Path) -> list[Path]:
    """Pictures of a cycle, by name; older versions wrote PNG."""
    files = (p for p in folder.iterdir() if p.suffix in (".jpg", ".png"))
    return sorted(p for p in files if p.is_file() and not p.is_symlink())


def is_cycle(folder: Path) -> bool:
    """Whether a folder is a cycle's, even of one that was killed before it had a state."""
    return (folder / "state.json").exists() or (folder / _RESERVE).exists()


def read_record(folder: Path) -> Recorded:
    """Read a cycle's folder, however the cycle ended.

    raises  InputError: it is not such a folder, or a file in it was changed and is wrong now
    """
    state = read_state(folder)
    if state is None:
        raise InputError.at(
            folder / "state.json",
            "is missing: not a cycle's folder; `cell list` shows those there are",
        )
    return Recorded(
        folder=folder,
        cycle=state["cycle"],
        closed=state["closed"],
        step=state.get("step"),
        state=state,
        study=read_study(folder / "study") if (folder / "study" / "study.yaml").exists() else None,
        model=read_model(folder),
        result=read_result(folder),
    )


class _ReadEntries(BaseModel):
    """What readers use of a file, its numbers finite; other entries are kept."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)


class _CycleState(_ReadEntries):
    format: Literal["cable-cycle/1"]
    cycle: int
    closed: bool
    step: str | None = None
    outcome: str | None = None
    product: str | None = None


class _ModelParameter(_ReadEntries):
    name: str
    value: float
    low: float
    high: float
    unit: str


class _CycleModel(_ReadEntries):
    parameters: list[_ModelParameter]


_Content = TypeVar("_Content")


def read_state(folder: Path) -> Mapping[str, Any] | None:
    """State of a cycle; None = no such file.  Raises InputError: it is wrong."""
    state = _read(folder / "state.json", TypeAdapter(_CycleState))
    return None if state is None else state.model_dump(exclude_unset=True)


def read_model(folder: Path) -> Mapping[str, Any] | None:
    """Model of a cycle's cable; None = no such file.  Raises InputError: it is wrong."""
    model = _read(folder / "model.json", TypeAdapter(_CycleModel))
    return None if model is None else model.model_dump()


def read_result(folder: Path) -> Result | None:
    """Result of a cycle; None = no such file.  Raises InputError: it is wrong."""
    return _read(folder / "result.json", result_adapter())


def _read(path: Path, adapter: TypeAdapter[_Content]) -> _Content | None:
    if not path.exists():
        return None
    data = read_json_object(path)
    try:
        return adapter.validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        try:
            document = document_of(read_text(path, MAX_JSON_BYTES), path)
        except InputError:  # JSON that is no YAML: without lines
            document = Document(path, data, {(): (1, 1)})
        problems = []
        for each in error.errors()[:MAX_PROBLEMS]:
            found = f"{each['msg'].removeprefix('Input ')}, not {reprlib.repr(each['input'])}"
            message = "is missing" if each["type"] == "missing" else found
            problems.append(document.problem(each["loc"], f"{message}; {_AS_WRITTEN}"))
        raise InputError(problems) from error


def _json(data: Mapping[str, Any]) -> str:
    return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


#: Outcome of a cycle without a result.
UNFINISHED = "running or killed"


@dataclass(frozen=True)
class PastCycle:
    """Summary of a past cycle.

    started             with a time zone
    outcome             as in its result; "running or killed" without one; "unreadable"
    step                in which it ended
    offset_m, prediction_error_m   None = not known
    pictures            names of its picture files, sorted
    """

    folder: Path
    started: datetime
    cycle: int
    outcome: str
    step: str = ""
    offset_m: float | None = None
    prediction_error_m: float | None = None
    pictures: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return vars(self) | {
            "folder": str(self.folder),
            "started": self.started.isoformat(),
            "pictures": list(self.pictures),
        }


def history(runs: Path) -> tuple[PastCycle, ...]:
    """All cycles with a folder in `runs`, the newest last.

    Folders of another kind are skipped; a cycle with broken files has the outcome "unreadable".
    raises  InputError: `runs` is no folder
    """
    if not runs.is_dir():
        message = "is no folder of cycles; give the one that `cell run --runs` wrote to"
        raise InputError.at(runs, message)
    past = [_past(f, number) for f in runs.iterdir() if (number := cycle_of(f)) is not None]
    return tuple(sorted(past, key=lambda p: (p.started, p.cycle)))


def newest(runs: Path) -> Path:
    """Folder of the newest cycle.  Raises InputError: there is none."""
    past = history(runs)
    if not past:
        raise InputError.at(runs, "holds no cycle; run one with `cell run`")
    return past[-1].folder


def _past(folder: Path, cycle: int) -> PastCycle:
    state: Mapping[str, Any] | None = None
    try:
        state, result = read_state(folder), read_result(folder)
    except (OSError, InputError):
        return PastCycle(folder, started_of(folder, state), cycle, "unreadable")
    return PastCycle(
        folder,
        started_of(folder, state),
        cycle,
        UNFINISHED if result is None else result.outcome.value,
        (state or {}).get("step") or "",
        None if result is None else result.offset_m,
        None if result is None else result.prediction_error_m,
        tuple(picture.name for picture in pictures_in(folder)),
    )
