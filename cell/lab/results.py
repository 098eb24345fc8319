"""What the lab finds, as data: the diagnosis and its JSON (cable-diagnosis/1)."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

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
class Found:
    """An effect the model lacks, in the order of adding.

    tied_with      effects that these motions cannot tell from it
    p_value        of the fall of χ² on the fit trials, adjusted for the size of the library
    delta_bic      BIC gained on the fit trials (positive = better)
    errors         with all effects up to this one
    """

    effect: str
    tied_with: tuple[str, ...]
    p_value: float
    delta_bic: float
    parameters: dict[str, Interval]
    errors: Errors


@dataclass(frozen=True)
class Ranked:
    """How an effect fared.  `score`: χ² it explains on the fit trials beyond the baseline."""

    effect: str
    score: float
    p_value: float
    status: Status


@dataclass(frozen=True)
class Diagnosis:
    """Which effect is missing, or that none is, none known fits, or these motions cannot tell."""

    noise_m: float
    baseline: Errors
    verdict: Verdict
    missing: tuple[Found, ...] = ()
    ranking: tuple[Ranked, ...] = field(default=())


def to_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """The diagnosis as plain data in the form cable-diagnosis/1; nan becomes null."""
    return {
        "format": FORMAT,
        "noise_m": _number(diagnosis.noise_m),
        "baseline": _errors(diagnosis.baseline),
        "verdict": diagnosis.verdict,
        "missing": [
            {
                "effect": f.effect,
                "tied_with": list(f.tied_with),
                "p_value": _number(f.p_value),
                "delta_bic": _number(f.delta_bic),
                "parameters": {
                    name: {
                        "value": _number(p.value),
                        "low": _number(p.low),
                        "high": _number(p.high),
                        "unit": p.unit,
                    }
                    for name, p in f.parameters.items()
                },
                **_errors(f.errors),
            }
            for f in diagnosis.missing
        ],
        "ranking": [
            {
                "effect": r.effect,
                "score": _number(r.score),
                "p_value": _number(r.p_value),
                "status": r.status,
            }
            for r in diagnosis.ranking
        ],
    }


def write_json(content: dict[str, Any], path: Path) -> None:
    """Write plain data as JSON, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    part.replace(path)


def _errors(errors: Errors) -> dict[str, float | None]:
    return {
        "fit_rms_m": _number(errors.fit_rms_m),
        "heldout_rms_m": _number(errors.heldout_rms_m),
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
