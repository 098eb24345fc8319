"""Sets of effects fitted to the trials of one study, as a space that is searched."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel


@dataclass(frozen=True, eq=False)
class StudySpace:
    """Sets of effects fitted to the trials of one study.

    most  effects of the screen that are refitted, besides all that are not smooth
    """

    fits: FitCache
    most: int

    def extended(self, model: FittedModel) -> list[FittedModel]:
        """With one effect more: the likeliest of the screen."""
        return self.fits.fit_extended(model, self.fits.shortlist(model, self.most))

    def reduced(self, model: FittedModel) -> Iterator[FittedModel]:
        """Without one of the effects that the baseline lacks, refitted one after another."""
        return (self.fits.fit_reduced(model, e) for e in self.fits.added(model))
