"""What the lab finds, as data: the diagnosis and its JSON (cable-diagnosis/1)."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from cell.files.atomic import write_atomic
from cell.files.plain import plain
from cell.identify.parameters import Prior
from cell.lab.data.work import ModelError
from cell.study.independence import Independence

Verdict = Literal["complete", "missing", "unexplained", "cannot_tell"]
Status = Literal["present", "absent", "inspect", "cannot_tell"]

FORMAT = "cable-diagnosis/1"


@dataclass(frozen=True)
class Interval:
    """A value and its 95 % interval."""

    value: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class Errors:
    """Root mean square residual per coordinate, over all markers; `heldout_rms_m` nan if none."""

    fit_rms_m: float
    heldout_rms_m: float


@dataclass(frozen=True)
class MissingEffect:
    """An effect the model lacks, in the order of adding.

    tied_with      effects that these motions cannot tell from it
    p_value        of the fall of χ² on the fit trials, adjusted for the size of the library; where
                   the model's own error remains, of the fall of that over all trials if larger
    delta_bic      BIC gained on the fit trials (positive = better)
    errors         with all effects up to this one; of a partial explanation, which is fitted to all
                   trials, the error on them all, and none held out
    explained_share  of the baseline's mean square beyond noise, over all trials, that is gone with
                   all effects up to this one
    """

    effect: str
    tied_with: tuple[str, ...]
    p_value: float
    delta_bic: float
    parameters: dict[str, Interval]
    errors: Errors
    explained_share: float = float("nan")


@dataclass(frozen=True)
class Peak:
    """Place of the largest residual: trial, time in it, place on the cable, and its frequency.

    frequency_hz  at which its power is farthest above the noise's; nan if too short to tell
    """

    trial: str
    time_s: float
    arc_length_m: float
    frequency_hz: float


@dataclass(frozen=True)
class RemainingError:
    """The error that the final model leaves, all trials together.

    before_rms_m     what the baseline, fitted to the same trials, leaves of them all
    over_noise       rms over that of the measurement
    explained_share  of the baseline's mean square beyond noise that is gone
    """

    rms_m: float
    before_rms_m: float
    over_noise: float
    explained_share: float
    peak: Peak


@dataclass(frozen=True)
class Nearest:
    """An effect that leaves more than noise but less than others, and its residual.

    explained_share, left_rms_m  of all trials, fitted to them all
    errors                       fitted to the fit trials alone; nan if it never was
    at_bound                     its parameters that are at a bound, which may be too narrow
    """

    effect: str
    explained_share: float
    left_rms_m: float
    errors: Errors
    peak: Peak
    at_bound: tuple[str, ...] = ()


@dataclass(frozen=True)
class Limit:
    """95 % limits of one amplitude of an effect that is neither named nor tied.

    low, high  of the parameter, outside of which the study excludes the effect; None = the study
               could not have shown it: whatever its size, or beyond the parameter's bounds only
    tip_m      largest distance that the effect at its limit moves the outermost marker by, all
               else as fitted
    """

    effect: str
    parameter: str
    unit: str
    low: float | None
    high: float | None
    tip_m: float | None


@dataclass(frozen=True)
class TrialValue:
    """The estimate of a parameter from one trial, with its 95 % interval; None = no estimate."""

    trial: str
    value: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Agreement:
    """Estimates of a parameter per trial, and whether they agree.

    value    of all trials together
    spread   standard deviation between trials beyond what each of them is uncertain by, in `unit`
    p_value  of trials that differ so much if they agree, adjusted for the number of parameters
    """

    parameter: str
    unit: str
    value: float
    spread: float
    p_value: float
    agrees: bool
    by_trial: tuple[TrialValue, ...]


@dataclass(frozen=True)
class Doubt:
    """A reason to doubt a result: a `code` for programs, a `message` for people."""

    code: str
    message: str


@dataclass(frozen=True)
class CheckResult:
    """The question of a check of the verdict, and the answer.

    unit       of statistic and limit
    statistic  None where the question does not apply to the study
    passes     how the statistic compares with the limit if all is well
    passed     None where the question does not apply
    failing    the verdict if it fails, unless another check makes it worse
    failed     sentence that says so
    """

    name: str
    question: str
    unit: str
    statistic: float | None
    passes: str
    limit: float
    passed: bool | None
    failing: str
    failed: str


@dataclass(frozen=True)
class RankedEffect:
    """An effect and its evidence; `score`: χ² that it explains beyond the baseline, fit trials."""

    effect: str
    score: float
    p_value: float
    status: Status


@dataclass(frozen=True)
class Diagnosis:
    """The missing effect, or that none is missing, none known fits, or these motions cannot tell.

    Its fields are in the order in which files have them.
    noise_is_stated  by the study; else it was measured at rest
    left      what the model with everything in `missing`, or else in `partial`, leaves; the latter
              fitted to all trials
    partial   of an unexplained study: what explains most of the error, not all
    nearest   of an unexplained study: the single effects that leave least
    limits    how strong the effects could be that are neither named nor tied
    agreement  of the trials, in each parameter of the final model; none of a single trial
    checks    asked of the model, in order; the verdict is the worst of those that failed
    independence  the independent recordings and motions of the study
    knots     of EI(s) in the models; more than usual where the study shows that EI changes fast
    fit_errors  of all models that were fitted, by number of effects, the largest error first
    """

    noise_m: float
    noise_is_stated: bool = field(default=False, kw_only=True)
    baseline: Errors
    verdict: Verdict
    missing: tuple[MissingEffect, ...] = ()
    ranking: tuple[RankedEffect, ...] = ()
    left: RemainingError | None = None
    partial: tuple[MissingEffect, ...] = ()
    nearest: tuple[Nearest, ...] = ()
    checks: tuple[CheckResult, ...] = ()
    independence: Independence = field(default_factory=Independence)
    knots: int = Prior().knots
    fit_errors: tuple[ModelError, ...] = ()
    warnings: tuple[Doubt, ...] = ()
    limits: tuple[Limit, ...] = ()
    agreement: tuple[Agreement, ...] = ()

    @property
    def codes(self) -> frozenset[str]:
        """Those of its warnings."""
        return frozenset(w.code for w in self.warnings)

    @property
    def ended_early(self) -> bool:
        """Whether it cannot tell because a person or the limit of work ended it."""
        return self.verdict == "cannot_tell" and bool(self.codes & {"interrupted", "cut_short"})


def to_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """The diagnosis as plain data in the form cable-diagnosis/1; nan becomes null."""
    content = plain(asdict(diagnosis))
    for name in ("missing", "partial", "nearest"):
        content[name] = [_flat(found) for found in content[name]]
    content["independence"] = diagnosis.independence.to_json()
    return {"format": FORMAT, **content}


def _flat(found: dict[str, Any]) -> dict[str, Any]:
    """An effect with its errors among its own entries."""
    flat: dict[str, Any] = {}
    for name, value in found.items():
        flat |= value if name == "errors" else {name: value}
    return flat


def write_json(content: dict[str, Any], path: Path) -> None:
    """Write plain data as JSON, whole or not at all."""
    write_atomic(path, json.dumps(content, indent=1, allow_nan=False) + "\n")
