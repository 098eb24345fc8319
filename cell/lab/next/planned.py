"""A study with motions that are not recorded yet, as its fitted model says they would look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cell.cable.geometry import Motion
from cell.lab.data.planned_trials import planned_trials, usual_step_s
from cell.lab.data.prepared import PreparedStudy, as_measured
from cell.lab.next.hidden import HiddenEffectWorld
from cell.lab.search.fit_cache import FitCache
from cell.study.data import Study

#: Number of the noise of planned trials: of no copy.
_NOISE = 1_000_000


def with_motions(fits: FitCache, hands: Sequence[tuple[str, Motion]]) -> FitCache:
    """The study with motions of the hand, each with its name, as further trials held out.

    They begin at rest.  Markers, wrench and hand are measured as in the study, at its usual rates
    and with its noise, nothing lost.

    raises  ValueError: a name that a trial or another motion has; UnsimulatedError
    """
    prepared = fits.prepared
    measured = as_measured(prepared)
    names = [t.name for t in measured.trials]
    for name, _ in hands:
        if name in names:
            raise ValueError(f"--motion: there is a trial {name!r} already; rename the file")
        names.append(name)
    known, planned = planned_trials(prepared, hands)
    planned = tuple(
        replace(t, grip=_logged(measured, t.grip, number)) for number, t in enumerate(planned)
    )
    world = HiddenEffectWorld.of(known, fits.baseline().fit, None, planned)
    study = replace(measured, trials=(*measured.trials, *world.copy(_NOISE).trials))
    given = PreparedStudy.of(study, solver=fits.given.solver, work=fits.work)
    return FitCache(given, fits.space, fits.library, fits.progress, sought=fits.sought)


def _logged(study: Study, hand: Motion, number: int) -> Motion:
    """A hand as the study's logs would show it: at their rate, with their noise."""
    rng = np.random.default_rng([_NOISE, number])
    step_s = usual_step_s([t.grip.t_s for t in study.trials])
    t_s = np.arange(hand.t_s[0], hand.t_s[-1], step_s)
    noise = np.median([[s.noise_std for s in t.grip.splines] for t in study.trials], axis=0)
    values = (
        spline(t_s) + std * rng.normal(size=len(t_s))
        for spline, std in zip(hand.splines, noise, strict=True)
    )
    return Motion(t_s, *values)
