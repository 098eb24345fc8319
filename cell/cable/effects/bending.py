"""Effects of bending beyond EI(s), N and viscosity."""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Bend, CableData, Effect, Parameter
from cell.cable.effects.rest import RestShape


class StressRelaxation(Effect):
    """Standard linear solid: beside EI a Maxwell branch of fraction·EI that relaxes with time.

    M = f EI (κ − z), dz/dt = (κ − z)/τ.  Source: Ferry, Viscoelastic Properties of Polymers,
    1980, ch. 1.
    """

    name = "stress_relaxation"
    parameters = (
        Parameter("fraction", "1", 0.0, 10.0, 0.0, (0.15,)),
        Parameter("time_s", "s", 1e-3, 100.0, 0.15, (0.15, 0.03, 0.6), amplitude=False),
    )
    memory = ("flow",)
    dissipative = True

    @staticmethod
    def moment(cable: CableData, at: Bend, m: Any, p: Any) -> float:
        """Bending moment, N·m."""
        return float(p.fraction * at.rigidity * (at.curvature - m.flow))

    @staticmethod
    def memory_rate(cable: CableData, at: Bend, m: Any, p: Any) -> tuple[float]:
        """Rate of the memory, 1/s."""
        return ((at.curvature - m.flow) / p.time_s,)

    @staticmethod
    def memory_at_rest(cable: CableData, at: Bend, p: Any) -> tuple[float]:
        """Memory after a long rest."""
        return (at.curvature,)


class BendingHysteresis(Effect):
    """Dahl friction in bending: M_h z, dz/dκ = (1 − z sign κ̇)/κ_d; z = 0 at the start.

    Source: Dahl, Solid Friction Damping of Mechanical Vibrations, AIAA J. 14 (1976) 1675.
    """

    name = "bending_hysteresis"
    parameters = (
        Parameter("moment_n_m", "N·m", 0.0, 1.0, 0.0, (4e-6, 1e-6, 1.2e-5)),
        Parameter("curvature_1_per_m", "1/m", 0.01, 100.0, 1.2, (1.2, 0.4, 4.0), amplitude=False),
    )
    memory = ("friction",)
    dissipative = True
    smooth = False

    @staticmethod
    def moment(cable: CableData, at: Bend, m: Any, p: Any) -> float:
        """Bending moment, N·m."""
        return float(p.moment_n_m * m.friction)

    @staticmethod
    def memory_rate(cable: CableData, at: Bend, m: Any, p: Any) -> tuple[float]:
        """Rate of the memory, 1/s."""
        return ((at.rate - m.friction * abs(at.rate)) / p.curvature_1_per_m,)


class NaturalCurvature(Effect):
    """Rest shape κ₀(s) = κ_c + g (s − L/2): the cable free of load is an arc, or a spiral."""

    name = "natural_curvature"
    parameters = (
        Parameter("curvature_1_per_m", "1/m", -50.0, 50.0, 0.0, (0.5, -0.5)),
        Parameter("gradient_1_per_m2", "1/m²", -1000.0, 1000.0, 0.0, (5.0, -5.0)),
    )
    wider = RestShape

    @staticmethod
    def rest_curvature(cable: CableData, arc_length: FloatArray, p: Any) -> FloatArray:
        """Curvature free of load, 1/m."""
        return np.asarray(
            p.curvature_1_per_m + p.gradient_1_per_m2 * (arc_length - 0.5 * cable.free_length_m)
        )
