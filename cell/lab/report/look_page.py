"""The page of a study before any fit: warnings, facts, and figures of every trial."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from cell.cable.arrays import FloatArray
from cell.files.figure_style import (
    ADDED,
    MODEL,
    NOISE,
    QUIET,
    SEEN,
    in_mm,
    laid_out,
    listed,
    thinned,
)
from cell.files.input_error import InputError
from cell.files.page import Plot, page
from cell.files.table import TableData
from cell.files.words import counted
from cell.files.yaml_document import Document
from cell.lab.report.wrench_report import wrench_facts_table, wrench_figure
from cell.study.data import Trial
from cell.study.facts import TrialFacts, facts_of
from cell.study.imports.capture import Sure
from cell.study.imports.convert import study_of, trials_of
from cell.study.imports.mapping import ReadMapping
from cell.study.imports.trials import Files
from cell.study.imports.understand import Understanding
from cell.study.independence import Independence
from cell.study.left_out import notes_of_samples
from cell.study.record_checks import oddities
from cell.study.wrench import WrenchFacts

#: Number of shapes of a film strip, and of one of its lines.
STRIP, IN_LINE = 10, 5
#: Room between two shapes, as a share of the largest one.
_BETWEEN = 0.2
#: Pixels between the lines of the strip's time labels and its shapes.
_LINE_PX, _AROUND_PX = 190, 70
#: A spectrum is drawn up to this multiple of the highest peak frequency.
_SHOWN_HZ = 8.0


def film_strip(trial: Trial, facts: TrialFacts) -> go.Figure:
    """Shapes of the cable at times from rest before the motion to the end, next to each other.

    All are drawn to one scale, in mm, and where they are; paths of gripper and tip are grey.
    """
    rows = _moments(trial, facts)
    t_s = trial.markers.t_s
    grip_m = trial.gripper_m(t_s)
    points = np.concatenate([trial.markers.xy_m.reshape(-1, 2), grip_m]) * 1e3
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    size = np.maximum(high - low, 1e-6) * (1.0 + _BETWEEN)
    size = np.maximum(size, 0.25 * size.max())
    figure = go.Figure()
    for number, row in enumerate(rows):
        at = np.array([number % IN_LINE, -(number // IN_LINE)]) * size - low
        from_grip = np.concatenate([grip_m[row][None], trial.markers.xy_m[row][::-1]])
        shape = from_grip[np.isfinite(from_grip).all(axis=1)] * 1e3 + at
        paths = np.concatenate([grip_m * 1e3 + at, [[np.nan] * 2], _tip(trial, facts) * 1e3 + at])
        _line(figure, thinned(paths), QUIET, 1.0, "paths of hand and tip", number == 0)
        _line(figure, shape, SEEN, 2.0, "cable", number == 0, markers=True)
        place = {"x": [float(shape[0, 0])], "y": [float(shape[0, 1])]}
        figure.add_scatter(**place, mode="markers", name="gripping point", showlegend=number == 0,
            marker={"color": MODEL, "size": 9, "symbol": "square"})  # fmt: skip
        middle = at + low + [0.5 * size[0] / (1.0 + _BETWEEN), size[1]]
        label = f"{t_s[row]:.2f} s"
        figure.add_annotation(
            x=middle[0], y=middle[1] - 0.08 * size[1], text=label, showarrow=False
        )
    figure.update_xaxes(visible=False)
    figure.update_yaxes(visible=False, scaleanchor="x")
    lines = -(-len(rows) // IN_LINE)
    return laid_out(figure, _AROUND_PX + 60 + _LINE_PX * lines).update_layout(legend_y=-0.02)


def courses(trial: Trial, facts: TrialFacts) -> go.Figure:
    """Tip, gripper and clamp angle against time; dotted lines bound the gripper's motion."""
    titles = ("tip, mm", "gripper, mm", "clamp angle, degrees")
    figure = make_subplots(3, 1, shared_xaxes=True, subplot_titles=titles, vertical_spacing=0.08)
    markers, grip = trial.markers, trial.grip
    tip = thinned(np.column_stack([markers.t_s, _tip(trial, facts) * 1e3]))
    grip_xy = thinned(np.column_stack([grip.t_s, grip.x_m * 1e3, grip.y_m * 1e3]))
    for row, course in ((1, tip), (2, grip_xy)):
        for axis, name, colour in ((1, "x (right)", ADDED), (2, "y (up)", MODEL)):
            figure.add_scatter(
                x=listed(course[:, 0], 4), y=listed(course[:, axis], 3), mode="lines+markers",
                line={"color": colour, "width": 1}, marker={"size": 2.5}, name=name,
                legendgroup=name, showlegend=row == 1, row=row, col=1,
            )  # fmt: skip
    angle = thinned(np.column_stack([grip.t_s, np.degrees(grip.angle_rad)]))
    figure.add_scatter(x=listed(angle[:, 0], 4), y=listed(angle[:, 1], 3), mode="lines",
        line={"color": NOISE}, showlegend=False, row=3, col=1)  # fmt: skip
    if np.ptp(angle[:, 1]) < 1.0:
        middle = float(np.mean(angle[:, 1]))
        figure.update_yaxes(range=[middle - 1.0, middle + 1.0], row=3, col=1)
    for edge in facts.moves_s or ():
        figure.add_vline(x=edge, line_dash="dot", line_color="#222")
    figure.update_xaxes(title="s", row=3, col=1)
    return laid_out(figure, 560).update_layout(legend_y=-0.1)


def swing_figure(facts: TrialFacts) -> go.Figure | None:
    """Amplitude of the tip by frequency after the gripper's stop; None if that was too short."""
    spectrum = facts.spectrum
    if spectrum is None or not spectrum.peaks_hz:
        return None
    positive = spectrum.frequency_hz > 0.0
    amplitude = np.maximum(spectrum.amplitude_m[positive], 1e-4 * spectrum.amplitude_m.max())
    shown = thinned(np.column_stack([spectrum.frequency_hz[positive], amplitude]))
    figure = go.Figure()
    figure.add_scatter(x=listed(shown[:, 0], 4), y=in_mm(shown[:, 1]), mode="lines",
        line={"color": SEEN, "width": 1.5}, showlegend=False)  # fmt: skip
    for peak in spectrum.peaks_hz:
        figure.add_vline(x=peak, line_dash="dot", line_color=ADDED)
        figure.add_annotation(x=peak, y=1.0, yref="paper", yanchor="bottom", text=f"{peak:.3g} Hz",
            showarrow=False)  # fmt: skip
    highest = min(float(shown[-1, 0]), _SHOWN_HZ * max(spectrum.peaks_hz))
    figure.update_xaxes(title="Hz", range=[0.0, highest])
    figure.update_yaxes(title="tip, mm", type="log", dtick=1, tickformat="~g")
    return laid_out(figure, 300)


def _moments(trial: Trial, facts: TrialFacts) -> list[int]:
    """Rows of a strip: one at rest, the others evenly over the motion and the swing after it."""
    t_s = trial.markers.t_s
    begins = t_s[0] if facts.moves_s is None else min(max(facts.moves_s[0], t_s[0]), t_s[-1])
    wanted = np.linspace(begins, t_s[-1], STRIP)
    observed = np.flatnonzero(np.isfinite(trial.markers.xy_m).any(axis=(1, 2)))
    rows = [int(observed[np.argmin(np.abs(t_s[observed] - t))]) for t in wanted]
    return list(dict.fromkeys(rows))


def _tip(trial: Trial, facts: TrialFacts) -> FloatArray:
    return np.asarray(trial.markers.xy_m[:, facts.tip])


def _line(
    figure: go.Figure,
    xy: FloatArray,
    colour: str,
    width: float,
    name: str,
    named: bool,
    markers: bool = False,
) -> None:
    figure.add_scatter(
        x=listed(xy[:, 0], 2), y=listed(xy[:, 1], 2), name=name, showlegend=named,
        mode="lines+markers" if markers else "lines", marker={"size": 4},
        line={"color": colour, "width": width}, hoverinfo="skip",
    )  # fmt: skip


FACT_HEADS = (
    "trial", "role, start, sensors", "frames", "per s", "still", "gripper, mm", "gripper, °",
    "tip, mm", "seen, %", "noise, mm", "swings at, Hz",
)  # fmt: skip
FACT_NOTE = (
    "Still: frames before anything moves. Gripper and tip: largest distance between two of its "
    "places, and by how much the gripper turns. Noise: of one coordinate in one frame, from the "
    "still frames. Swings at: the tip’s frequencies after the gripper has stopped, the strongest "
    "first"
)


@dataclass(frozen=True)
class StudyOverview:
    """Content of a study's overview page: trials, facts and warnings.

    title  of the page
    says   sentences at the top, grouped by heading
    wrong  errors to correct before a model can be fitted
    odd    possible errors
    wrenches  facts of those trials that have a wrench
    independence  the independent recordings and motions; None = not known
    """

    name: str
    title: str
    trials: Sequence[Trial]
    facts: Sequence[TrialFacts]
    says: Mapping[str, Sequence[str]] = field(default_factory=dict)
    wrong: Sequence[str] = ()
    odd: Sequence[str] = ()
    wrenches: Sequence[WrenchFacts] = ()
    independence: Independence | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        wrenches = {w.trial: {"wrench": w.to_json()} for w in self.wrenches}
        return {
            "format": "cable-look/1",
            "name": self.name,
            "wrong": list(self.wrong),
            "odd": list(self.odd),
            "independence": None if self.independence is None else self.independence.to_json(),
            "trials": [f.to_json() | wrenches.get(f.name, {}) for f in self.facts],
        }


def _plots(trial: Trial, facts: TrialFacts) -> dict[str, object]:
    """Pictures of one trial; without a swing there is no spectrum, without a sensor no wrench."""
    swing = swing_figure(facts)
    return {
        "name": trial.name,
        "strip": Plot.of(film_strip(trial, facts)),
        "courses": Plot.of(courses(trial, facts)),
        "swing": None if swing is None else Plot.of(swing),
        "wrench": None if trial.wrench is None else Plot.of(wrench_figure(trial.wrench)),
    }


def look_page(look: StudyOverview) -> str:
    """One page with the pictures of all trials, one shown at a time."""
    count = len(look.wrong) + len(look.odd)
    if look.wrong:
        top = f"{len(look.wrong)} to be mended before a model can be fitted"
    else:
        top = f"{count} remark{'s' * (count != 1)}" if count else "nothing is odd"
    return page(
        Path(__file__).parent / "templates",
        "look.html",
        look.title,
        says=f"{_evidence(look)}; {top}",
        wrong=look.wrong,
        said=look.says,
        odd=look.odd,
        facts=facts_table(look),
        note=FACT_NOTE,
        wrenches=wrench_facts_table(look.wrenches) if look.wrenches else None,
        # trials that could not be read have no facts
        trials=[_plots(t, f) for t, f in zip(look.trials, look.facts, strict=False)],
    )


def facts_table(look: StudyOverview) -> TableData:
    """Facts of every trial, one row each; its title is for a terminal."""
    rows = [
        [
            f.name,
            ", ".join((f.role, f.start, *f.sensors)),
            str(f.frames),
            f"{f.rate_hz:.4g}",
            str(f.rest_frames),
            f"{f.hand_m * 1e3:.3g}",
            f"{np.degrees(f.hand_rad):.3g}",
            f"{f.tip_m * 1e3:.3g}",
            f"{f.seen * 100.0:.4g}",
            f"{f.noise_m * 1e3:.2g}" if np.isfinite(f.noise_m) else "–",
            _frequencies(f),
        ]
        for f in look.facts
    ]
    title = f"{look.name}: {_evidence(look)}"
    return TableData(title, FACT_HEADS, rows, range(2, len(FACT_HEADS) - 1))


def _evidence(look: StudyOverview) -> str:
    trials = counted(len(look.trials), "trial")
    return trials if look.independence is None else f"{trials}; {look.independence}"


def _frequencies(facts: TrialFacts) -> str:
    if facts.spectrum is None or not facts.spectrum.peaks_hz:
        return "–"
    return ", ".join(f"{f:.3g}" for f in facts.spectrum.peaks_hz)


_HEADS = {
    Sure.MISSING: "To be filled in:",
    Sure.GUESSED: "Guesses, to be checked:",
    Sure.SHOWN: "The data show:",
    Sure.STATED: "The file states:",
}


def preview_of(
    files: Sequence[Files], understood: Understanding, mapping_file: Path
) -> StudyOverview:
    """Overview of trials before their import: trials as mapped, warnings, and refusals.

    mapping_file  future path of the mapping, for error messages
    """
    read = ReadMapping(understood.mapping, Document(mapping_file, {}, {(): (1, 1)}))
    captures = {f.file: f.capture for f in files}
    captures |= {
        f.gripper_file: f.gripper for f in files if f.gripper_file and f.gripper is not None
    }
    trials, problems = trials_of(read, captures)
    notes = [note for capture in captures.values() for note in capture.notes]
    if not problems and not any(f.sure is Sure.MISSING for f in understood.findings):
        try:
            imported = study_of(read, captures)
            notes = [*imported.notes, *notes_of_samples(imported.study)]
            trials = list(imported.study.trials)
        except InputError as error:
            problems = list(error.problems)
    arcs = [m.arc_length_m for m in read.mapping.markers]
    tip_first = np.array([np.nan if a is None else a for a in arcs[::-1]], dtype=np.float64)
    facts = facts_of(trials, tip_first, read.mapping.gravity_m_per_s2)
    odd = [*notes, *oddities(facts if read.mapping.is_to_scale else (), read.mapping.noise_std_m)]
    wrong = [str(p) for p in problems]
    title = f"{read.mapping.name} as proposed, before it is written; `cell look` shows the study"
    says = {
        head: [f.sentence for f in understood.findings if f.sure is sure]
        for sure, head in _HEADS.items()
    }
    says = {head: sentences for head, sentences in says.items() if sentences}
    return StudyOverview(read.mapping.name, title, trials, facts, says, wrong, odd)
