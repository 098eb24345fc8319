"""How a cycle ended, as data and as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from enum import StrEnum
from typing import Any

from cell.files.plain import plain


class Outcome(StrEnum):
    """Inserted and missed were executed; a rejected cable was put aside; failed = a fault.

    Measured: a measuring cycle, in which nothing is inserted, has come to its end.  Rehearsed and
    unfit end a dry run: everything is as it must be, or something is not.
    """

    INSERTED = "inserted"
    MISSED = "missed"
    REJECTED = "rejected"
    FAILED = "failed"
    MEASURED = "measured"
    REHEARSED = "rehearsed"
    UNFIT = "unfit"


@dataclass(frozen=True)
class Fault:
    """A fault: in which step, of which device if any, why, and what a person can do.

    cable  where it is now, as the gripper says after the arm has stopped
    code   the reason in a word or two, the same for all causes of a kind: `arm.limit`, `stop`
    """

    step: str
    cause: str
    device: str | None = None
    remedy: str = ""
    cable: str = ""
    code: str = ""


@dataclass(frozen=True)
class AgreementCheck:
    """One check of a dry run or a cycle: measured value and limits.

    found      in SI units, `unit`
    low, high  what it must be within; None = no such limit
    remedy     what to do if it is not
    """

    what: str
    found: float
    unit: str = ""
    low: float | None = None
    high: float | None = None
    remedy: str = ""

    @property
    def right(self) -> bool:
        """Whether it is as it must be."""
        low = -math.inf if self.low is None else self.low
        high = math.inf if self.high is None else self.high
        return low <= self.found <= high


@dataclass(frozen=True)
class Correction:
    """A change of the gripper's path in flight.

    from_s       when it began, from when the gripper was told to move
    rise_m       by how much the gripper was led up
    then_m       by how much after that
    lasts_s      in how much time, either
    before, probability   predicted probability of passing, without and with it
    """

    from_s: float
    rise_m: float
    lasts_s: float
    before: float
    probability: float
    then_m: float = 0.0


@dataclass(frozen=True)
class Result:
    """End of one cycle.  None = not known, because the cycle did not come so far.

    offset_m            executed
    delay_s, pace       with which: so long the gripper rested before, s; in so many times the usual
                        time it moved
    further_m           and so much further left than usual it went
    predicted_miss_m    height of the tip above the middle of the opening at entry; as last
                        predicted if the path was changed in flight
    measured_miss_m     the same, from the pictures of the execution
    margin_m            measured: smallest distance to the destination's floor or ceiling while
                        the tip passed it; negative = missed by so much
    predicted_margin_m  the same, predicted
    predicted_std_m     standard deviation of the predicted margin
    probability         predicted probability of passing
    prediction_error_m  largest distance between predicted and measured tip in the destination
    residual_rms_m, noise_m   what the identified model misses of the frames, and their noise
    model               hash of the section `model` of the settings
    wait_s              how long the robot stood waiting for the computer
    hold_saved_s        how much shorter than its longest the hold was, because more frames would
                        not have mattered
    corrections         of the path in flight; None = without feedback
    stops               why the gripper was stopped in front of the opening in earlier tries with
                        this cable; the rest is of the last try
    seconds             time of each step, s
    state_seconds       time spent in each state of the cell, s
    parameters          of this cable, as identified: name → value, SI units
    reason              why the cable was rejected or missed, in words
    model_misses        whether it was rejected because the model misses its tip while it swings
    speed               of a dry run, as a share of the full one
    checks              what a dry run found out
    part                id of the cable; None = it has none
    product             what the cell made; None = its settings have no products
    """

    cycle: int
    outcome: Outcome
    folder: str
    offset_m: float | None = None
    predicted_miss_m: float | None = None
    measured_miss_m: float | None = None
    margin_m: float | None = None
    predicted_margin_m: float | None = None
    predicted_std_m: float | None = None
    probability: float | None = None
    prediction_error_m: float | None = None
    residual_rms_m: float | None = None
    noise_m: float | None = None
    model: str | None = None
    wait_s: float | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    state_seconds: Mapping[str, float] = field(default_factory=dict)
    parameters: Mapping[str, float] = field(default_factory=dict)
    reason: str | None = None
    model_misses: bool = False
    fault: Fault | None = None
    speed: float | None = None
    checks: tuple[AgreementCheck, ...] = ()
    part: str | None = None
    product: str | None = None
    delay_s: float | None = None
    pace: float | None = None
    further_m: float | None = None
    hold_saved_s: float | None = None
    corrections: tuple[Correction, ...] | None = None
    stops: tuple[str, ...] = ()

    @property
    def miss_error_m(self) -> float | None:
        """Measured minus predicted height of the tip, m; None = one of them is not known."""
        if self.measured_miss_m is None or self.predicted_miss_m is None:
            return None
        return self.measured_miss_m - self.predicted_miss_m

    def to_json(self) -> dict[str, Any]:
        """Plain data for json.dumps; what is not finite becomes None."""
        return {name: plain(value) for name, value in asdict(self).items()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Result:
        """Back from `to_json`.  Raises KeyError, ValueError: not a result."""
        known = {f.name: data[f.name] for f in fields(cls) if f.name in data}
        known["outcome"] = Outcome(data["outcome"])
        known["fault"] = None if data.get("fault") is None else Fault(**data["fault"])
        if known.get("corrections") is not None:
            known["corrections"] = tuple(Correction(**c) for c in data["corrections"])
        known["stops"] = tuple(data.get("stops", ()))
        known["checks"] = tuple(AgreementCheck(**check) for check in data.get("checks", ()))
        return cls(**known)
