"""How a cycle ended, as data and as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from enum import StrEnum
from typing import Any


class Outcome(StrEnum):
    """Inserted and missed were executed; a rejected cable was put aside; failed = a fault.

    Measured: a measuring cycle, in which nothing is inserted, has come to its end.
    """

    INSERTED = "inserted"
    MISSED = "missed"
    REJECTED = "rejected"
    FAILED = "failed"
    MEASURED = "measured"


@dataclass(frozen=True)
class Fault:
    """What went wrong: in which step, which device if any, why, and what a person can do."""

    step: str
    cause: str
    device: str | None = None
    remedy: str = ""


@dataclass(frozen=True)
class Result:
    """End of one cycle.  None = not known, because the cycle did not come so far.

    offset_m            executed
    predicted_miss_m    height of the tip above the middle of the destination at its mouth
    measured_miss_m     the same, from the pictures of the execution
    margin_m            measured: smallest distance to the destination's floor or ceiling while
                        the tip passed it; negative = missed by so much
    predicted_margin_m  the same, predicted
    probability         predicted probability of passing
    prediction_error_m  largest distance between predicted and measured tip in the destination
    wait_s              how long the robot stood waiting for the computer
    seconds             time of each step, s
    state_seconds       time spent in each state of the cell, s
    parameters          of this cable, as identified: name → value, SI units
    reason              why the cable was rejected or missed, in words
    """

    cycle: int
    outcome: Outcome
    folder: str
    offset_m: float | None = None
    predicted_miss_m: float | None = None
    measured_miss_m: float | None = None
    margin_m: float | None = None
    predicted_margin_m: float | None = None
    probability: float | None = None
    prediction_error_m: float | None = None
    wait_s: float | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    state_seconds: Mapping[str, float] = field(default_factory=dict)
    parameters: Mapping[str, float] = field(default_factory=dict)
    reason: str | None = None
    fault: Fault | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain data for json.dumps; what is not finite becomes None."""
        return {name: _plain(value) for name, value in asdict(self).items()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Result:
        """Back from `to_json`.  Raises KeyError, ValueError: not a result."""
        known = {f.name: data[f.name] for f in fields(cls) if f.name in data}
        known["outcome"] = Outcome(data["outcome"])
        known["fault"] = None if data.get("fault") is None else Fault(**data["fault"])
        return cls(**known)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value.value if isinstance(value, StrEnum) else value
