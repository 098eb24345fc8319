"""The cycle under way: its step, its record, and what is known of its result so far."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from cell.identify.identified import Identified
from cell.plan.passage import Passage
from cell.records.folder import Record
from cell.records.result import Result
from cell.run.station import Station, study_of
from cell.run.watch import Watch
from cell.study.data import Trial


@dataclass
class Progress:
    """The cycle under way: where it is, and the entries of its result as they become known.

    empty  the jaws stay empty: a rehearsal
    """

    number: int
    record: Record
    station: Station
    empty: bool
    step: str = "reset"
    seconds: dict[str, float] = field(default_factory=dict)
    known: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.watch = Watch(self.station)

    def result(self) -> Result:
        """The cycle's result so far."""
        known = {k: v for k, v in self.known.items() if not (isinstance(v, float) and v != v)}
        folder = str(self.record.folder)
        return Result(cycle=self.number, folder=folder, seconds=self.seconds, **known)

    def add_study(self, *trials: Trial) -> None:
        """Record what was filmed."""
        self.record.study(study_of(self.record.folder.name, self.station.task, trials))

    def add_model(self, identified: Identified) -> None:
        """Record which cable it is."""
        self.record.model(identified.to_dict())
        self.known["parameters"] = {
            name: float(value)
            for name, value in zip(identified.space.names, identified.values, strict=True)
        }

    def add_passage(self, passage: Passage) -> None:
        """Note how the tip passed."""
        self.known.update(
            measured_miss_m=passage.miss_m,
            margin_m=passage.margin_m,
            prediction_error_m=passage.error_m,
        )
        if passage.reason is not None:
            self.known["reason"] = passage.reason
