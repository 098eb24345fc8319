"""What a trial's wrench shows before any model: its rate, its noise at rest, how far it varies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.geometry import ROUGHLY_STILL, moves_from_s
from cell.files.plain import plain
from cell.study.data import Trial
from cell.study.facts import noise_m
from cell.study.wrench_file import COLUMNS


@dataclass(frozen=True, eq=False)
class WrenchFacts:
    """Facts of one trial's wrench: N and N·m, in the order of the columns of its file.

    rate_hz  rows a second, by the usual step
    still    rows before anything moves
    noise    (3,) of one row at rest, by second differences: slow errors do not show in it
    varies   (3,) largest less smallest; nan = not measured
    """

    trial: str
    rate_hz: float
    still: int
    noise: FloatArray
    varies: FloatArray

    def to_json(self) -> dict[str, Any]:
        """Plain data, without columns that were not measured; None for what is not known."""
        columns = {
            name: {"noise": plain(self.noise[i]), "varies": plain(self.varies[i])}
            for i, name in enumerate(COLUMNS)
            if np.isfinite(self.varies[i])
        }
        return {"rate_hz": self.rate_hz, "still_rows": self.still, **columns}


def wrench_facts(trial: Trial) -> WrenchFacts | None:
    """Of a trial; None if there is no wrench."""
    wrench = trial.wrench
    if wrench is None:
        return None
    let_go_s = np.inf if trial.rests_until_s is None else trial.rests_until_s
    until_s = min(moves_from_s(trial.grip, ROUGHLY_STILL), let_go_s)
    still = int(np.searchsorted(wrench.t_s, until_s))
    varies = np.full(len(COLUMNS), np.nan)
    seen = np.isfinite(wrench.values).any(axis=0)
    varies[seen] = np.nanmax(wrench.values[:, seen], 0) - np.nanmin(wrench.values[:, seen], 0)
    noise = np.array([noise_m(series) for series in wrench.values[:still].T])
    rate_hz = 1.0 / float(np.median(np.diff(wrench.t_s)))
    return WrenchFacts(trial.name, rate_hz, still, noise, varies)
