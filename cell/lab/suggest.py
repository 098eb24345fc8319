"""Suggests the safe motion that best tells the remaining candidates apart (T-optimal design).

Source: Atkinson & Fedorov, The design of experiments for discriminating between two rival models,
Biometrika 62 (1975) 57.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from scipy import stats

from cell.cable.geometry import Motion
from cell.identify.noise import Whitener
from cell.lab.bench import Bench
from cell.lab.diagnose import Examination
from cell.lab.explore import Candidate, Explorer
from cell.located import InputError, load
from cell.study.data import Markers, Trial

FloatArray = NDArray[np.float64]

FORMAT = "cell-motion/1"
STILL_S, HOLD_S, RATE_HZ = 0.2, 1.0, 500.0
ATTITUDES_RAD = tuple(np.radians([-90.0, -60.0, -30.0, 0.0, 30.0, 60.0]))
STROKES_M = ((0.0, -0.05), (0.0, -0.08), (-0.08, 0.0), (0.0, 0.05), (-0.05, -0.05))
SLOWNESS = (1.0, 1.6)
#: χ² by which one candidate must beat the other to be believed; as `Rules.tie`.
DECIDED = 9.0
#: Peaks of a fifth-order polynomial from rest to rest over 1 m in 1 s.
PEAK_V, PEAK_A, PEAK_J = 1.875, 5.7735, 60.0


class SafeLimits(BaseModel):
    """Where the hand may go and how fast; the `limits` of a cell's settings."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    x_m: tuple[float, float] = (-0.3, 0.3)
    y_m: tuple[float, float] = (-0.3, 0.3)
    angle_rad: tuple[float, float] = (-1.6, 1.6)
    velocity_m_per_s: Annotated[float, Field(gt=0)] = 0.5
    acceleration_m_per_s2: Annotated[float, Field(gt=0)] = 5.0
    jerk_m_per_s3: Annotated[float, Field(gt=0)] = 200.0


@dataclass(frozen=True)
class Stroke:
    """From rest at the origin, clamp at `angle_rad`, straight by (dx, dy) in `duration_s`, held."""

    angle_rad: float
    dx_m: float
    dy_m: float
    duration_s: float

    def describe(self) -> str:
        """For a person."""
        return (
            f"clamp at {np.degrees(self.angle_rad):.0f}°, by ({self.dx_m * 1e3:.0f}, "
            f"{self.dy_m * 1e3:.0f}) mm in {self.duration_s:.2f} s"
        )

    def motion(self) -> Motion:
        """The hand's pose against time: still, a fifth-order polynomial, held."""
        t_s = np.arange(0.0, STILL_S + self.duration_s + HOLD_S, 1.0 / RATE_HZ)
        u = np.clip((t_s - STILL_S) / self.duration_s, 0.0, 1.0)
        s = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
        return Motion(t_s, self.dx_m * s, self.dy_m * s, np.full_like(t_s, self.angle_rad))


@dataclass(frozen=True)
class Option:
    """A motion, the χ² that it puts between the candidates, and the probability of a decision."""

    motion: Stroke
    separation: float
    power: float


@dataclass(frozen=True)
class Suggestion:
    """Motions, the most telling first, and between what they tell."""

    candidates: tuple[str, str]
    options: tuple[Option, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "format": "cable-suggestion/1",
            "candidates": list(self.candidates),
            "options": [
                {**vars(o.motion), "separation": o.separation, "power": o.power}
                for o in self.options
            ],
        }


def read_limits(config: Path | None) -> SafeLimits:
    """`limits` of a cell's settings; cautious ones without.  Raises InputError."""
    if config is None:
        return SafeLimits()
    document = load(config)
    entries = document.data.get("limits") if isinstance(document.data, dict) else None
    if not isinstance(entries, dict):
        raise InputError([document.problem((), "has no section `limits`")])
    try:
        return SafeLimits(**entries)
    except ValueError as error:
        raise InputError([document.problem(("limits",), str(error))]) from error


def suggest_motion(explorer: Explorer, examination: Examination, limits: SafeLimits) -> Suggestion:
    """The motion at which the two likeliest candidates differ most, whatever both leave open.

    Each candidate may move within what the trials so far leave uncertain of it; what then still
    separates their markers, in standard deviations squared, is the separation.
    """
    first, second = _rivals(explorer, examination)
    noise = explorer.bench.noise
    options = []
    for stroke in strokes(limits):
        separation = _separation(explorer.bench, first, second, stroke)
        if not np.isfinite(separation):
            continue
        reach = (separation - DECIDED) / (2.0 * np.sqrt(max(separation, 1e-12)))
        options.append(Option(stroke, separation, float(stats.norm.cdf(reach))))
    if not options:
        raise ValueError(
            f"no stroke within the limits can be simulated (noise {noise.std_m:g} m); widen them"
        )
    options.sort(key=lambda o: -o.separation)
    return Suggestion((_label(first), _label(second)), tuple(options))


def strokes(limits: SafeLimits) -> list[Stroke]:
    """All strokes on offer that stay within the limits, as fast as these allow and slower."""
    found = []
    for angle, (dx, dy), slow in itertools.product(ATTITUDES_RAD, STROKES_M, SLOWNESS):
        inside = (
            limits.angle_rad[0] <= angle <= limits.angle_rad[1]
            and limits.x_m[0] <= dx <= limits.x_m[1]
            and limits.y_m[0] <= dy <= limits.y_m[1]
        )
        if not inside:
            continue
        way = float(np.hypot(dx, dy))
        least_s = max(
            PEAK_V * way / limits.velocity_m_per_s,
            (PEAK_A * way / limits.acceleration_m_per_s2) ** 0.5,
            (PEAK_J * way / limits.jerk_m_per_s3) ** (1.0 / 3.0),
        )
        found.append(Stroke(float(angle), dx, dy, round(slow * least_s + 0.005, 3)))
    return found


def write_motion(suggestion: Suggestion, path: Path) -> None:
    """Write the best motion as YAML for `cell run --motion`."""
    best = suggestion.options[0]
    content = {
        "format": FORMAT,
        "purpose": f"tell {suggestion.candidates[0]} from {suggestion.candidates[1]}",
        "start": {"x_m": 0.0, "y_m": 0.0, "angle_rad": best.motion.angle_rad},
        "still_s": STILL_S,
        "moves": [
            {
                "x_m": best.motion.dx_m,
                "y_m": best.motion.dy_m,
                "angle_rad": best.motion.angle_rad,
                "duration_s": best.motion.duration_s,
            }
        ],
        "hold_s": HOLD_S,
    }
    part = path.with_name(path.name + ".part")
    part.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    part.replace(path)


def _rivals(explorer: Explorer, examination: Examination) -> tuple[Candidate, Candidate]:
    """The two sets of effects that explain the trials best."""
    known = [*examination.steps, *examination.singles, *explorer.known()]
    distinct = list({c.names: c for c in known}.values())
    best = sorted(distinct, key=lambda c: -c.evidence)
    if len(best) < 2:
        raise ValueError("there is only one candidate; nothing to tell apart")
    return best[0], best[1]


def _separation(bench: Bench, first: Candidate, second: Candidate, stroke: Stroke) -> float:
    """χ² between the candidates on a stroke that neither's open parameters can remove."""
    motion = stroke.motion()
    t_s = motion.t_s[::3][1:]
    shape = (len(t_s), len(bench.study.arc_length_m), 2)
    trial = Trial("stroke", "validate", "equilibrium", motion, Markers(t_s, np.zeros(shape)))
    whiten = Whitener(trial.markers.xy_m, bench.noise)
    white, spread = [], []
    for candidate in (first, second):
        space, q = candidate.fit.space, candidate.fit.q
        step = np.where(q + space.step <= space.high, space.step, -space.step)
        lanes = [space.model(q), *(space.model(q + row) for row in np.diag(step))]
        rows = whiten(bench.predict(trial, lanes))
        values, vectors = np.linalg.eigh(candidate.fit.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        white.append(rows[0])
        spread.append(((rows[1:] - rows[0]).T / step) @ root)
    apart = white[0] - white[1]
    if not np.isfinite(apart).all():
        return float("nan")
    span = np.hstack(spread)
    against = span.T @ apart
    inner = np.eye(span.shape[1]) + span.T @ span
    return float(apart @ apart - against @ np.linalg.solve(inner, against))


def _label(candidate: Candidate) -> str:
    return " + ".join(e.name for e in candidate.effects) or "baseline"
