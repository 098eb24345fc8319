"""A model as a figure shows it: its name, colour and size, the same in all figures."""

from __future__ import annotations

from dataclasses import dataclass

from cell.lab.strength.compare import Comparison


@dataclass(frozen=True)
class Series:
    """A model beside the measurements, under the name and in the colour it has in all figures.

    of     the name after "error"
    above  number of models drawn over it: it is drawn so much larger that equal ones are seen too
    """

    name: str
    of: str
    colour: str
    comparison: Comparison
    above: int = 0

    @property
    def width(self) -> float:
        """Of its lines, in pixels."""
        return 1.5 + 2.0 * self.above

    @property
    def size(self) -> float:
        """Of its markers, in pixels."""
        return 8.0 + 5.0 * self.above
