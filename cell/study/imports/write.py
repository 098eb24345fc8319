"""Writes an imported study, its proposed mapping, and a study as wide tables."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.atomic import write_all
from cell.files.input_error import InputError
from cell.files.yaml_document import yaml_text
from cell.study.data import Study, Trial, Wrench
from cell.study.entries import CableSection
from cell.study.folder import header_of, read_study, tables_of, thinned, write_study
from cell.study.imports.capture import Finding, Sure, TextForm
from cell.study.imports.gripper_section import (
    AngleSection,
    AxesSection,
    GripperSection,
    TimeSection,
)
from cell.study.imports.mapping import (
    FILE,
    FORMAT,
    Mapping,
    MarkerEntry,
    TrialEntry,
    wrench_section,
)
from cell.study.table import table_text
from cell.study.wrench import COLUMNS

_WIDTH = 98
#: Label of each degree of certainty, before the sentence of a finding.
_MARK = {Sure.STATED: "stated", Sure.SHOWN: "shown", Sure.GUESSED: "GUESS", Sure.MISSING: "GIVE"}


def mapping_text(mapping: Mapping, findings: Sequence[Finding], command: str) -> str:
    """The mapping file.

    command  command line that makes the study from it
    """
    lines = [
        "# What `cell import` understood.  Check what says GUESS, fill in what says GIVE.",
        "# Then:",
        f"#     {command}",
    ]
    for key, value in _plain(mapping).items():
        about = [f for f in findings if f.entry.split(".")[0] == key]
        if about or isinstance(value, dict | list):
            lines.append("")
        for finding in about:
            remark = f"{_MARK[finding.sure]}: {finding.sentence}"
            lines += textwrap.wrap(remark, _WIDTH, initial_indent="# ", subsequent_indent="#   ")
        lines.append(yaml_text({key: value}, inline=isinstance(value, dict | list)).rstrip())
    return "\n".join(lines) + "\n"


def _plain(mapping: Mapping) -> dict[str, Any]:
    """Entries with values other than defaults, and those that must be filled in."""
    data = mapping.model_dump(mode="json", exclude_defaults=True)
    cable = mapping.cable.model_dump(mode="json")
    if mapping.cable.connector is None:
        del cable["connector"]
    if mapping.cable.diameter_m is None:
        del cable["diameter_m"]
    else:
        cable = {k: v for k, v in cable.items() if k not in ("width_m", "thickness_m")}
    data["cable"] = cable
    data["gravity_m_per_s2"] = list(mapping.gravity_m_per_s2)
    data["trials"] = [
        {"role": t.role, "start": t.start} | t.model_dump(mode="json", exclude_defaults=True)
        for t in mapping.trials
    ]
    order = [name for name in type(mapping).model_fields if name in data]
    return {name: data[name] for name in order}


_FRAME = "frame"


class NotReadBackError(RuntimeError):
    """A study that does not read back as it was written: an error of this program."""


def write_imported(study: Study, folder: Path) -> Study:
    """Write a study and return it as it reads back, which is the same to the last bit.

    It is first written to a temporary folder: a failure leaves nothing in `folder`.

    raises  InputError: no command could read it, with places in the files it would have; OSError
    """
    with TemporaryDirectory(prefix="cell-import-") as temporary:
        stage = Path(temporary) / folder.name
        write_study(study, stage)
        try:
            back = read_study(stage)
        except InputError as error:
            problems = [replace(p, path=folder / p.path.relative_to(stage)) for p in error.problems]
            raise InputError(problems) from error
        thin = replace(study, trials=tuple(thinned(trial)[0] for trial in study.trials))
        if (header_of(thin), tables_of(thin)) != (header_of(back), tables_of(back)):
            raise NotReadBackError(f"{study.name} does not read back as it was written")
    write_study(study, folder)
    return read_study(folder)


def write_wide(study: Study, folder: Path) -> list[Path]:
    """Write every trial as one wide table, and a mapping that imports them to the same study.

    A row for every time of gripper, markers or wrench; cells without measurement are empty.  If
    some frames show no marker, a column marks the rows of frames.

    raises  OSError: it cannot be written; nothing has changed
    """
    names = ["tip", *(f"m{i}" for i in range(1, len(study.arc_length_m)))]
    mapping = _mapping_of(study, names)
    visible = [np.isfinite(t.markers.xy_m).any(axis=(1, 2)) for t in study.trials]
    if not all(rows.all() for rows in visible):
        mapping = mapping.model_copy(update={"frames": _FRAME})
    columns = _columns(names, mapping)
    files: dict[Path, str | bytes] = {
        folder / f"{trial.name}.csv": table_text(list(columns), _rows(trial, columns))
        for trial in study.trials
    }
    files[folder / FILE] = mapping_text(mapping, (), f"cell import {FILE}")
    write_all(files)
    return list(files)


def _columns(names: Sequence[str], mapping: Mapping) -> dict[str, int]:
    """Names of a table's columns, each with its index among the columns of `_rows`."""
    places = [f"{name}_{axis}_m" for name in names for axis in "xy"]
    all_names = ["time_s", "hand_x_m", "hand_y_m", "hand_angle_rad", *places, *COLUMNS, _FRAME]
    of_wrench = [] if mapping.wrench is None else mapping.wrench.columns
    used = {*all_names[: -1 - len(COLUMNS)], *of_wrench, mapping.frames}
    return {name: number for number, name in enumerate(all_names) if name in used}


def _rows(trial: Trial, columns: dict[str, int]) -> FloatArray:
    """(times, columns) values of gripper, markers, wrench, and whether a row is a frame."""
    grip, markers = trial.grip, trial.markers
    wrench = trial.wrench or Wrench(np.empty(0), np.empty((0, 3)))
    parts = (
        (grip.t_s, np.column_stack([grip.x_m, grip.y_m, grip.angle_rad])),
        (markers.t_s, markers.xy_m.reshape(len(markers.t_s), -1)),
        (wrench.t_s, wrench.values),
    )
    times = np.unique(np.concatenate([t_s for t_s, _ in parts]))
    rows = [times[:, None]]
    for t_s, values in parts:
        part = np.full((len(times), values.shape[1]), np.nan)
        part[np.searchsorted(times, t_s)] = values
        rows.append(part)
    is_frame = np.isin(times, markers.t_s)[:, None]
    return np.hstack([*rows, is_frame])[:, list(columns.values())]


def _mapping_of(study: Study, names: Sequence[str]) -> Mapping:
    """The mapping for the tables of `write_wide`."""
    std_m = study.arc_length_std_m
    stds = [None] * len(names) if std_m is None else [float(s) for s in std_m]
    return Mapping(
        format=FORMAT,
        name=study.name,
        cable=CableSection(**study.cable.to_dict()),
        gravity_m_per_s2=study.gravity_m_per_s2,
        noise_std_m=study.noise_std_m,
        text=TextForm(separator=",", decimal="."),
        time=TimeSection(column="time_s", seconds_per_unit=1.0),
        metres_per_unit=1.0,
        axes=AxesSection(right=[1.0, 0.0], up=[0.0, 1.0]),
        hand=GripperSection(
            columns=["hand_x_m", "hand_y_m"],
            angle=AngleSection(column="hand_angle_rad", radians_per_unit=1.0),
        ),
        wrench=wrench_section(study, COLUMNS),
        markers=[
            MarkerEntry(
                name=n, columns=[f"{n}_x_m", f"{n}_y_m"], arc_length_m=float(s), arc_length_std_m=d
            )
            for n, s, d in zip(names, study.arc_length_m, stds, strict=True)
        ],
        trials=[
            TrialEntry(
                name=t.name, file=f"{t.name}.csv", role=t.role, start=t.start,
                release_s=t.release_s, hand_drift=t.hand_drift,
            )
            for t in study.trials
        ],
    )  # fmt: skip
