"""The screen of a library of effects: one simulation of each predicts what it would explain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.fitting import Fit
from cell.lab.fit.projection import nuisance_of
from cell.lab.fit.score_test import Score, score_test
from cell.lab.fit.sensitivity import one_sided, sensitivities

#: An effect with more start shapes than this acts at a place that must be searched.
MOST_SHAPES = 50


@dataclass(frozen=True, eq=False)
class ScreenedEffect:
    """An effect's score test, and parameter values from which refits should start, best first."""

    effect: type[Effect]
    score: Score
    starts: tuple[FloatArray, ...]


def screen(
    prepared: PreparedStudy, fit: Fit, effects: Sequence[type[Effect]]
) -> list[ScreenedEffect]:
    """Score tests of effects against a fit, the likeliest first.

    All effects, at every guess of their shape parameters, go into one batch per trial.
    """
    nuisance = nuisance_of(fit)
    screened = []
    for sensitivity in sensitivities(prepared, fit, effects):
        effect = sensitivity.effect
        score = score_test(nuisance, sensitivity.rows, one_sided=one_sided(effect))
        starts = tuple(
            _start(effect, sensitivity.values[shape], amplitude)
            for shape, amplitude in ((score.shape, score.amplitude), *score.others)
        )
        screened.append(ScreenedEffect(effect, score, starts))
    return sorted(screened, key=lambda s: (s.score.p_value, -s.score.statistic))


def _start(effect: type[Effect], guess: FloatArray, amplitude: FloatArray) -> FloatArray:
    """Parameter values of the guess, amplitudes as the score expects them, within bounds."""
    values = guess.copy()
    expected = iter(np.atleast_1d(amplitude))
    for i, p in enumerate(effect.parameters):
        if p.amplitude:
            values[i] = np.clip(p.default + next(expected), p.low, p.high)
    return values
