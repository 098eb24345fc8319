"""The page of a study before any fit: what is odd, facts, and pictures of every trial."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.lab.report.html_page import html_page, html_plot, html_table
from cell.lab.report.look_figures import courses, film_strip, swing_figure
from cell.study.data import Trial
from cell.study.facts import TrialFacts

FloatArray = NDArray[np.float64]

FACT_HEADS = (
    "trial", "role, start", "frames", "per s", "still", "hand, mm", "hand, °", "tip, mm", "seen, %",
    "noise, mm", "swings at, Hz",
)  # fmt: skip
FACT_NOTE = (
    "Still: frames before anything moves. Hand and tip: how far apart their places are, and by how "
    "much the hand turns. Noise: of one coordinate in one frame, by the still frames. Swings at: "
    "the tip’s frequencies after the hand has stopped, the strongest first"
)


@dataclass(frozen=True)
class Look:
    """What is shown of measurements.

    title  of the page
    says   sentences at the top, in groups under their headings
    wrong  what must be mended before a model can be fitted
    odd    what may be wrong
    """

    name: str
    title: str
    trials: Sequence[Trial]
    facts: Sequence[TrialFacts]
    says: Mapping[str, Sequence[str]] = field(default_factory=dict)
    wrong: Sequence[str] = ()
    odd: Sequence[str] = ()

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "format": "cable-look/1",
            "name": self.name,
            "wrong": list(self.wrong),
            "odd": list(self.odd),
            "trials": [f.to_json() for f in self.facts],
        }


def look_page(look: Look) -> str:
    """One page with the pictures of all trials, one shown at a time."""
    count = len(look.wrong) + len(look.odd)
    if look.wrong:
        top = f"{len(look.wrong)} to be mended before a model can be fitted"
    else:
        top = f"{count} remark{'s' * (count != 1)}" if count else "nothing is odd"
    wrong = [f'<p class="warning"><b>To be mended:</b> {html.escape(w)}</p>' for w in look.wrong]
    parts = [
        f'<p class="says{" bad" if look.wrong else ""}">{len(look.trials)} '
        f"trial{'s' * (len(look.trials) != 1)}; {top}</p>",
        *wrong,
        *_said(look.says),
        *(f'<p class="warning">{html.escape(o)}</p>' for o in look.odd),
    ]
    if look.facts:
        parts += [
            html_table(FACT_HEADS, fact_rows(look.facts), range(2, len(FACT_HEADS) - 1)),
            f'<p class="note">{FACT_NOTE}.</p>',
            *_trials(look),
        ]
    return html_page(look.title, parts)


def _said(says: Mapping[str, Sequence[str]]) -> list[str]:
    """Sentences as lists under their headings."""
    parts = []
    for head, sentences in says.items():
        items = "".join(f"<li>{html.escape(s)}</li>" for s in sentences)
        parts.append(f"<p><b>{html.escape(head)}</b></p><ul>{items}</ul>")
    return parts


def fact_rows(facts: Sequence[TrialFacts]) -> list[list[str]]:
    """Facts of every trial as words, under `FACT_HEADS`."""
    return [
        [
            f.name,
            f"{f.role}, {f.start}",
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
        for f in facts
    ]


def _frequencies(facts: TrialFacts) -> str:
    if facts.spectrum is None or not facts.spectrum.peaks_hz:
        return "–"
    return ", ".join(f"{f:.3g}" for f in facts.spectrum.peaks_hz)


def _trials(look: Look) -> list[str]:
    """Film strip, courses and spectrum of every trial, one shown at a time."""
    options, parts = [], []
    for number, (trial, facts) in enumerate(zip(look.trials, look.facts, strict=True)):
        name = html.escape(trial.name)
        picked, hidden = ("", " hidden") if number else (" selected", "")
        options.append(f'<option value="{name}"{picked}>{name}</option>')
        swing = swing_figure(facts)
        parts.append(
            f'<div class="trial" data-trial="{name}"{hidden}>'
            f"<h2>{name}: film strip</h2>{html_plot(film_strip(trial, facts))}"
            f"<h2>Tip and hand</h2>{html_plot(courses(trial, facts))}"
            + ("" if swing is None else f"<h2>Swing of the tip</h2>{html_plot(swing)}")
            + "</div>"
        )
    choice = f'<p><label>Trial: <select id="chooser">{"".join(options)}</select></label></p>'
    note = '<p class="note">The hand moves between the dotted lines.</p>'
    return [choice, note, *parts]
