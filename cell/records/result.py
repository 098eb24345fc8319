"""Result of a cycle, as data and as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from functools import cache
from typing import Any

from pydantic import ConfigDict, TypeAdapter

from cell.files.plain import plain


class Outcome(StrEnum):
    """Inserted and missed were executed; a rejected cable was put aside; failed = a fault.

    Measured: a measuring cycle, in which nothing is inserted, was completed.  Rehearsed and unfit
    end a dry run: all checks are met, or some are not.
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
    """A fault: its step, its device if any, cause and remedy.

    cable  where it is, as the gripper reports after the arm has stopped
    code   reason code, the same for all causes of a kind: `arm.limit`, `stop`
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

    found      measured value in SI units, `unit`
    low, high  limits; None = no such limit
    remedy     what to do otherwise
    """

    what: str
    found: float
    unit: str = ""
    low: float | None = None
    high: float | None = None
    remedy: str = ""

    @property
    def right(self) -> bool:
        """Whether the value is within its limits."""
        low = -math.inf if self.low is None else self.low
        high = math.inf if self.high is None else self.high
        return low <= self.found <= high


@dataclass(frozen=True)
class Correction:
    """A change of the gripper's path in flight.

    from_s       its beginning, since the gripper's command to move
    rise_m       first rise of the gripper
    then_m       second rise
    lasts_s      duration of either
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
    delay_s, pace       of the executed motion: rest before it, s; its duration over the usual one
    further_m           of the executed motion: distance beyond the usual one to the left
    predicted_miss_m    height of the tip above the middle of the opening at entry; as last
                        predicted if the path was changed in flight
    measured_miss_m     the same, from the pictures of the execution
    margin_m            measured: smallest distance to the destination's floor or ceiling while the
                        tip passed it; negative = missed by this distance
    predicted_margin_m  the same, predicted
    predicted_std_m     standard deviation of the predicted margin
    probability         predicted probability of passing
    prediction_error_m  largest distance between predicted and measured tip in the destination
    residual_rms_m, noise_m   rms residual of the identified model in the frames, and their noise
    model               hash of the section `model` of the settings
    wait_s              time that the robot waited for the computer
    hold_saved_s        time by which the hold was shorter than its maximum, because more frames
                        would not have changed the decision
    corrections         of the path in flight; None = without feedback
    stops               why the gripper was stopped before the opening in earlier attempts with
                        this cable; other entries are of the last attempt
    seconds             time of each step, s
    state_seconds       time spent in each state of the cell, s
    parameters          of this cable, as identified: name → value, SI units
    reason              why the cable was rejected or missed, as text
    model_misses        whether it was rejected for the model's error of the swinging tip
    speed               of a dry run, as a share of the full one
    checks              checks of a dry run
    part                id of the cable; None = it has none
    product             of the cable; None = the settings have no products
    """

    __pydantic_config__ = ConfigDict(allow_inf_nan=False)  # of faults, checks, corrections too

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
        """Back from `to_json`.  Raises ValueError: not a result."""
        return result_adapter().validate_json(json.dumps(data), strict=True)


@cache
def result_adapter() -> TypeAdapter[Result]:
    """Validator of a result: types, and numbers finite; unknown entries are left out."""
    return TypeAdapter(Result)
