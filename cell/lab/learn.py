"""What recorded cables say is missing in the line's model: which effect, how much, how sure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc as chi2_sf

from cell.cable.effects.base import Effect
from cell.cable.geometry import Cable
from cell.identify.gauss_newton import Options
from cell.identify.individual import CableRejectedError, IdentifyOptions, identify
from cell.identify.parameters import ParameterSpace
from cell.lab.cycles import RecordedCycle
from cell.lab.fitting import Fit
from cell.lab.prepared import PreparedStudy
from cell.lab.score import holm
from cell.lab.screen import ScreenedEffect, screen
from cell.lab.shared import SharedFit, Spread, fit_shared, prepared_cycle

FloatArray = NDArray[np.float64]

#: Cables that the library is tried on; and that a model is then fitted to, at most.
TRIED_ON, FITTED_TO = 4, 12
#: Effects of the screen that are refitted, besides those that are not smooth.
BEST = 4
#: Starts of a fit are compared on so many cables, with so many passes.
START_ON, FIRST_PASSES = 1, Options(tolerance=1.0, most_passes=6)
#: Family-wise, over the library (Holm).
SIGNIFICANCE = 0.01
#: Effects are one class if their χ², over its inflation, differs by less; as in a diagnosis.
TIE = 9.0
#: A model is complete for the line if it misses by no more than this above the noise, m.
NEGLIGIBLE_M = 5e-6

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class EffectFit:
    """An effect fitted to several cables, its parameters shared.

    fall     of χ² over the residuals' inflation
    p_value  of it, adjusted for the size of the library
    """

    effect: type[Effect]
    fit: SharedFit
    fall: float
    p_value: float

    @property
    def names(self) -> tuple[str, ...]:
        """Shared parameters, as `effect.parameter`."""
        return tuple(self.fit.space.names[i] for i in self.fit.common)


@dataclass(frozen=True)
class Vote:
    """Evidence of one cycle for or against an effect.

    fall    of its own χ² over the inflation: positive speaks for the effect
    value   of its first parameter as this cable alone would have it
    std     of that
    """

    cycle: str
    fall: float
    value: float
    std: float


@dataclass(frozen=True, eq=False)
class Lesson:
    """The result of learning from many cables: the missing effect, or that none is missing.

    cycles    that were learned from, as in `votes`
    baseline  the present model, fitted to them
    ranking   effects that were refitted, the likeliest first
    best      the likeliest, fitted to all of `cycles`; None = nothing significant is missing
    tied      effects that explain as much
    spread    of its first parameter between cables
    """

    cycles: tuple[RecordedCycle, ...]
    baseline: SharedFit
    ranking: tuple[EffectFit, ...]
    best: EffectFit | None
    tied: tuple[str, ...]
    spread: Spread | None
    votes: tuple[Vote, ...]

    @property
    def noise_m(self) -> float:
        """Mean noise of the cycles."""
        return float(np.mean([c.noise.std_m for c in self.baseline.cables]))


def learn(
    cycles: Sequence[RecordedCycle],
    cable: Cable,
    options: IdentifyOptions,
    library: Mapping[str, type[Effect]],
    progress: Progress = lambda _: None,
) -> Lesson:
    """Which one effect the model of `options` lacks, as all cycles together see it.

    raises  ValueError: no cable can be identified; NoiseUnknownError
    """
    usable, starts = [], []
    for cycle in cycles:
        progress(f"identifying {cycle.name}")
        trial = cycle.held or cycle.study.trials[0]
        try:
            found = identify(trial, cycle.study.arc_length_m, cable, options=options)
        except CableRejectedError:
            continue
        usable.append((cycle, found))
        starts.append(found.model_error_m)
    if not usable:
        raise ValueError("none of these cables could be identified: nothing can be learned")
    # Those that the model misses most tell most; executions are judged by, and come first.
    order = sorted(range(len(usable)), key=lambda i: (usable[i][0].executed is None, -starts[i]))[
        :FITTED_TO
    ]
    chosen = [usable[i] for i in order]
    prepared = [prepared_cycle(cycle.whole) for cycle, _ in chosen]
    q = np.array([found.mean for _, found in chosen])
    base = options.kind.space(cable, chosen[0][0].study.gravity_m_per_s2)
    progress("fitting the present model")
    alone = [fit_shared([p], base, q[i : i + 1]) for i, p in enumerate(prepared)]
    few = slice(0, TRIED_ON)
    others = [e for e in library.values() if e not in base.effects]
    progress("screening the library")
    screens = [
        screen(p, _as_fit(a), others) for p, a in zip(prepared[few], alone[few], strict=True)
    ]
    tried = _refitted(prepared[few], base, alone[few], screens, len(others), progress)
    baseline = fit_shared(prepared, base, np.vstack([a.q for a in alone]))
    best = tried[0] if tried and tried[0].p_value < SIGNIFICANCE else None
    names = tuple(c for c, _ in chosen)
    if best is None or _negligible(baseline):
        return Lesson(names, baseline, tuple(tried), None, (), None, ())
    progress(f"fitting {best.effect.name} to {len(prepared)} cables")
    tied = tuple(t.effect.name for t in tried[1:] if best.fall - t.fall < TIE)
    best = _on_all(prepared, base, baseline, best)
    values, std = best.fit.by_cable
    votes = tuple(
        Vote(cycle.name, float(fall), float(values[i, 0]), float(std[i, 0]))
        for i, (cycle, fall) in enumerate(
            zip(
                names,
                (baseline.chi2_by_cable - best.fit.chi2_by_cable) / best.fit.inflation,
                strict=True,
            )
        )
    )
    spread = Spread.of(values[:, 0], std[:, 0])
    return Lesson(names, baseline, tuple(tried), best, tied, spread, votes)


def _negligible(baseline: SharedFit) -> bool:
    noise_m = float(np.mean([c.noise.std_m for c in baseline.cables]))
    return baseline.rms_m**2 - noise_m**2 < NEGLIGIBLE_M**2


def _refitted(
    prepared: Sequence[PreparedStudy],
    base: ParameterSpace,
    alone: Sequence[SharedFit],
    screens: Sequence[Sequence[ScreenedEffect]],
    library: int,
    progress: Progress,
) -> list[EffectFit]:
    """The likeliest effects, fitted to all these cables at once, the best first."""
    score: dict[str, float] = {}
    for screened in screens:
        for s in screened:
            score[s.effect.name] = score.get(s.effect.name, 0.0) + s.score.statistic
    effects = {s.effect.name: s.effect for s in screens[0]}
    ranked = sorted(effects, key=lambda n: -score[n])
    names = ranked[:BEST] + [n for n in ranked[BEST:] if not effects[n].smooth]
    fits = []
    q = np.vstack([a.q for a in alone])
    for name in names:
        progress(f"refitting with {name}")
        guesses = [s.starts[0] for found in screens for s in found if s.effect.name == name]
        fit = _best_start(prepared, base, q, effects[name], guesses)
        if fit is not None:
            fits.append((effects[name], fit))
    if not fits:
        return []
    before = sum(a.chi2 for a in alone)
    inflation = min(fits, key=lambda f: f[1].chi2)[1].inflation
    falls = [(before - fit.chi2) / inflation for _, fit in fits]
    p = [
        float(chi2_sf(len(fit.theta), max(fall, 0.0)))
        for fall, (_, fit) in zip(falls, fits, strict=True)
    ]
    adjusted = holm(p + [1.0] * (library - len(p)))[: len(p)]
    tried = [
        EffectFit(effect, fit, float(fall), float(value))
        for (effect, fit), fall, value in zip(fits, falls, adjusted, strict=True)
    ]
    return sorted(tried, key=lambda t: -t.fall)


def _best_start(
    prepared: Sequence[PreparedStudy],
    base: ParameterSpace,
    q: FloatArray,
    effect: type[Effect],
    guesses: Sequence[FloatArray],
) -> SharedFit | None:
    """The effect fitted to all cables, from the start that leads furthest on a few."""
    # a smooth effect's slope says where to begin
    places = [np.median(np.array(guesses), axis=0)]
    if not effect.smooth:
        places += [
            np.array([p.starts[min(k, len(p.starts) - 1)] for p in effect.parameters])
            for k in range(3)
        ]
    found: list[SharedFit] = []
    for values in places if len(places) > 1 else ():
        try:
            found.append(
                fit_shared(
                    prepared[:START_ON],
                    base,
                    q[:START_ON],
                    [effect],
                    values,
                    options=FIRST_PASSES,
                )
            )
        except ValueError:
            continue
    begin, values = q.copy(), places[0]
    if found:
        best = min(found, key=lambda f: f.chi2)
        begin[:START_ON], values = best.q, _natural(best)
    try:
        return fit_shared(prepared, base, begin, [effect], values)
    except ValueError:
        return None


def _on_all(
    prepared: Sequence[PreparedStudy], base: ParameterSpace, baseline: SharedFit, best: EffectFit
) -> EffectFit:
    q = baseline.q.copy()
    q[: len(best.fit.q)] = best.fit.q
    fit = fit_shared(prepared, base, q, [best.effect], _natural(best.fit))
    fall = (baseline.chi2 - fit.chi2) / fit.inflation
    return replace(best, fit=fit, fall=float(fall))


def _natural(fit: SharedFit) -> FloatArray:
    """Natural values of all parameters of the shared effects, those not fitted included."""
    q = fit.space.mean.copy()
    q[fit.common] = fit.theta
    return np.asarray(fit.space.natural(q)[fit.own :])


def _as_fit(alone: SharedFit) -> Fit:
    """The fit of a single cable as the screen takes it."""
    return Fit(
        space=alone.space,
        q=alone.q[0],
        delay_s={},
        solution=alone.solution,
        chi2=float(alone.chi2_by_cable[0]),
        objective=alone.chi2,
        rms_m=alone.rms_m,
    )
