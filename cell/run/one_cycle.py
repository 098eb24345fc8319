"""A cycle from its preparation to its end, with its record and its line in the ledger."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from cell.run.listed import CycleListing
from cell.run.machine import CellState
from cell.run.plans import Plan
from cell.run.product import ProductTask
from cell.run.progress import CycleProgress


@dataclass
class OneCycle:
    """A cycle from its preparation to its end.

    made     what it makes
    before   time spent in each state before it, s
    part     id of its cable
    listing  None = the ledger does not know of it yet
    """

    plan: Plan
    made: ProductTask
    progress: CycleProgress
    before: Mapping[CellState, float]
    part: str | None = None
    listing: CycleListing | None = None

    def spent_s(self, after: Mapping[CellState, float]) -> dict[str, float]:
        """Time in each state, s, in which it was; `after` as `before`, now."""
        return {
            state.value: after[state] - self.before[state]
            for state in CellState
            if after[state] > self.before[state]
        }
