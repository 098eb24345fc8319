"""The page of a study before any fit: what is odd, facts, and pictures of every trial."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cell.files.page import Plot, page
from cell.files.table import TableData
from cell.files.words import counted
from cell.lab.report.look_figures import courses, film_strip, swing_figure
from cell.lab.report.wrench_report import wrench_facts_table, wrench_figure
from cell.study.data import Trial
from cell.study.facts import TrialFacts
from cell.study.wrench_facts import WrenchFacts

FACT_HEADS = (
    "trial", "role, start, sensors", "frames", "per s", "still", "hand, mm", "hand, °", "tip, mm",
    "seen, %", "noise, mm", "swings at, Hz",
)  # fmt: skip
FACT_NOTE = (
    "Still: frames before anything moves. Hand and tip: how far apart their places are, and by how "
    "much the hand turns. Noise: of one coordinate in one frame, by the still frames. Swings at: "
    "the tip’s frequencies after the hand has stopped, the strongest first"
)


@dataclass(frozen=True)
class StudyOverview:
    """What is shown of measurements.

    title  of the page
    says   sentences at the top, in groups under their headings
    wrong  what must be mended before a model can be fitted
    odd    what may be wrong
    wrenches  facts of those trials that have a wrench
    """

    name: str
    title: str
    trials: Sequence[Trial]
    facts: Sequence[TrialFacts]
    says: Mapping[str, Sequence[str]] = field(default_factory=dict)
    wrong: Sequence[str] = ()
    odd: Sequence[str] = ()
    wrenches: Sequence[WrenchFacts] = ()

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        wrenches = {w.trial: {"wrench": w.to_json()} for w in self.wrenches}
        return {
            "format": "cable-look/1",
            "name": self.name,
            "wrong": list(self.wrong),
            "odd": list(self.odd),
            "trials": [f.to_json() | wrenches.get(f.name, {}) for f in self.facts],
        }


@dataclass(frozen=True)
class _TrialPlots:
    """Pictures of one trial; without a swing there is no spectrum, without a sensor no wrench."""

    name: str
    strip: Plot
    courses: Plot
    swing: Plot | None
    wrench: Plot | None

    @staticmethod
    def of(trial: Trial, facts: TrialFacts) -> _TrialPlots:
        swing = swing_figure(facts)
        return _TrialPlots(
            trial.name,
            Plot.of(film_strip(trial, facts)),
            Plot.of(courses(trial, facts)),
            None if swing is None else Plot.of(swing),
            None if trial.wrench is None else Plot.of(wrench_figure(trial.wrench)),
        )


def look_page(look: StudyOverview) -> str:
    """One page with the pictures of all trials, one shown at a time."""
    count, trials = len(look.wrong) + len(look.odd), len(look.trials)
    if look.wrong:
        top = f"{len(look.wrong)} to be mended before a model can be fitted"
    else:
        top = f"{count} remark{'s' * (count != 1)}" if count else "nothing is odd"
    return page(
        Path(__file__).parent / "templates",
        "look.html",
        look.title,
        says=f"{trials} trial{'s' * (trials != 1)}; {top}",
        wrong=look.wrong,
        said=look.says,
        odd=look.odd,
        facts=facts_table(look),
        note=FACT_NOTE,
        wrenches=wrench_facts_table(look.wrenches) if look.wrenches else None,
        trials=_plots(look),
    )


def _plots(look: StudyOverview) -> list[_TrialPlots]:
    """Of every trial; of none if their facts are not known."""
    if not look.facts:
        return []
    return [_TrialPlots.of(t, f) for t, f in zip(look.trials, look.facts, strict=True)]


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
    title = f"{look.name}: {counted(len(look.trials), 'trial')}"
    return TableData(title, FACT_HEADS, rows, range(2, len(FACT_HEADS) - 1))


def _frequencies(facts: TrialFacts) -> str:
    if facts.spectrum is None or not facts.spectrum.peaks_hz:
        return "–"
    return ", ".join(f"{f:.3g}" for f in facts.spectrum.peaks_hz)
