"""One page of one cycle: result, film strip, path of the tip, times, decision, parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.files.figure_style import ADDED, MODEL, QUIET, SEEN, laid_out
from cell.files.page import PagePicture, Plot, page
from cell.files.table import TableData
from cell.files.words import counted, percent, with_prefix
from cell.records.folder import Recorded, pictures_in
from cell.records.recording import form
from cell.records.recording.film import corners_of, drawn
from cell.records.recording.reading import Recording
from cell.records.result import Correction, Outcome, Result

#: Pictures of the film strip: two rows on the page.  Widths in pixels: of these, and of a picture
#: with a legend.
STRIP, STRIP_PX, PICTURE_PX = 10, 420, 900
_GOOD = (Outcome.INSERTED, Outcome.MEASURED, Outcome.REHEARSED)
#: Numbers of a result: entry, heading, unit, factor from the SI unit.
_NUMBERS = (
    ("offset_m", "offset", "mm", 1e3),
    ("delay_s", "rested before", "s", 1.0),
    ("pace", "time for the motion, of the usual one", "%", 100.0),
    ("further_m", "further left than usual", "mm", 1e3),
    ("predicted_miss_m", "predicted miss", "mm", 1e3),
    ("measured_miss_m", "measured miss", "mm", 1e3),
    ("predicted_margin_m", "predicted margin", "mm", 1e3),
    ("margin_m", "measured margin", "mm", 1e3),
    ("prediction_error_m", "largest error of the forecast in the destination", "mm", 1e3),
    ("probability", "forecast probability of passing", "%", 100.0),
    ("residual_rms_m", "what the model misses of the swing", "mm", 1e3),
    ("noise_m", "noise of the camera", "mm", 1e3),
    ("hold_saved_s", "the hold ended early by", "s", 1.0),
    ("wait_s", "the robot waited for the computer", "s", 1.0),
)
#: Columns of the decision's table.
_DECISION = (
    ("offset_m", "offset, mm", 1e3, ".1f"),
    ("delay_s", "rested before, s", 1.0, ".2f"),
    ("pace", "time, of the usual, %", 100.0, ".0f"),
    ("further_m", "further left, mm", 1e3, ".0f"),
    ("margin_m", "margin, mm", 1e3, ".2f"),
    ("margin_std_m", "its standard deviation, mm", 1e3, ".2f"),
    ("probability", "passes with, %", 100.0, ".1f"),
)
#: Half-width of the band of a forecast, in its standard deviations.
LIMIT_STDS = 3.0


def cycle_page(record: Recorded, recording: Recording | None) -> str:
    """The page; without a recording it lacks film strip, states and decision."""
    result = record.result
    ending, good = how_it_ended(record)
    decision = None if recording is None else recording.last(form.DECISION)
    flight = flight_of(record, recording)
    tip = _tip_path(flight)
    timed = result is not None and result.seconds
    return page(
        Path(__file__).parent / "templates",
        "cycle.html",
        f"Cycle {record.cycle}: {record.folder.name}",
        says=ending,
        good=good,
        part=None if result is None else result.part,
        numbers=None if result is None else numbers_table(result),
        missing="" if recording is None else _missing(recording),
        strip=None if recording is None else _strip(recording),
        seen=_overlay_pictures(record),
        tip=None if tip is None else Plot.of(tip),
        decision=None if decision is None else _decision(decision, result),
        decision_says=""
        if decision is None or decision["offset_m"] is not None
        else f"No offset was taken: {decision['reason']}.",
        stops=() if result is None else result.stops,
        corrections=None if result is None else _corrections(result.corrections),
        parameters=None if record.model is None else parameters_table(record.model),
        times=Plot.of(_times(result.seconds, result.state_seconds)) if result and timed else None,
        folder=record.folder,
    )


def how_it_ended(record: Recorded) -> tuple[str, bool]:
    """How the cycle ended, and whether that is good."""
    result = record.result
    if result is None:
        return f"ended without a result in step {record.step}: it runs or was killed", False
    good = result.outcome in _GOOD
    text = result.outcome.value + (f" at offset {_mm(result.offset_m)}" if good else "")
    if result.reason:
        text += f": {result.reason}"
    if (fault := result.fault) is not None:
        text += f" in step {fault.step}: {fault.cause}. {fault.remedy} {fault.cable}".rstrip()
    return text, good


def numbers_table(result: Result) -> TableData:
    """Forecast and measured numbers, with units."""
    rows = [
        [name, percent(value) if key == "probability" else f"{value * size:.4g}", unit]
        for key, name, unit, size in _NUMBERS
        if (value := getattr(result, key)) is not None
    ]
    return TableData("", ["", "value", "unit"], rows, (1,))


def _corrections(corrections: Sequence[Correction] | None) -> TableData | None:
    if not corrections:
        return None
    rows = [
        [
            f"{c.from_s:.2f}",
            f"{c.rise_m * 1e3:+z.1f}",
            f"{c.then_m * 1e3:+z.1f}",
            f"{c.lasts_s:.2f}",
            f"{c.before * 100.0:.1f}",
            f"{c.probability * 100.0:.1f}",
        ]
        for c in corrections
    ]
    led = ("gripper led up by, mm", "then by, mm", "each within, s")
    headings = ["from, s", *led, "passes without, %", "with, %"]
    return TableData("", headings, rows, range(len(headings)))


def _mm(length_m: float | None) -> str:
    return "?" if length_m is None else f"{length_m * 1e3:.0f} mm"


def _strip(recording: Recording) -> list[PagePicture]:
    """Frames evenly over both films, with the detected cable."""
    count, corners_px = recording.count(form.IMAGE), corners_of(recording.last(form.CYCLE))
    chosen = set(np.linspace(0, count - 1, min(STRIP, count)).round().astype(int).tolist())
    shown = []
    first_s: float | None = None
    for number, (frame, points) in enumerate(recording.detections()):
        first_s = frame.t_s if first_s is None else first_s
        if number not in chosen:
            continue
        picture = drawn(frame.image, points, corners_px)
        shown.append(PagePicture.of(picture, STRIP_PX, f"{frame.t_s - first_s:.2f} s"))
    return shown


def _missing(recording: Recording) -> str:
    """Frames that were not recorded, and why."""
    gaps = recording.json(form.GAP)
    return "; ".join(
        f"{counted(g['frames'], 'frame')} from {g['first']}: {g['cause']}" for g in gaps
    )


def _overlay_pictures(record: Recorded) -> list[PagePicture]:
    """The pictures of the folder that can be read."""
    read = [(path.stem, cv2.imread(str(path))) for path in pictures_in(record.folder)]
    return [PagePicture.of(image, PICTURE_PX, name) for name, image in read if image is not None]


def _tip_path(flight: TipFlight) -> go.Figure | None:
    """Measured and forecast path of the tip in the execution, and the destination."""
    if not len(flight.planned_m) and not len(flight.seen_m):
        return None
    figure = go.Figure()
    for name, path_m, colour in (
        ("forecast", flight.planned_m, MODEL),
        ("seen", flight.seen_m, SEEN),
        ("destination", flight.destination_m, ADDED),
    ):
        if len(path_m):
            _draw(figure, path_m, name, colour)
    figure.update_xaxes(title="x, mm")
    figure.update_yaxes(title="y, mm")
    return laid_out(figure, 420)


def _draw(figure: go.Figure, xy_m: NDArray[np.float64], name: str, colour: str) -> None:
    x, y = (np.round(1e3 * xy_m[:, k], 3).tolist() for k in range(2))
    mode = "lines" if colour == ADDED else "lines+markers"
    marker, line = {"size": 3, "color": colour}, {"color": colour}
    figure.add_scatter(x=x, y=y, name=name, mode=mode, marker=marker, line=line)


def _decision(decision: Mapping[str, Any], result: Result | None) -> TableData:
    chosen = chosen_row(decision, result)
    rows = [
        [
            f"{row[key] * size:{digits}}" if row.get(key) is not None else ""
            for key, _, size, digits in _DECISION
        ]
        + ["taken" if row is chosen else ""]
        for row in decision["table"]
    ]
    heads = [*(head for _, head, _, _ in _DECISION), ""]
    return TableData("", heads, rows, range(len(_DECISION)))


def parameters_table(model: Mapping[str, Any]) -> TableData:
    """Parameters of the cable, as in `model.json`, with 95 % intervals."""
    rows = []
    for p in model["parameters"]:
        (value, low, high), unit = with_prefix([p["value"], p["low"], p["high"]], p["unit"])
        rows.append([p["name"], value, f"{low} … {high}", unit])
    return TableData("", ["parameter", "value", "95 %", "unit"], rows, (1, 2))


def _times(seconds: Mapping[str, float], state_seconds: Mapping[str, float]) -> go.Figure:
    """Seconds in each state, and in each step one after another."""
    figure = go.Figure()
    for row, spent, colours in (
        ("states", state_seconds, (ADDED, QUIET)),
        ("steps", seconds, (MODEL, QUIET)),
    ):
        for number, (name, length_s) in enumerate(spent.items()):
            figure.add_bar(
                y=[row],
                x=[round(length_s, 4)],
                name=name,
                orientation="h",
                showlegend=False,
                marker={"color": colours[number % 2]},
                hovertemplate=f"{name}: {length_s:.3f} s<extra></extra>",
                text=name if length_s > 0.05 * sum(spent.values()) else "",
                textposition="inside",
            )
    figure.update_layout(barmode="stack")
    figure.update_xaxes(title="s")
    return laid_out(figure, 260)


@dataclass(frozen=True, eq=False)
class TipFlight:
    """The tip of an executed motion; empty arrays = not known.

    seen_m         (n, 2) path from the pictures
    planned_m      (p, 2) predicted path of the chosen motion
    destination_m  (5, 2) closed outline
    t_s            (m,) from the beginning of the motion, of frames in which the tip was detected
    error_m        (m, 2) measured minus predicted, with corrections in flight, in these frames
    inside_s       (2,) first and last of these times in the destination
    limit_m        three standard deviations of the predicted margin; None = not known
    """

    seen_m: FloatArray
    planned_m: FloatArray
    destination_m: FloatArray
    t_s: FloatArray
    error_m: FloatArray
    inside_s: FloatArray
    limit_m: float | None


def flight_of(record: Recorded, recording: Recording | None) -> TipFlight:
    """Flight of the tip in a cycle, as far as it is known."""
    decision = None if recording is None else recording.last(form.DECISION)
    settings = None if recording is None else recording.last(form.SETTINGS)
    passage = None if recording is None else recording.last(form.PASSAGE)
    study, seen_m = record.study, np.empty((0, 2))
    for trial in () if study is None else study.trials:
        if study is not None and trial.name == "execute":
            path_m = trial.markers.xy_m[:, int(np.argmax(study.arc_length_m))]
            seen_m = path_m[np.isfinite(path_m).all(axis=1)]
    outline_m = np.empty((0, 2))
    if settings is not None:
        (x0, x1), (y0, y1) = (settings["settings"]["destination"][k] for k in ("x_m", "y_m"))
        outline_m = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]], float)
    t_s, tip_m, predicted_m = (
        np.array((passage or {}).get(key, ()), float) for key in ("t_s", "tip_m", "predicted_m")
    )
    tip_m = tip_m.reshape(-1, 2)
    std_m = (chosen_row(decision, record.result) or {}).get("margin_std_m")
    return TipFlight(
        seen_m=seen_m,
        planned_m=np.array((decision or {}).get("tip_m") or (), float).reshape(-1, 2),
        destination_m=outline_m,
        t_s=t_s,
        error_m=tip_m - predicted_m.reshape(-1, 2),
        inside_s=_times_inside(t_s, tip_m, outline_m),
        limit_m=None if std_m is None else LIMIT_STDS * std_m,
    )


def _times_inside(t_s: FloatArray, tip_m: FloatArray, outline_m: FloatArray) -> FloatArray:
    """First and last time in the destination's range of x; empty = in none."""
    if not len(tip_m) or not len(outline_m):
        return np.empty(0)
    x0, x1 = outline_m[:, 0].min(), outline_m[:, 0].max()
    times = t_s[(tip_m[:, 0] >= x0) & (tip_m[:, 0] <= x1)]
    return times[[0, -1]] if len(times) else np.empty(0)


def chosen_row(
    decision: Mapping[str, Any] | None, result: Result | None
) -> Mapping[str, Any] | None:
    """Row of a decision's table that was executed; None = none was."""
    if decision is None or decision["offset_m"] is None:
        return None
    chosen = {"offset_m": decision["offset_m"]}
    for key in ("delay_s", "pace", "further_m"):
        if result is not None and (value := getattr(result, key)) is not None:
            chosen[key] = value
    rows = (r for r in decision["table"] if all(r.get(k, v) == v for k, v in chosen.items()))
    return next(rows, None)


def rounded_mm(values_m: NDArray[np.float64]) -> Any:
    """Lengths in mm with two digits, as nested lists."""
    return np.round(1e3 * values_m, 2).tolist()
