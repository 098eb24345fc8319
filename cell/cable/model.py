"""The model of one cable: parameters that belong to the cable, never to a mesh."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import ActiveEffect
from cell.cable.geometry import GRAVITY_M_PER_S2, Cable

#: Curvature at which EI(s) is the secant rigidity whatever N is, 1/m.  Inside the range of a held
#: cable (0 … 12 /m), so that a change of N changes the shape and hardly the size of the bending.
REFERENCE_CURVATURE_1_PER_M = 10.0

#: |κ|^(N−1) has no finite slope (N < 1) or no stiffness (N > 1) at κ = 0.  Below this curvature,
#: a hundredth of a held cable's largest, the law becomes linear, 1/m.
REGULAR_CURVATURE_1_PER_M = 0.1


@dataclass(frozen=True, eq=False)
class CableModel:
    """Physics of one cable: M = EI(s) κ ((κ² + κ_ε²)/κ_ref²)^((N−1)/2) + C dκ/dt.

    rigidity_n_m2     (k,) EI at k ≥ 1 knots equally spaced over s = 0 … L from the gripping
                      point; log EI is a cubic spline between them (not-a-knot)
    exponent          N, 1 = linear
    viscosity_n_m2_s  C
    effects           added physics; names must differ
    """

    cable: Cable
    rigidity_n_m2: FloatArray
    exponent: float = 1.0
    viscosity_n_m2_s: float = 0.0
    gravity_m_per_s2: tuple[float, float] = GRAVITY_M_PER_S2
    effects: tuple[ActiveEffect, ...] = ()

    def __post_init__(self) -> None:
        rigidity = self.rigidity_n_m2
        if np.ndim(rigidity) != 1 or np.size(rigidity) == 0:
            raise ValueError(
                f"model.rigidity_n_m2 has shape {np.shape(rigidity)}, needs (k,), k ≥ 1"
            )
        if not (rigidity.min() > 0.0 and rigidity.max() < np.inf):
            i = int(np.argmin(np.isfinite(rigidity) & (rigidity > 0.0)))
            raise ValueError(f"model.rigidity_n_m2[{i}] = {rigidity[i]}: must be finite and > 0")
        if not 0.1 <= self.exponent <= 10.0:
            raise ValueError(f"model.exponent = {self.exponent}: must be 0.1 … 10")
        if not 0.0 <= self.viscosity_n_m2_s < math.inf:
            raise ValueError(
                f"model.viscosity_n_m2_s = {self.viscosity_n_m2_s}: must be finite and ≥ 0"
            )
        if not all(math.isfinite(g) for g in self.gravity_m_per_s2):
            raise ValueError(f"model.gravity_m_per_s2 = {self.gravity_m_per_s2}: must be finite")
        names = [a.effect.name for a in self.effects]
        if len(set(names)) != len(names):
            raise ValueError(f"model.effects names an effect twice: {names}")

    @staticmethod
    def uniform(
        cable: Cable,
        rigidity_n_m2: float,
        exponent: float = 1.0,
        viscosity_n_m2_s: float = 0.0,
        gravity_m_per_s2: tuple[float, float] = GRAVITY_M_PER_S2,
        effects: tuple[ActiveEffect, ...] = (),
    ) -> CableModel:
        """A cable whose EI is the same everywhere."""
        everywhere = np.array([rigidity_n_m2], dtype=np.float64)
        return CableModel(cable, everywhere, exponent, viscosity_n_m2_s, gravity_m_per_s2, effects)

    def rigidity_at(self, arc_length_m: ArrayLike) -> FloatArray:
        """EI(s), N·m², at arc lengths from the gripping point; constant beyond the ends."""
        s = np.clip(np.asarray(arc_length_m, dtype=np.float64) / self.cable.free_length_m, 0.0, 1.0)
        basis = knot_basis(self.rigidity_n_m2.size, tuple(s.ravel()))
        return np.asarray(np.exp(basis @ np.log(self.rigidity_n_m2)).reshape(s.shape))


@lru_cache(maxsize=64)
def knot_basis(knots: int, fraction: tuple[float, ...]) -> FloatArray:
    """(len(fraction), knots): log EI at fractions of the length per log EI at the knots.

    A cubic and a kink of its third derivative at every knot but the two outermost at either end;
    a polynomial of lower order where there are fewer than four knots.
    """
    at = np.linspace(0.0, 1.0, knots)

    def terms(x: FloatArray) -> FloatArray:
        powers = x[:, None] ** np.arange(min(knots, 4))
        return np.hstack([powers, np.maximum(x[:, None] - at[2:-2], 0.0) ** 3])

    return np.asarray(np.linalg.solve(terms(at).T, terms(np.asarray(fraction)).T).T)
