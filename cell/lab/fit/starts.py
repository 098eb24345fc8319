"""Starting points of fits: the uniform cable that fits best, and typical sizes of effects."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.fitting import fit_trials, residuals

#: Number of uniform cables for a cold start, and their range of ln EI about the prior's.
COLD_STARTS, COLD_RANGE = 48, 3.0
#: Most typical sizes of an effect.
MOST_GUESSES = 9
#: Scale factors of the amplitudes that the screen predicts.
SHARES = (2.0, 0.5, 0.25, 0.1)


def cold_start(prepared: PreparedStudy, space: ParameterSpace) -> FloatArray:
    """Coordinates of the uniform cable that fits best, or the prior's mean if that fits better."""
    trials = fit_trials(prepared)
    level = float(np.exp(space.mean[: space.knots].mean()))
    levels = level * np.exp(np.linspace(-COLD_RANGE, COLD_RANGE, COLD_STARTS))
    q = np.vstack([space.mean, *(space.start(float(v)) for v in levels)])
    white = residuals(prepared, space, trials, q)
    square = np.where(np.isfinite(white).all(axis=1), np.sum(white**2, axis=1), np.inf)
    offset = q - space.mean
    square += np.einsum("ij,jk,ik->i", offset, space.precision, offset)
    return np.asarray(q[int(np.argmin(square))])


def scaled(effect: type[Effect], guesses: Sequence[FloatArray]) -> list[FloatArray]:
    """The guesses, then with scaled amplitudes: guesses are linear, so wrong far from zero."""
    default = np.array([p.default for p in effect.parameters])
    low = np.array([p.low for p in effect.parameters])
    high = np.array([p.high for p in effect.parameters])
    strong = np.array([p.amplitude for p in effect.parameters])
    scaled = [
        np.clip(np.where(strong, default + share * (g - default), g), low, high)
        for share in SHARES
        for g in guesses
    ]
    return [*guesses, *scaled]


def each_once(starts: Sequence[FloatArray]) -> list[FloatArray]:
    """The starts, none of them twice."""
    return [q for i, q in enumerate(starts) if is_new(q, starts[:i])]


def is_new(q: FloatArray, others: Sequence[FloatArray]) -> bool:
    """Whether a start differs from all others."""
    return not any(np.array_equal(q, other) for other in others)


def typical(effect: type[Effect]) -> list[FloatArray]:
    """All combinations of the effect's starts, the most typical first."""
    choices = itertools.product(*(p.starts for p in effect.parameters))
    return [np.array(c) for c in itertools.islice(choices, MOST_GUESSES)]
