"""Shape of a cable free of load: any rest curvature."""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import CableData, Effect, Parameter

#: Places along the cable, evenly spaced from end to end.
_PLACES = 6


class RestShape(Effect):
    """Rest shape of any kind: κ₀(s) piecewise linear, free at evenly spaced places."""

    name = "rest_shape"
    parameters = tuple(
        Parameter(f"curvature_{i}_1_per_m", "1/m", -100.0, 100.0, 0.0, (1.0,))
        for i in range(_PLACES)
    )

    @staticmethod
    def rest_curvature(cable: CableData, arc_length: FloatArray, p: Any) -> FloatArray:
        """Curvature free of load, 1/m."""
        place = np.asarray(arc_length) / cable.free_length_m * (_PLACES - 1)
        curvature = np.zeros_like(place)
        for i in range(_PLACES):
            near = np.clip(1.0 - np.abs(place - i), 0.0, None)
            curvature += getattr(p, f"curvature_{i}_1_per_m") * near
        return curvature
