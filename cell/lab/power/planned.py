"""A study with motions that are not recorded yet, as its fitted model says they would look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cell.cable.geometry import Motion
from cell.lab.data.prepared import PreparedStudy
from cell.lab.power.hidden import World
from cell.lab.search.fit_cache import FitCache
from cell.study.data import Markers, Study, Trial

#: Number of the noise of planned trials: of no copy.
_NOISE = 1_000_000


def with_motions(fits: FitCache, hands: Sequence[tuple[str, Motion]]) -> FitCache:
    """The study with motions of the hand, each with its name, as further trials held out.

    They begin at rest.  Markers are seen at the study's usual rate, in its noise, nothing lost.

    raises  ValueError: a name that a trial or another motion has; UnsimulatedError
    """
    prepared = fits.prepared
    measured = prepared.measured
    names = [t.name for t in measured.trials]
    for name, _ in hands:
        if name in names:
            raise ValueError(f"--motion: there is a trial {name!r} already; rename the file")
        names.append(name)
    planned = tuple(_planned(measured, name, hand) for name, hand in hands)
    world = World.of(prepared, fits.baseline().fit, None, planned)
    study = replace(measured, trials=(*measured.trials, *world.copy(_NOISE).trials))
    given = PreparedStudy.of(study, solver=fits.given.solver, work=fits.work)
    return FitCache(given, fits.space, fits.library, fits.progress, sought=fits.sought)


def _planned(study: Study, name: str, hand: Motion) -> Trial:
    """A trial of which nothing is known but the hand, and which coordinates will be seen."""
    step_s = float(np.median([np.median(np.diff(t.markers.t_s)) for t in study.trials]))
    t_s = np.arange(hand.t_s[0] + step_s, hand.t_s[-1], step_s)
    seen = np.any([np.isfinite(t.markers.xy_m).any(axis=0) for t in study.trials], axis=0)
    xy_m = np.where(seen, 0.0, np.full((len(t_s), *seen.shape), np.nan))
    return Trial(name, "validate", "equilibrium", hand, Markers(t_s, xy_m))
