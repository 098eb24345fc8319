"""A model that may be the right one, for whoever plans what is measured next."""

from __future__ import annotations

from dataclasses import dataclass

from cell.cable.arrays import FloatArray
from cell.cable.model import CableModel
from cell.identify.parameters import ParameterSpace


@dataclass(frozen=True, eq=False)
class Rival:
    """A model that may be the right one.

    q, covariance  (p,), (p, p) coordinates of `space`, and how far they are open
    """

    name: str
    space: ParameterSpace
    q: FloatArray
    covariance: FloatArray

    @property
    def model(self) -> CableModel:
        """The cable at q."""
        return self.space.model(self.q)
