"""Significance and BIC penalty of a fall of χ² by an effect; `ConfirmedEffects` decides by them."""

from __future__ import annotations

from collections.abc import Iterable

from cell.cable.effects.base import Effect
from cell.lab.fit.sensitivity import chances_of, one_sided
from cell.lab.statistics.score import boundary_p_value, delta_bic


def p_value_of_fall(effect: type[Effect], delta_chi2: float) -> float:
    """p of such a fall of χ² by a refit with an effect, when the effect is absent."""
    amplitudes = sum(p.amplitude for p in effect.parameters)
    return boundary_p_value(delta_chi2, amplitudes, int(one_sided(effect)), chances_of(effect))


def bic_penalty(effects: Iterable[type[Effect]], values: int, effective_fraction: float) -> float:
    """Fall of χ² from which effects pay by BIC; coloured values count as a fraction of them."""
    fitted = sum(p.fitted for e in effects for p in e.parameters)
    return -delta_bic(0.0, fitted, values, effective_fraction)
