"""Conditions that a candidate model must meet before a line uses it: forecasts of unseen cables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cell.cable.effects.base import Effect, Parameter
from cell.lab.fit.shared import Spread
from cell.lab.line.effect_fit import EffectFit
from cell.lab.line.forecasts import ForecastPair, forecasts
from cell.lab.line.learn import LearningResult
from cell.plan.destination import Destination
from cell.settings import Settings
from cell.settings.translate import cable_of, identification_of

FloatArray = NDArray[np.float64]

#: Forecasts that there must be for a candidate to be judged.
FEWEST = 3
#: The candidate's forecast must err less than the present model's by this share, and by so much.
BETTER, BETTER_M = 0.1, 1e-5
#: One-sided, of the paired differences over all frames (Wilcoxon); of fewer than five forecasts
#: none may be worse in the destination by more than the noise.
SIGNIFICANCE = 0.05
#: By which the worst forecast may become worse: what arm and camera repeat to, m.
REPEATABILITY_M = 1e-4
#: A parameter must differ from what it is without the effect by so many standard deviations.
IDENTIFIABLE = 3.0
#: Cables of one line may differ in an effect by this share of it; where Cochran's Q says with this
#: significance that they differ by more, they are of two lines, or have it in another way.
ALIKE, HETEROGENEOUS = 0.1, 0.01


@dataclass(frozen=True)
class Gate:
    """One condition, whether it is met, and what was found."""

    name: str
    passed: bool
    found: str


@dataclass(frozen=True)
class Judgement:
    """Conditions that a candidate was held against, and the forecasts they rest on."""

    gates: tuple[Gate, ...] = ()
    paired: tuple[ForecastPair, ...] = ()

    @property
    def fit_for_line(self) -> bool:
        """Whether every condition is met."""
        return all(gate.passed for gate in self.gates)


def judge(
    lesson: LearningResult, settings: Settings, known: Sequence[ForecastPair] = ()
) -> Judgement:
    """The lesson's candidate held against every condition, for the line of these settings.

    known   forecasts of the present model that were made already; of any candidate
    raises  as `identification_of`
    """
    if lesson.best is None:
        return Judgement()
    destination = Destination(*settings.destination.x_m, *settings.destination.y_m)
    cable, options = cable_of(settings), identification_of(settings)
    paired = forecasts(lesson, cable, options, destination, known)
    return Judgement(tuple(gates(lesson, paired, destination)), tuple(paired))


def best_judged(
    lesson: LearningResult, settings: Settings, known: Sequence[ForecastPair] = ()
) -> tuple[LearningResult, Judgement]:
    """The lesson, or the simpler one in it if its last effect does not help; and its judgement.

    The last effect helps if with it unseen cables are forecast better than without, by the gate
    that a first effect must pass.
    known   as in `judge`
    """
    judgement = judge(lesson, settings, known)
    if lesson.simpler is None:
        return lesson, judgement
    simpler, without = best_judged(lesson.simpler, settings, judgement.paired)
    pairs = zip(without.paired, judgement.paired, strict=True)
    gained = [
        replace(after, present_m=before.candidate_m, present_rms_m=before.candidate_rms_m)
        for before, after in pairs
    ]
    helps = len(gained) >= FEWEST and _better(gained, lesson.noise_m).passed
    if judgement.fit_for_line and helps:
        return lesson, judgement
    return simpler, without


def gates(
    lesson: LearningResult, paired: Sequence[ForecastPair], destination: Destination
) -> list[Gate]:
    """All conditions, each with what was found."""
    assert lesson.best is not None
    before = np.array([f.present_m for f in paired])
    after = np.array([f.candidate_m for f in paired])
    gate = [
        Gate(
            "enough forecasts",
            len(paired) >= FEWEST,
            f"{sum(f.of == 'execution' for f in paired)} executions, {len(paired)} in all, "
            f"needs {FEWEST}",
        )
    ]
    if len(paired) >= FEWEST:
        gate += [_better(paired, lesson.noise_m), _worst(before, after)]
        gate.append(_passing(before, after, destination))
    tried = lesson.best
    return [*gate, _inside(tried), _identifiable(tried), _consistent(lesson), _alike(tried)]


def _better(paired: Sequence[ForecastPair], noise_m: float) -> Gate:
    """Whether the tip is forecast better in the destination, and surely so in all frames.

    A single frame's noise is as large as what a small effect does there; all of them tell it.
    """
    before, after, path_before, path_after = np.array(
        [(f.present_m, f.candidate_m, f.present_rms_m, f.candidate_rms_m) for f in paired]
    ).T
    rms = [float(np.sqrt(np.mean(v**2))) for v in (before, after)]
    if len(before) >= 5:
        from scipy.stats import wilcoxon  # half a second, of which only few have need

        same = np.array_equal(path_before, path_after)  # no rank differs: it divides by zero
        p = 1.0 if same else float(wilcoxon(path_before, path_after, alternative="greater").pvalue)
        sure, how = p <= SIGNIFICANCE, f"p = {p:.2g}"
    else:
        worse = int(np.sum(after > before + noise_m))
        sure, how = worse == 0, f"{worse} of {len(before)} worse"
    enough = rms[1] < (1.0 - BETTER) * rms[0] and rms[0] - rms[1] > BETTER_M
    found = f"{rms[0] * 1e3:.3f} → {rms[1] * 1e3:.3f} mm rms, {how}"
    return Gate("forecasts unseen cables better", bool(sure and enough), found)


def _worst(before: FloatArray, after: FloatArray) -> Gate:
    passed = bool(after.max() <= before.max() + REPEATABILITY_M)
    found = f"{before.max() * 1e3:.3f} → {after.max() * 1e3:.3f} mm"
    return Gate("worst case no worse", passed, found)


def _passing(before: FloatArray, after: FloatArray, destination: Destination) -> Gate:
    half_m = 0.5 * (destination.y_max_m - destination.y_min_m)
    counts = [int(np.sum(v < half_m)) for v in (before, after)]
    found = f"{counts[0]} → {counts[1]} of {len(before)} forecast within ± {half_m * 1e3:.1f} mm"
    return Gate("as many would have passed", counts[1] >= counts[0], found)


def _inside(tried: EffectFit) -> Gate:
    fit = tried.fit
    low, high = fit.space.low[fit.common], fit.space.high[fit.common]
    at = [n for n, v, a, b in zip(tried.names, fit.theta, low, high, strict=True) if not a < v < b]
    return Gate("inside physical bounds", not at, ", ".join(at) + " at a bound" if at else "all")


def _identifiable(tried: EffectFit) -> Gate:
    """Whether an amplitude of every effect stands out of its uncertainty."""
    clearest = [_clearest(tried, effect) for effect in tried.effects]
    least = min(0.0 if found is None else found[2] for found in clearest)
    return Gate("identifiable", least >= IDENTIFIABLE, f"{least:.1f} standard deviations from none")


def _clearest(tried: EffectFit, effect: type[Effect]) -> tuple[int, float, float] | None:
    """Of an effect's amplitudes the one that stands out most: where it is among the shared
    parameters, its coordinate without the effect, and how many standard deviations it is from
    there; None = none is fitted.
    """
    fit, std = tried.fit, np.sqrt(np.diag(tried.fit.covariance))
    found = []
    for p in effect.parameters:
        name = f"{effect.name}.{p.name}"
        if p.amplitude and name in tried.names:
            i = tried.names.index(name)
            none = _none(tried, i, p)
            found.append((i, none, abs(float(fit.theta[i]) - none) / float(std[i])))
    return max(found, key=lambda f: f[2], default=None)


def _none(tried: EffectFit, i: int, parameter: Parameter) -> float:
    """Coordinate of the i-th shared parameter at which its effect is off."""
    logarithmic = tried.fit.space.logarithmic[tried.fit.common[i]]
    return float(np.log(parameter.default)) if logarithmic else parameter.default


def _consistent(lesson: LearningResult) -> Gate:
    """Whether the effects stay as they are whichever cable is left out."""
    assert lesson.best is not None
    tried, fit = lesson.best, lesson.best.fit
    if len(fit.cables) < 2:
        return Gate("consistent between cables", False, "1 cable")
    left = np.array([fit.without(i) for i in range(len(fit.cables))])
    remain = []
    for effect in tried.effects:
        if (clearest := _clearest(tried, effect)) is None:
            continue
        i, none, _ = clearest
        size = float(fit.theta[i]) - none
        remain += [float(v - none) / size if size != 0.0 else 0.0 for v in left[:, i]]
    passed = all(0.5 < v < 2.0 for v in remain)
    found = f"{min(remain, default=1.0):.2f} … {max(remain, default=1.0):.2f} of it remain"
    return Gate("whichever cable is left out", passed, found)


def _alike(tried: EffectFit) -> Gate:
    """Whether all cables have the effects alike: Cochran's Q beyond what cables may differ by.

    source  Cochran 1954, Biometrics 10, 101
    """
    name = "all cables have it alike"
    values, std = tried.fit.by_cable
    if len(values) < 2:
        return Gate(name, False, "1 cable")
    least: tuple[float, str] = (np.inf, "")
    for effect in tried.effects:
        if (clearest := _clearest(tried, effect)) is None:
            continue
        i, none, _ = clearest
        size = abs(float(tried.fit.theta[i]) - none)
        may = ALIKE * (1.0 if tried.fit.space.logarithmic[tried.fit.common[i]] else size)
        spread = Spread.of(values[:, i], np.hypot(std[:, i], may))
        found = (
            f"{tried.names[i]} differs by {spread.tau:.2g} beyond a tenth of it: "
            f"Q {spread.q:.1f} of {spread.dof}, p = {spread.p_value:.1g}"
        )
        least = min(least, (spread.p_value, found))
    return Gate(name, least[0] >= HETEROGENEOUS, least[1] or "no strength is fitted")
