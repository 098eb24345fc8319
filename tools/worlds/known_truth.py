"""Power of an ideal test that knows the hidden effect of a study, and the size of its signal.

The residual χ² of the hidden effect on all trials after a noise-free fit of the baseline, compared
with the critical χ² of a test over the complete library at 1 %.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy import stats

from cell.cable.effects import ActiveEffect, Effect
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy, with_noise_model
from cell.lab.fit.fitting import fit_trials
from cell.lab.search.fit_cache import FitCache, SearchSetup
from cell.study.data import Study
from tools.worlds.made_studies import hidden
from tools.worlds.rigs import Rig, rig_study

SIGNIFICANCE = 0.01
#: Effects that no motion from rest can distinguish: with one out of the library the other is right.
ONE_CLASS = frozenset({"camera_latency", "robot_lag"})
#: Least power of a study for its effect to count as detectable.
SHOWS = 0.8
#: Least power of a rig; to reach it an effect is enlarged: number of steps, factor of a step, and
#: largest size over the typical one.
POWER, MOST_TRIED, MOST_AT_ONCE, STRONGEST = 0.95, 3, 5.0, 20.0


def class_of(names: Iterable[str]) -> frozenset[str]:
    """The effects, and those that no motion can distinguish from them."""
    some = frozenset(names)
    return some | ONE_CLASS if some & ONE_CLASS else some


def without_noise(quiet: Study, noise: Noise) -> PreparedStudy:
    """Prepare a noise-free study as if its measurements had a noise."""
    prepared = PreparedStudy.of(replace(quiet, noise_std_m=noise.std_m))
    return with_noise_model(prepared, replace(prepared.noise_model, noise=noise, dof=1e9))


def evidence(quiet: PreparedStudy, space: ParameterSpace) -> float:
    """χ² of the residual when `space` is fitted to a noise-free study."""
    return FitCache.of(SearchSetup(quiet, space, {})).base.fit.chi2


def least_evidence(quiet: PreparedStudy, tests: int) -> float:
    """Critical χ² of a test over `tests` effects."""
    count = quiet.count(fit_trials(quiet))
    return float(stats.chi2.isf(SIGNIFICANCE / tests, 1) + np.log(count))


def power_of(chi2: float, quiet: PreparedStudy, tests: int) -> float:
    """Power of the test, from the χ² of the effect's residual."""
    return float(stats.ncx2.sf(least_evidence(quiet, tests), 1, chi2))


def that_shows(rig: Rig, effect: type[Effect], tests: int) -> tuple[ActiveEffect, float]:
    """Effect of a size that is detectable in a rig's study, and the power of the test."""
    rng = np.random.default_rng([rig.seed, 3])
    size = rng.uniform(0.7, 1.5)
    if all(p.low < p.default for p in effect.parameters if p.amplitude):
        size *= rng.choice([-1.0, 1.0])
    there = tuple(a.effect for a in (*rig.known, *rig.unsaid))
    space = ParameterSpace.of(rig.cable, effects=there)

    def shown(size: float) -> tuple[ActiveEffect, PreparedStudy, float]:
        active = hidden(effect, size, rig.cable)
        quiet = without_noise(rig_study(rig, active, quiet=True), rig.noise)
        return active, quiet, rig.independent * evidence(quiet, space)

    active, quiet, chi2 = shown(size)
    wanted = (np.sqrt(least_evidence(quiet, tests)) + stats.norm.ppf(POWER)) ** 2
    for _ in range(MOST_TRIED):
        if chi2 > wanted or abs(size) > STRONGEST:
            break
        size *= min(1.1 * np.sqrt(wanted / chi2), MOST_AT_ONCE)
        active, quiet, chi2 = shown(size)
    return active, power_of(chi2, quiet, tests)
