"""Results of the lab as data: the diagnosis and its JSON (cable-diagnosis/1)."""

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

    tied_with      effects that these motions cannot distinguish from it
    p_value        of the fall of χ² on the fit trials, adjusted for the size of the library; where
                   the model's own error remains, of the fall of that over all trials if larger
    delta_bic      BIC gained on the fit trials (positive = better)
    errors         with all effects up to this one; of a partial explanation, which is fitted to all
                   trials, the error on them all, and none held out
    explained_share  share of the baseline's mean square beyond noise, over all trials, removed by
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

    frequency_hz  at which its power is farthest above the noise's; nan if the trial is too short
    """

    trial: str
    time_s: float
    arc_length_m: float
    frequency_hz: float


@dataclass(frozen=True)
class RemainingError:
    """Residual error of the final model over all trials.

    before_rms_m     of the baseline, fitted to the same trials
    over_noise       rms over that of the measurement
    explained_share  removed share of the baseline's mean square beyond noise
    """

    rms_m: float
    before_rms_m: float
    over_noise: float
    explained_share: float
    peak: Peak


@dataclass(frozen=True)
class Nearest:
    """An effect with one of the smallest residuals, which is more than noise.

    explained_share, left_rms_m  over all trials, fitted to all; `left_rms_m`: rms residual
    errors                       fitted to the fit trials alone; nan if it was not
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

    low, high  of the parameter: the study excludes values outside; None = not detectable in this
               study at any size, or only beyond the parameter's bounds
    tip_m      largest displacement of the outermost marker by the effect at its limit, the other
               parameters as fitted
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

    value    joint estimate of all trials
    spread   standard deviation between trials in excess of their uncertainties, in `unit`
    p_value  of the trials' differences, adjusted for the number of parameters
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
    """A check of the verdict and its result.

    unit       of statistic and limit
    statistic  None where the check does not apply to the study
    passes     comparison of statistic and limit that holds if the check passes
    passed     None where the check does not apply
    failing    the verdict if it fails, unless another check makes it worse
    failed     sentence for a failure
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
    """Result of a diagnosis: its verdict, the missing effects, and their evidence.

    The order of the fields is that of the files.
    noise_is_stated  by the study; else it was measured at rest
    left      residual of the model with all effects in `missing`, or else in `partial`; the latter
              fitted to all trials
    partial   of an unexplained study: effects that explain most of the error, not all
    nearest   of an unexplained study: the single effects with the smallest residuals
    limits    of the sizes of effects that are neither named nor tied
    agreement  of the trials, in each parameter of the final model; empty for a single trial
    checks    of the model, in order; the verdict is the worst of the failed ones
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
        """Codes of its warnings."""
        return frozenset(w.code for w in self.warnings)

    @property
    def ended_early(self) -> bool:
        """Whether it cannot tell because a person or the limit of work ended it."""
        return self.verdict == "cannot_tell" and bool(self.codes & {"interrupted", "cut_short"})


def to_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """The diagnosis as plain data in the form cable-diagnosis/1; nan becomes null."""
    content = plain(asdict(diagnosis))
    for name in ("missing", "partial", "nearest"):
        content[name] = [_flat(entry) for entry in content[name]]
    content["independence"] = diagnosis.independence.to_json()
    return {"format": FORMAT, **content}


def _flat(entry: dict[str, Any]) -> dict[str, Any]:
    """An effect with its errors among its own entries."""
    flat: dict[str, Any] = {}
    for name, value in entry.items():
        flat |= value if name == "errors" else {name: value}
    return flat


def write_json(content: dict[str, Any], path: Path) -> None:
    """Write plain data as JSON, atomically."""
    write_atomic(path, json.dumps(content, indent=1, allow_nan=False) + "\n")
