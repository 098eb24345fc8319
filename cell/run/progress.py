"""The current cycle: its step, its findings so far, and which of them are on record."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

from cell.plan.correction import Tail
from cell.plan.passage import height_at_opening_m
from cell.records.folder import Record, RecordError
from cell.records.result import Correction, Fault, Outcome, Result
from cell.run.archive import CycleListing, CycleRecording, parameters_of
from cell.run.findings import Findings, required
from cell.run.machine import CellState
from cell.run.plans import Plan
from cell.run.station import ProductTask, Station
from cell.run.trials import study_of
from cell.run.watch import SafetyWatch


@dataclass
class CycleProgress:
    """Progress of the current cycle.

    step     the step that is done, or was done last
    seconds  time of each step so far, s
    written  findings that are recorded already
    fault    that has ended the cycle
    product  name of its product; None = its settings have no products
    """

    number: int
    record: Record
    recording: CycleRecording
    station: Station
    findings: Findings
    step: str
    seconds: dict[str, float] = field(default_factory=dict)
    written: Findings = field(default_factory=Findings)
    fault: Fault | None = None
    product: str | None = None

    def __post_init__(self) -> None:
        self.watch = SafetyWatch(self.station)

    def write(self) -> None:
        """Record the findings that are not recorded yet."""
        now, before = self.findings, self.written
        self.written = now  # a failed write is not repeated
        if now.trials and now.trials is not before.trials:
            name = self.record.folder.name
            study = study_of(name, self.station.task, (*now.trials, *now.earlier))
            self.recording.study(study)
            self.record.study(study)
        new = {name: p for name, p in now.pictures.items() if name not in before.pictures}
        self.record.pictures(new)
        if now.identified is not None and now.identified is not before.identified:
            self.record.model(now.identified.to_dict())
        self.recording.record_findings(now, self.station)

    @contextmanager
    def written_after(self) -> Iterator[None]:
        """Record the findings at the end; an error of a step takes precedence over a full disk.

        raises  RecordError
        """
        try:
            yield
        except BaseException:
            with suppress(RecordError):  # the record is tried once more when it is closed
                self.write()
            raise
        self.write()

    def result(self, state_seconds: Mapping[str, float]) -> Result:
        """The cycle's result: that of its findings, or a failure."""
        f = self.findings
        best = None if f.choice is None else f.choice.best
        predicted_miss_m = (
            None
            if f.choice is None
            else height_at_opening_m(self.station.task.destination, f.predicted_choice.tip_m)
        )
        passage = f.passage
        return Result(
            cycle=self.number,
            outcome=Outcome.FAILED if self.fault is not None else required(f.outcome),
            folder=str(self.record.folder),
            offset_m=f.offset_m,
            delay_s=None if f.offset_m is None or best is None else best.delay_s,
            pace=None if f.offset_m is None or best is None else best.pace,
            further_m=None if f.offset_m is None or best is None else best.further_m,
            predicted_miss_m=_finite(predicted_miss_m),
            measured_miss_m=None if passage is None else _finite(passage.miss_m),
            margin_m=None if passage is None else _finite(passage.margin_m),
            predicted_margin_m=None if best is None else _finite(best.margin_m),
            predicted_std_m=None if best is None else _finite(best.margin_std_m),
            probability=None if best is None else _finite(best.probability),
            residual_rms_m=None if f.identified is None else f.identified.residual_rms_m,
            noise_m=None if f.identified is None else f.identified.noise.std_m,
            model=self.station.task.model,
            prediction_error_m=None if passage is None else _finite(passage.error_m),
            wait_s=_finite(f.wait_s),
            hold_saved_s=f.hold_saved_s,
            stops=f.stops,
            corrections=None if f.tails is None else tuple(map(_correction, f.tails)),
            seconds=self.seconds,
            state_seconds=state_seconds,
            parameters={} if f.identified is None else parameters_of(f.identified),
            reason=f.reason,
            model_misses=f.choice is not None and f.choice.model_misses,
            fault=self.fault,
            speed=f.speed,
            checks=f.checks,
            product=self.product,
        )


def _correction(tail: Tail) -> Correction:
    return Correction(
        tail.from_s, tail.rise_m, tail.lasts_s, tail.before, tail.probability, tail.then_m
    )


def _finite(value: float | None) -> float | None:
    """None for nan: not known."""
    return None if value is None or math.isnan(value) else value


@dataclass
class OneCycle:
    """A cycle from its preparation to its end: plan, product and progress.

    made     task of its product
    before   time spent in each state before it, s
    part     id of its cable
    listing  None = the ledger does not know of it yet
    """

    plan: Plan
    made: ProductTask
    progress: CycleProgress
    before: Mapping[CellState, float]
    part: str | None = None
    listing: CycleListing | None = None

    def spent_s(self, after: Mapping[CellState, float]) -> dict[str, float]:
        """Time in each visited state, s; `after` is `before` at the end."""
        return {
            state.value: after[state] - self.before[state]
            for state in CellState
            if after[state] > self.before[state]
        }
