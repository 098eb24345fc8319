"""A model as a plain, documented description that other programs can read: `cable-model/1`."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np

from cell.cable.effects.base import Effect
from cell.cable.model import REFERENCE_CURVATURE_1_PER_M, REGULAR_CURVATURE_1_PER_M
from cell.identify.identified import Identified

FORMAT = "cable-model/1"
_LAW = "M = EI(s) k ((k^2 + k_e^2)/k_ref^2)^((N-1)/2) + C dk/dt, k = curvature - rest curvature"
_BETWEEN = "log EI is a cubic spline of s through the knots, not-a-knot ends"
_FRAME = "x right, y up; the cable points along -x at clamp angle 0, positive angles point down"


def description(model: Identified, samples: int = 0) -> dict[str, Any]:
    """The description as plain data; each number has its unit in its name or next to it.

    samples  number of parameter sets drawn from their distribution, with seed 0
    """
    space, cable = model.space, model.model
    k = space.knots
    low, high = model.interval()
    at = np.linspace(0.0, space.cable.free_length_m, k)
    return {
        "format": FORMAT,
        "frame": _FRAME,
        "cable": space.cable.to_dict(),
        "gravity_m_per_s2": list(space.gravity_m_per_s2),
        "bending": {
            "law": _LAW,
            "k_ref_1_per_m": REFERENCE_CURVATURE_1_PER_M,
            "k_e_1_per_m": REGULAR_CURVATURE_1_PER_M,
            "between_knots": _BETWEEN,
            "arc_length_m": at.tolist(),
            "rigidity_n_m2": cable.rigidity_n_m2.tolist(),
            "rigidity_low_n_m2": low[:k].tolist(),
            "rigidity_high_n_m2": high[:k].tolist(),
            "exponent": cable.exponent,
            "exponent_interval": [float(low[k]), float(high[k])],
            "viscosity_n_m2_s": cable.viscosity_n_m2_s,
            "viscosity_interval_n_m2_s": [float(low[k + 1]), float(high[k + 1])],
        },
        "effects": [
            {
                "name": active.effect.name,
                "law": _law(active.effect),
                "parameters": [
                    {"name": p.name, "unit": p.unit, "value": v, "default": p.default}
                    for p, v in zip(active.effect.parameters, active.values, strict=True)
                ],
            }
            for active in cable.effects
        ],
        "intervals": "95 %, each parameter on its own",
        "covariance": {
            "names": list(space.names),
            "coordinates": [
                "natural logarithm" if log else f"as it is, {unit}"
                for log, unit in zip(space.logarithmic, space.units, strict=True)
            ],
            "matrix": model.covariance.tolist(),
        },
        **({"samples": _samples(model, samples)} if samples else {}),
        "residual_rms_m": model.residual_rms_m,
        "model_error_m": model.model_error_m,
        "converged": model.converged,
    }


def _samples(model: Identified, count: int) -> dict[str, Any]:
    """Natural values, a row each, in the order of the names."""
    space = model.space
    rows = [space.natural(q).tolist() for q in model.samples(count)]
    return {"names": list(space.names), "units": list(space.units), "values": rows}


def _law(effect: type[Effect]) -> str:
    """Docstring of an effect's class."""
    return " ".join((inspect.getdoc(effect) or "").split())
