"""Reads and writes studies as folders in the form cable-study/1: one YAML file and CSV tables."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from cell.cable.geometry import Cable, Motion, Start
from cell.files.atomic import write_all
from cell.files.input_error import InputError, Problem
from cell.files.text_file import read_text
from cell.files.words import counted
from cell.files.yaml_document import (
    Complaint,
    Document,
    Key,
    document_of,
    read_yaml,
    validate,
    yaml_text,
)
from cell.study.clocks import cut_off, gap
from cell.study.data import Markers, Source, Study, Trial, WrenchSensor
from cell.study.entries import (
    CableSection,
    Finite,
    Positive,
    SectionPart,
    TrialName,
    datasheet_of,
    implausible_entries,
)
from cell.study.hand_drift import HandDrift, drift_complaint
from cell.study.import_checks import log_begins, log_ends, log_gap
from cell.study.table import MAX_BYTES, Table, check_times, read_table, table_text
from cell.study.trial_checks import trial_problems
from cell.study.wrench import FILE as WRENCH_FILE
from cell.study.wrench import (
    SensorEntry,
    force_problems,
    read_wrench,
    sensor_entry,
    wrench_text,
)

FORMAT = "cable-study/1"
GRIP_COLUMNS = ("t_s", "x_m", "y_m", "angle_rad")

#: Tolerance of the test whether successive angles differ by a full turn, rad.
AS_A_TURN_RAD = 0.5
#: Limit beyond which a unit is assumed to be wrong.
MAX_DISTANCE_M = 100.0
#: Limit of a marker's coordinates; smaller ones are reported with their distance from the gripper.
MAX_COORDINATE_M = 1e6

#: Largest number of frames that are read of a trial; a fit's time and memory grow with them.
MAX_FRAMES = 5_000
MAX_MARKERS = 200
MAX_TRIALS = 500


def _each(value: object) -> object:
    """A list with one number for all markers."""
    return [value] if isinstance(value, int | float | str) else value


class _Cable(CableSection):
    free_length_m: Positive
    line_density_kg_per_m: Positive


class _Markers(SectionPart):
    arc_length_m: Annotated[list[Finite], Field(min_length=1, max_length=MAX_MARKERS)]
    arc_length_std_m: Annotated[list[Finite], BeforeValidator(_each)] | None = None


class _TrialSection(SectionPart):
    name: TrialName
    role: Literal["fit", "validate"]
    start: Start
    release_s: Finite | None = None
    hand_drift: HandDrift | None = None


class _WrittenTable(SectionPart):
    rows: Annotated[int, Field(ge=0)]
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class _Study(SectionPart):
    format: Literal["cable-study/1"]
    name: Annotated[str, Field(min_length=1)]
    cable: _Cable
    gravity_m_per_s2: tuple[Finite, Finite] = (0.0, -9.81)
    markers: _Markers
    noise_std_m: Positive | None = None
    wrench: SensorEntry | None = None
    trials: Annotated[list[_TrialSection], Field(min_length=1, max_length=MAX_TRIALS)]
    tables: dict[str, _WrittenTable] = Field(default_factory=dict)


def read_study(folder: Path) -> Study:
    """The study in a folder, markers ordered tip first whatever their order in the file.

    A trial of more than `MAX_FRAMES` frames is thinned to every second, third, … frame.  This, and
    unusual but possible data, are reported in the study's notes.

    raises  InputError: a file is missing or wrong; every problem names file, line, value,
            limit and remedy
    """
    study, problems = study_as_it_is(folder)
    if problems:
        raise InputError(problems)
    return study


def study_as_it_is(folder: Path) -> tuple[Study, list[Problem]]:
    """The study with every readable trial, and the problems for which `read_study` refuses it.

    raises  InputError: no trial can be read
    """
    document = read_yaml(folder / "study.yaml")
    data = document.data if isinstance(document.data, dict) else {"markers": None}
    if "markers" not in data and [*folder.glob(f"*/{WRENCH_FILE}")]:
        message = (
            "is missing: a wrench alone does not show where the cable is; track one point of the "
            "cable at least, such as its tip, and give its arc_length_m and its markers.csv"
        )
        raise InputError([document.problem(("markers",), message)])
    header = validate(document, _Study)
    cable = datasheet_of(header.cable.model_dump(exclude_none=True))
    problems = _implausible(document, header, cable)
    if cable is None or problems:
        raise InputError(problems)

    arc_length_m = np.array(header.markers.arc_length_m)
    order = np.argsort(-arc_length_m)
    std_m = header.markers.arc_length_std_m
    sensor = WrenchSensor() if header.wrench is None else header.wrench.sensor()
    trials: list[Trial] = []
    notes: list[str] = []
    for i, trial in enumerate(header.trials):
        try:
            read = _read_trial(folder / trial.name, trial, header, order)
        except InputError as error:
            problems.extend(error.problems)
            continue
        if (complaint := read.release_complaint) is not None:
            problems.append(document.problem(("trials", i, "release_s"), complaint))
            continue
        refusals, odd = trial_problems(read, cable, arc_length_m[order], header.gravity_m_per_s2)
        problems += refusals
        notes += odd
        where = folder / trial.name / WRENCH_FILE
        refusals, odd = force_problems(read, cable, float(arc_length_m.max()), sensor, where)
        problems += refusals
        notes += odd
        selected, step = thinned(read)
        if step > 1:
            markers = folder / trial.name / "markers.csv"
            notes.append(
                f"{markers}: one of every {step} of the {len(read.markers.t_s)} frames is taken; "
                f"a swing needs no more than {MAX_FRAMES}"
            )
        trials.append(selected)
    if not trials:
        raise InputError(problems)
    files = [folder / t.name / WRENCH_FILE for t in header.trials]
    if header.wrench is not None and not any(f.exists() for f in files):
        remedy = f"is given, but no trial has a {WRENCH_FILE}; add one, or remove the key"
        problems.append(document.problem(("wrench",), remedy))
    study = Study(
        name=header.name,
        cable=cable,
        arc_length_m=arc_length_m[order],
        trials=tuple(trials),
        gravity_m_per_s2=header.gravity_m_per_s2,
        noise_std_m=header.noise_std_m,
        notes=tuple(notes),
        arc_length_std_m=None if std_m is None else np.broadcast_to(std_m, order.shape)[order],
        sensor=sensor,
    )
    return study, problems


def study_folder(folder: Path) -> Path:
    """The folder of a study, from it, its `study.yaml`, or a recorded cycle with `study/`.

    raises  InputError: it is no such file, or holds several cycles
    """
    if folder.is_file():
        if folder.name == "study.yaml":
            return folder.parent
        raise InputError.at(folder, "is a file; give the folder that holds study.yaml")
    if (folder / "study.yaml").exists():
        return folder
    if (folder / "study" / "study.yaml").exists():
        return folder / "study"
    cycles = sorted(p.parents[1].name for p in folder.glob("*/study/study.yaml"))
    if cycles:
        raise InputError.at(
            folder,
            f"holds recorded cycles, not a study; name one of them, {folder / cycles[0]} for one, "
            f"or gather those of one cable: cell study {folder}/* -o STUDY",
        )
    return folder


def write_study(study: Study, folder: Path | str, *, recorded: bool = False) -> None:
    """Write a study so that `read_study` gives it back to the last bit.

    recorded  these are a cycle's measurements: `study.yaml` also holds the rows and the SHA-256 of
              each table, and a table that was cut or changed is refused when it is read

    All files are written before the first is renamed, `study.yaml` last: if the disk is full, a
    reader gets the former study.

    raises  ValueError: `read_study` would refuse the study; nothing has changed
            OSError: it cannot be written; nothing has changed
    """
    folder = Path(folder)
    if not recorded:
        check_study(study)
    tables = tables_of(study)
    header = header_of(study)
    if recorded:
        header["tables"] = {name: _table_entry(text) for name, text in tables.items()}
    files = {folder / name: text for name, text in tables.items()}
    write_all({**files, folder / "study.yaml": yaml_text(header)})


def tables_of(study: Study) -> dict[str, str]:
    """Text of each table of a study, by its name in the folder; it gives every number exactly."""
    tables: dict[str, str] = {}
    for trial in study.trials:
        grip, markers = trial.grip, trial.markers
        tables[f"{trial.name}/grip.csv"] = table_text(
            GRIP_COLUMNS,
            np.column_stack([grip.t_s, grip.x_m, grip.y_m, grip.angle_rad]),
        )
        tables[f"{trial.name}/markers.csv"] = table_text(
            _marker_columns(len(study.arc_length_m)),
            np.column_stack([markers.t_s, markers.xy_m.reshape(len(markers.t_s), -1)]),
        )
        if trial.wrench is not None:
            tables[f"{trial.name}/{WRENCH_FILE}"] = wrench_text(trial.wrench)
    return tables


def check_study(study: Study) -> None:
    """Raise ValueError if names, roles, starts, datasheet or shapes are not those of a study.

    The messages are those of `read_study`.
    """
    document = document_of(yaml_text(header_of(study)), Path("study.yaml"))
    try:
        header = validate(document, _Study)
        cable = datasheet_of(header.cable.model_dump(exclude_none=True))
        if problems := _implausible(document, header, cable):
            raise InputError(problems)
    except InputError as error:
        message = "\n".join(f"study {study.name!r}: {p.key}: {p.message}" for p in error.problems)
        raise ValueError(message) from error
    count = len(study.arc_length_m)
    for trial in study.trials:
        if (complaint := trial.release_complaint) is not None:
            raise ValueError(f"trial {trial.name!r}: release_s: {complaint}")
        needed = (len(trial.markers.t_s), count, 2)
        if trial.markers.xy_m.shape != needed:
            raise ValueError(
                f"trial {trial.name!r}: markers.xy_m has shape {trial.markers.xy_m.shape}, needs "
                f"{needed}: a row per time of t_s, an x and a y per marker of arc_length_m"
            )


def header_of(study: Study) -> dict[str, object]:
    """Content of `study.yaml`."""
    header: dict[str, object] = {
        "format": FORMAT,
        "name": study.name,
        "cable": study.cable.to_dict(),
        "gravity_m_per_s2": [float(g) for g in study.gravity_m_per_s2],
        "markers": _markers_entry(study),
    }
    if study.noise_std_m is not None:
        header["noise_std_m"] = float(study.noise_std_m)
    if entry := sensor_entry(study.sensor):
        header["wrench"] = entry
    header["trials"] = [_trial_entry(t) for t in study.trials]
    return header


def _table_entry(text: str) -> dict[str, object]:
    """Entry of a recorded table in `study.yaml`: rows below its header, and SHA-256."""
    rows = max(0, text.count("\n") - 1)
    return {"rows": rows, "sha256": hashlib.sha256(text.encode()).hexdigest()}


def _check_as_written(path: Path, meta: _WrittenTable | None) -> None:
    """Raise InputError if a recorded table was cut or changed."""
    if meta is None or not path.exists():
        return
    there = _table_entry(read_text(path, MAX_BYTES))
    if there["sha256"] == meta.sha256:
        return
    rows = there["rows"]
    differs = f"has {rows} rows, {meta.rows} were recorded" if rows != meta.rows else "was changed"
    raise InputError.at(
        path,
        f"{differs}: it is not as the cycle wrote it; copy it whole again, or give the cycle's "
        "recording; if it was changed on purpose, remove it from `tables` in study.yaml",
    )


def _trial_entry(trial: Trial) -> dict[str, object]:
    entry = {
        "name": trial.name,
        "role": trial.role,
        "start": trial.start,
        "release_s": None if trial.release_s is None else float(trial.release_s),
        "hand_drift": None if trial.hand_drift is None else trial.hand_drift.to_plain(),
    }
    return {key: value for key, value in entry.items() if value is not None}


def _markers_entry(study: Study) -> dict[str, list[float]]:
    entry = {"arc_length_m": study.arc_length_m, "arc_length_std_m": study.arc_length_std_m}
    return {k: [float(s) for s in v] for k, v in entry.items() if v is not None}


def _marker_columns(count: int) -> tuple[str, ...]:
    return ("t_s", *(f"{axis}{i}_m" for i in range(count) for axis in "xy"))


def _implausible(document: Document, header: _Study, datasheet: Cable | None) -> list[Problem]:
    """Problems beyond the schema: wrong units and entries that contradict each other."""
    complaints = [
        *implausible_entries(
            header.cable.model_dump(exclude_none=True),
            datasheet,
            header.gravity_m_per_s2,
            header.markers.arc_length_m,
            header.noise_std_m,
            header.markers.arc_length_std_m or (),
        ),
        *_contradictions(header.trials),
    ]
    return document.problems(complaints)


def _contradictions(trials: Sequence[_TrialSection]) -> Iterator[Complaint]:
    """Trials with the same name; a release or a drift of the gripper that contradicts its trial."""
    first_index: dict[str, int] = {}
    for i, trial in enumerate(trials):
        key: Key = ("trials", i)
        if trial.name in first_index:
            message = f"{trial.name!r} is also trial {first_index[trial.name] + 1}; rename one"
            yield (*key, "name"), message
        first_index.setdefault(trial.name, i)
        if trial.start in ("straight", "held") and trial.release_s is None:
            needs = f"is missing; `start: {trial.start}` needs the time of letting go"
            yield (*key, "release_s"), needs
        if trial.start in ("equilibrium", "moving") and trial.release_s is not None:
            only = "is only for `start: straight` and `held`; remove it or change `start`"
            yield (*key, "release_s"), only
        if (drifts := drift_complaint(trial.hand_drift)) is not None:
            yield (*key, "hand_drift", "to_s"), drifts


def read_grip(path: Path) -> Motion:
    """Read the log of a gripper: t_s, x_m, y_m, angle_rad.  Raises InputError."""
    return Motion(*_log(path).values.T)


def _log(path: Path) -> Table:
    """The same with its lines."""
    grip = read_table(path, GRIP_COLUMNS)
    check_times(grip)
    grip.check(np.isfinite(grip.values), lambda _: "is not a number; the grip is always known")
    grip.check(
        np.abs(grip.values) <= [np.inf, MAX_DISTANCE_M, MAX_DISTANCE_M, 2 * np.pi],
        lambda name: (
            "is beyond ±2π; give radians, not degrees"
            if name == "angle_rad"
            else f"is beyond ±{MAX_DISTANCE_M:g} m; give metres"
        ),
    )
    _check_continuous(grip)
    return grip


def _check_continuous(log: Table) -> None:
    """Raise InputError if a gripper moves while nothing is logged, or its angle jumps by a turn."""
    angle_rad = log.values[:, 3]
    jumps = np.abs(np.abs(np.diff(angle_rad)) - 2.0 * np.pi) < AS_A_TURN_RAD
    if jumps.any():
        row = int(np.argmax(jumps)) + 1
        raise log.error(
            log.lines[row],
            "angle_rad",
            f"{angle_rad[row]:.4g} comes after {angle_rad[row - 1]:.4g} of the row before, a whole "
            "turn away; write angles that go on over ±π, within ±2π",
        )
    log_jump = gap(log.values)
    if log_jump is not None:
        raise log.error(log.lines[log_jump.row], "t_s", log_gap.sentence(log_jump.values))


def _check_covers(log: Table, markers: Markers) -> None:
    """Raise InputError if a gripper's log ends or begins in motion, within its cable's frames."""
    detected_s = markers.t_s[np.isfinite(markers.xy_m).any(axis=(1, 2))]
    end = cut_off(log.values, float(detected_s[0]), float(detected_s[-1]))
    if end is not None:
        row, check = (-1, log_ends) if end.at_end else (0, log_begins)
        raise log.error(log.lines[row], "t_s", check.sentence(end.values))


def _read_trial(
    folder: Path, trial: _TrialSection, header: _Study, order: NDArray[np.intp]
) -> Trial:
    for file in ("grip.csv", "markers.csv", WRENCH_FILE):
        _check_as_written(folder / file, header.tables.get(f"{trial.name}/{file}"))
    log = _log(folder / "grip.csv")
    motion = Motion(*log.values.T)
    count = len(header.markers.arc_length_m)
    there = folder / WRENCH_FILE
    if there.exists() and not (folder / "markers.csv").exists():
        message = (
            "is missing: a wrench alone does not show where the cable is; track one point of the "
            f"cable at least, such as its tip, and give {', '.join(_marker_columns(count)[:3])}"
        )
        raise InputError.at(folder / "markers.csv", message)
    table = read_table(folder / "markers.csv", _marker_columns(count))
    check_times(table)
    t_s = table.values[:, 0]
    xy_m = table.values[:, 1:].reshape(len(t_s), count, 2)
    if np.isnan(xy_m).all():
        raise table.error(
            2,
            None,
            f"no marker is seen in any of {counted(len(t_s), 'row')}; remove the trial or its nan",
        )
    if t_s[-1] < motion.t_s[0] or t_s[0] > motion.t_s[-1]:
        raise table.error(
            2,
            "t_s",
            f"markers span {t_s[0]:g} … {t_s[-1]:g} s, grip.csv {motion.t_s[0]:g} … "
            f"{motion.t_s[-1]:g} s, without overlap; put both on one clock, in seconds",
        )
    table.check(
        ~(np.abs(table.values) > [np.inf, *[MAX_COORDINATE_M] * (2 * count)]),
        lambda _: f"is beyond ±{MAX_COORDINATE_M:g} m; give metres",
    )
    source = Source(table.path, np.array(table.lines), order)
    markers = Markers(t_s, xy_m[:, order], source)
    _check_covers(log, markers)
    wrench = read_wrench(there, motion) if there.exists() else None
    timing = trial.start, motion, markers, trial.release_s
    return Trial(trial.name, trial.role, *timing, trial.hand_drift, wrench)


def thinned(trial: Trial) -> tuple[Trial, int]:
    """The trial with every k-th frame, at most `MAX_FRAMES`; and k."""
    markers = trial.markers
    step = -(-len(markers.t_s) // MAX_FRAMES)
    if step <= 1:
        return trial, 1
    source = markers.source
    if source is not None:
        source = replace(source, lines=source.lines[::step])
    fewer = Markers(markers.t_s[::step], markers.xy_m[::step], source)
    return replace(trial, markers=fewer), step
