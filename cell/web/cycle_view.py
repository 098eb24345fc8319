"""Content of a cycle's page, as plain data, from the cycle's folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from cell.files.input_error import InputError
from cell.files.table import TableData
from cell.records.cycle_page import (
    TipFlight,
    chosen_row,
    cycle_page,
    flight_of,
    how_it_ended,
    numbers_table,
    parameters_table,
    rounded_mm,
)
from cell.records.folder import cycle_of, pictures_in, read_record, started_of
from cell.records.recording import form
from cell.records.recording.film import why_no_film
from cell.records.recording.reading import Recording, read_recording
from cell.records.result import Correction
from cell.web.theme import AMBER, BLUE, GREEN

#: Colours of the tip's lines; later ones are drawn on top.
_COLOURS = {"predicted": "#d97706", "seen": "#0b7fab", "destination": "#b3261e"}


@dataclass(frozen=True)
class CycleView:
    """A cycle at a glance; texts are English.

    spent     states and steps: name → seconds, in their order
    flight    of the tip in the executed motion
    decision  table of the simulated offsets, and the executed row
    corrections  in flight
    no_film   why there is no film, "" = there is one
    gaps      number of missing frames, by cause
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
    flight: TipFlight
    decision: tuple[Sequence[Mapping[str, Any]], Mapping[str, Any] | None]
    corrections: tuple[Correction, ...]
    no_film: str
    gaps: tuple[str, ...]
    pictures: tuple[str, ...]


def cycle_view(folder: Path) -> CycleView:
    """Summary of a cycle.  Raises InputError: the folder cannot be read."""
    record = read_record(folder)
    result = record.result
    summary_text, good = how_it_ended(record)
    no_film = why_no_film(folder)
    recording: Recording | None = None
    gaps: tuple[str, ...] = ()
    if not no_film:
        try:
            recording = read_recording(folder / form.FILE)
            missing: Counter[str] = Counter()
            for gap in recording.json(form.GAP):
                missing[gap["cause"]] += gap["frames"]
            gaps = tuple(f"{frames}: {cause}" for cause, frames in missing.items())
        except InputError as error:
            recording, no_film = None, str(error)
    decision = None if recording is None else recording.last(form.DECISION)
    return CycleView(
        cycle=record.cycle,
        started=None if cycle_of(folder) is None else started_of(folder, record.state),
        part=(result.part if result else None) or "",
        summary=summary_text,
        good=good,
        numbers=None if result is None else numbers_table(result),
        parameters=None if record.model is None else parameters_table(record.model),
        spent={} if result is None else {"state": result.state_seconds, "step": result.seconds},
        flight=flight_of(record, recording),
        decision=((decision or {}).get("table", ()), chosen_row(decision, result)),
        corrections=(result.corrections if result else None) or (),
        no_film=no_film,
        gaps=gaps,
        pictures=tuple(p.name for p in pictures_in(folder)),
    )


def tip_chart(flight: TipFlight, names: Mapping[str, str]) -> dict[str, Any]:
    """The tip's path as an ECharts option; empty = it is not known.

    names  of the lines, in the legend
    """
    paths = {
        "seen": flight.seen_m,
        "predicted": flight.planned_m,
        "destination": flight.destination_m,
    }
    if not len(flight.seen_m) and not len(flight.planned_m):
        return {}
    series = [
        {
            **_line(names[key], rounded_mm(paths[key]), _COLOURS[key]),
            "symbolSize": 4 if key == "seen" else 0,
            "lineStyle": {"type": "dashed" if key == "predicted" else "solid", "width": 2},
        }
        for key in _COLOURS
        if len(paths[key])
    ]
    return _chart("x, mm", "y, mm", series)


def error_chart(
    flight: TipFlight, corrections: Sequence[Correction], names: Mapping[str, str]
) -> dict[str, Any]:
    """Measured minus predicted tip over time as an ECharts option, with the forecast's limits.

    The time in the destination is shaded; a line marks each correction.  Empty = not known.

    names  of `above`, `right`, `limit`, `time`, `error`, `inside` and `correction`
    """
    if not len(flight.t_s):
        return {}
    t_s, error_mm = np.round(flight.t_s, 3).tolist(), rounded_mm(flight.error_m)
    above = _line(names["above"], _pairs(t_s, [e[1] for e in error_mm]), _COLOURS["seen"])
    above["symbolSize"] = 0
    marks = [{"xAxis": round(c.from_s, 3), "name": names["correction"]} for c in corrections]
    above["markLine"] = {
        "symbol": "none", "data": marks, "lineStyle": {"color": AMBER},
        "label": {"formatter": "{b}", "position": "insideEndTop"},
    }  # fmt: skip
    if len(flight.inside_s):
        from_s, to_s = np.round(flight.inside_s, 3).tolist()
        area = [{"xAxis": from_s, "name": names["inside"]}, {"xAxis": to_s}]
        above["markArea"] = {"data": [area], "itemStyle": {"color": "#8a94a333"}}
        above["markArea"]["label"] = {"position": "insideBottom"}
    right = _line(names["right"], _pairs(t_s, [e[0] for e in error_mm]), "#6b7684")
    series = [above, {**right, "symbolSize": 0, "lineStyle": {"width": 1}}]
    if flight.limit_m is not None:
        limit_mm, ends = round(1e3 * flight.limit_m, 3), [t_s[0], t_s[-1]]
        for name, y in ((names["limit"], limit_mm), (names["limit"] + " ", -limit_mm)):
            line = _line(name, _pairs(ends, [y, y]), "#8a94a3")
            series.append({**line, "symbol": "none", "lineStyle": {"type": "dashed"}})
    option = _chart(names["time"], names["error"], series)
    option["legend"]["data"] = [names["above"], names["right"], names["limit"]]
    return option


def decision_chart(
    table: Sequence[Mapping[str, Any]], chosen: Mapping[str, Any] | None, names: Mapping[str, str]
) -> dict[str, Any]:
    """Probability of passing and margin of every offset, as an ECharts option; empty = no table.

    chosen  row that was executed; None = none was
    names   of `offset`, `probability`, `margin` and `chosen`
    """
    rows = sorted(table, key=lambda row: float(row["offset_m"]))
    if not rows:
        return {}

    def points(key: str, scale: float, of: Sequence[Mapping[str, Any]]) -> list[list[float]]:
        known = [row for row in of if row.get(key) is not None]
        return [[round(1e3 * r["offset_m"], 2), round(scale * r[key], 3)] for r in known]

    usual = [r for r in rows if not r.get("delay_s") and not r.get("further_m")]
    usual = [r for r in usual if r.get("pace", 1.0) == 1.0] or rows
    probability = _line(names["probability"], points("probability", 100.0, usual), BLUE)
    margin = _line(names["margin"], points("margin_m", 1e3, usual), "#6b7684")
    executed = points("probability", 100.0, [] if chosen is None else [chosen])
    series = [
        {**probability, "symbolSize": 6},
        {**margin, "yAxisIndex": 1, "lineStyle": {"type": "dashed", "width": 1}},
        {**_line(names["chosen"], executed, GREEN), "type": "scatter", "symbolSize": 16},
    ]
    option = _chart(names["offset"], names["probability"], series)
    probability_axis = {**option["yAxis"], "min": 0, "max": 100, "scale": False}
    right = {**option["yAxis"], "name": names["margin"], "splitLine": {"show": False}}
    return {**option, "yAxis": [probability_axis, right], "grid": {**option["grid"], "right": 60}}


def _pairs(x: Sequence[float], y: Sequence[float]) -> list[list[float]]:
    return [list(pair) for pair in zip(x, y, strict=True)]


def _line(name: str, data: list[list[float]], colour: str) -> dict[str, Any]:
    look = {"type": "line", "symbolSize": 4, "itemStyle": {"color": colour}}
    return {**look, "name": name, "data": data}


def _chart(x: str, y: str, series: list[dict[str, Any]]) -> dict[str, Any]:
    """An ECharts option of lines over a number; `x` and `y` name the axes."""
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
        "xAxis": {**axis, "name": x},
        "yAxis": {**axis, "name": y, "nameGap": 42},
        "series": series,
    }


def cycle_folder(runs: Path, name: str) -> Path | None:
    """Folder of a cycle in `runs`; None = the name is not that of a cycle in `runs`."""
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
