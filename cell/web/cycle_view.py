"""Content of a cycle's page, as plain data, from the cycle's folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from cell.files.input_error import InputError
from cell.files.table import TableData
from cell.records.cycle_page import cycle_page, how_it_ended, numbers_table, parameters_table
from cell.records.folder import Recorded, cycle_of, pictures_in, read_record, started_of
from cell.records.recording import form
from cell.records.recording.film import why_no_film
from cell.records.recording.reading import read_recording

#: Lines of the tip's path, those on top last.
_COLOURS = {"seen": "#0b7fab", "predicted": "#d97706", "destination": "#b3261e"}


@dataclass(frozen=True)
class CycleView:
    """A cycle at a glance; texts are English.

    spent     states and steps: name → seconds, in their order
    tip       lines of the tip's path: name → (n, 2) mm
    no_film   why there is no film, "" = there is one
    gaps      frames that are missing in it
    pictures  names of files
    """

    cycle: int
    started: datetime | None
    part: str
    summary: str
    good: bool
    numbers: TableData | None
    parameters: TableData | None
    spent: Mapping[str, Mapping[str, float]]
    tip: Mapping[str, list[list[float]]]
    no_film: str
    gaps: tuple[str, ...]
    pictures: tuple[str, ...]


def cycle_view(folder: Path) -> CycleView:
    """Summary of a cycle.  Raises InputError: the folder cannot be read."""
    record = read_record(folder)
    result = record.result
    says, good = how_it_ended(record)
    no_film = why_no_film(folder)
    decision: Mapping[str, Any] | None = None
    destination: Mapping[str, Sequence[float]] | None = None
    gaps: tuple[str, ...] = ()
    if not no_film:
        try:
            recording = read_recording(folder / form.FILE)
            decision = recording.last(form.DECISION)
            said = recording.last(form.SETTINGS)
            destination = None if said is None else said["settings"]["destination"]
            gaps = tuple(f"{g['frames']}: {g['cause']}" for g in recording.json(form.GAP))
        except InputError as error:
            no_film = str(error)
    return CycleView(
        cycle=record.cycle,
        started=None if cycle_of(folder) is None else started_of(folder, record.state),
        part=(result.part if result else None) or "",
        summary=says,
        good=good,
        numbers=None if result is None else numbers_table(result),
        parameters=None if record.model is None else parameters_table(record.model),
        spent={} if result is None else {"state": result.state_seconds, "step": result.seconds},
        tip=_tip(record, decision, destination),
        no_film=no_film,
        gaps=gaps,
        pictures=tuple(p.name for p in pictures_in(folder)),
    )


def _tip(
    record: Recorded,
    decision: Mapping[str, Any] | None,
    destination: Mapping[str, Sequence[float]] | None,
) -> dict[str, list[list[float]]]:
    lines, study = {}, record.study
    if decision is not None and decision.get("tip_m"):
        lines["predicted"] = _mm(decision["tip_m"])
    for trial in () if study is None else study.trials:
        if study is not None and trial.name == "execute":
            tip = int(np.argmax(study.arc_length_m))
            lines["seen"] = _mm(trial.markers.xy_m[:, tip])
    if destination is not None and lines:
        (x0, x1), (y0, y1) = destination["x_m"], destination["y_m"]
        lines["destination"] = _mm([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
    return lines


def _mm(xy_m: Any) -> list[list[float]]:
    points = np.array(xy_m, float).reshape(-1, 2) * 1e3
    kept: list[list[float]] = np.round(points[np.isfinite(points).all(axis=1)], 2).tolist()
    return kept


def tip_chart(tip: Mapping[str, list[list[float]]], names: Mapping[str, str]) -> dict[str, Any]:
    """The tip's path as an ECharts option.

    names  of the lines, in the legend
    """
    axis = {
        "type": "value",
        "scale": True,
        "nameLocation": "middle",
        "nameGap": 28,
        "splitLine": {"lineStyle": {"color": "#8a94a355"}},
    }
    return {
        "animation": False,
        "grid": {"left": 60, "right": 15, "top": 40, "bottom": 45},
        "legend": {"top": 0},
        "tooltip": {},
        "xAxis": {**axis, "name": "x, mm"},
        "yAxis": {**axis, "name": "y, mm", "nameGap": 42},
        "series": [
            {
                "name": names[key],
                "type": "line",
                "data": line,
                "symbolSize": 0 if key == "destination" else 4,
                "itemStyle": {"color": _COLOURS[key]},
                "lineStyle": {"type": "dashed" if key == "predicted" else "solid"},
            }
            for key in _COLOURS
            if (line := tip.get(key))
        ],
    }


def cycle_folder(runs: Path, name: str) -> Path | None:
    """Folder of a cycle in `runs`; None = the name is no cycle's, or leads elsewhere."""
    folder = runs / name
    if folder.name != name or cycle_of(folder) is None:
        return None
    return folder if folder.resolve().parent == runs.resolve() else None


def newest_picture(folder: Path) -> Path | None:
    """The picture that was written last; None = there is none."""
    return max(pictures_in(folder), key=lambda p: p.stat().st_mtime_ns, default=None)


def picture(folder: Path, name: str) -> Path | None:
    """A picture of a cycle by its file's name; None = there is none of this name."""
    return next((p for p in pictures_in(folder) if p.name == name), None)


def report(folder: Path) -> str:
    """The page of `cell report`.  Raises InputError: the folder cannot be read."""
    film = folder / form.FILE
    return cycle_page(read_record(folder), read_recording(film) if film.exists() else None)
