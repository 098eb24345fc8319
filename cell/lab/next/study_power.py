"""The power of a study: what its diagnosis would find of effects that are not in it, as data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from cell.files.plain import plain
from cell.lab.data.prepared import ERRS
from cell.lab.data.progress import Progress, no_progress
from cell.lab.data.results import Doubt
from cell.lab.data.thresholds import DEFAULT_RULES, Rules
from cell.lab.next.asked import AskedEffect
from cell.lab.next.decisions import Chances
from cell.lab.next.forecast import POWER, PowerForecast, forecast
from cell.lab.next.linear_study import LinearStudy
from cell.lab.next.recovery import Recovery, recover
from cell.lab.search.fit_cache import FitCache
from cell.lab.verdict.doubts import no_model_doubt
from cell.lab.verdict.fit_doubts import is_no_model
from cell.workers.executor import Executor

FORMAT = "cable-power/1"


@dataclass(frozen=True)
class EffectPower:
    """An effect that is hidden, the forecast, and what copies with it have shown.

    recovery  None = no copies were made
    """

    asked: AskedEffect
    forecast: PowerForecast
    recovery: Recovery | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        said = self.forecast
        return {
            "effect": self.asked.effect.name,
            "parameter": self.asked.parameter.name,
            "unit": self.asked.parameter.unit,
            "size": said.size,
            "forecast": None if said.chances is None else _chances(said.chances),
            "noncentrality": said.noncentrality,
            "smallest": said.smallest,
            "rivals": [vars(r) for r in said.rivals],
            "recovery": None if self.recovery is None else _recovery(self.recovery),
        }


@dataclass(frozen=True)
class StudyPower:
    """What a diagnosis of a study would find.

    noise_m   of the measurement
    rules     by which the diagnosis decides
    """

    study: str
    noise_m: float
    effects: tuple[EffectPower, ...]
    warnings: tuple[Doubt, ...]
    rules: Rules

    def to_json(self) -> dict[str, Any]:
        """Plain data, format cable-power/1."""
        return {
            "format": FORMAT,
            "study": self.study,
            "noise_m": self.noise_m,
            "power": POWER,
            "rules": plain(vars(self.rules)),
            "effects": [plain(e.to_json()) for e in self.effects],
            "warnings": [vars(w) for w in self.warnings],
        }


def power_of(
    fits: FitCache,
    asked: Sequence[AskedEffect],
    copies: int = 0,
    rules: Rules = DEFAULT_RULES,
    progress: Progress = no_progress,
    executor: Executor | None = None,
) -> StudyPower:
    """What a diagnosis would find of each effect, were it in a study.

    copies    that are made and diagnosed with each, to compare with the forecast
    executor  who diagnoses them; None = all cores of this computer
    raises    ValueError: the study cannot be fitted; UnsimulatedError: nor simulated
    """
    base = fits.baseline()
    if is_no_model(fits, base.fit):
        raise ValueError(f"study {fits.prepared.study.name}: {no_model_doubt().message}")
    progress("what the trials show of the parameters")
    linear = LinearStudy.of(fits.prepared, base.fit)
    found = []
    for number, one in enumerate(asked):
        progress(f"what the trials show of {one.effect.name}", number, len(asked))
        found.append(EffectPower(one, forecast(fits, one, linear, rules)))
        fits.work.renew()
    if copies:
        found = [_tried(fits, e, copies, rules, progress, executor) for e in found]
    noise_m = fits.prepared.noise_model.noise.std_m
    return StudyPower(fits.prepared.study.name, noise_m, tuple(found), _doubts(fits), rules)


def _tried(
    fits: FitCache,
    effect: EffectPower,
    copies: int,
    rules: Rules,
    progress: Progress,
    executor: Executor | None,
) -> EffectPower:
    size = effect.forecast.size
    if size is None:
        return effect
    recovery = recover(fits, effect.asked.at(size), copies, rules, progress, executor=executor)
    return EffectPower(effect.asked, effect.forecast, recovery)


def _doubts(fits: FitCache) -> tuple[Doubt, ...]:
    """Why power may be other than it is said to be."""
    prepared, found = fits.prepared, []
    if not prepared.study.role("validate"):
        found.append(
            Doubt(
                "confirmation",
                "no trial is held out, and a diagnosis claims only what such a trial confirms; "
                "mark one with another motion `role: validate`",
            )
        )
    over = fits.baseline().fit.rms_m / prepared.expected_m("fit")
    if over > ERRS:
        found.append(
            Doubt(
                "misfit",
                f"the fitted model leaves {over:.2g} times the noise, and power is told beside the "
                "noise alone; add what the study lacks with --known",
            )
        )
    return tuple(found)


def _chances(chances: Chances) -> dict[str, Any]:
    return {
        "found": chances.found,
        "confused": dict(chances.confused),
        "missed": chances.missed,
        "significant": chances.significant,
        "confirmed": chances.confirmed,
        "identified": chances.identified,
        "told_apart": chances.told_apart,
    }


def _recovery(recovery: Recovery) -> dict[str, Any]:
    share, low, high = recovery.share
    return {
        "copies": len(recovery.outcomes),
        "asked": recovery.asked,
        "found": recovery.count("found"),
        "share": share,
        "low": low,
        "high": high,
        "confused": dict(recovery.confused_with),
        "undecided": recovery.count("undecided"),
        "missed": recovery.count("missed"),
        "unexplained": recovery.count("unexplained"),
        "failed": recovery.count("failed"),
    }
