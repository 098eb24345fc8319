"""The likelihood of a noise by what a model leaves of the frames in motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import solve_triangular

from cell.cable.arrays import FloatArray
from cell.identify.innovations import frames_since, made_white

#: What is taken out of a residual is worked out at so many correlations, and between them by a
#: cubic spline: to 0.03 of −2 ln of the likelihood where they span all.
NODES = 13


@dataclass(frozen=True, eq=False)
class Remainder:
    """The part of a residual in motion that neither fitted parameters nor any effect can explain.

    errors_m   per trial (times, channels), nan where not seen or at rest
    explained  per trial (times, channels, directions) what parameters and effects may add to it,
               independent of each other over all trials
    """

    errors_m: tuple[FloatArray, ...]
    explained: tuple[FloatArray, ...]

    @property
    def dof(self) -> int:
        """Values less the directions that were taken out of them."""
        count = sum(int(np.isfinite(e).sum()) for e in self.errors_m)
        return max(count - int(self.explained[0].shape[-1]), 0)

    @cached_property
    def _trials(self) -> list[tuple[FloatArray, NDArray[np.bool_], NDArray[np.int_]]]:
        """Per trial (times, channels, 1) errors, 0 where not seen; which are; frames since then."""
        seen = [np.isfinite(e) for e in self.errors_m]
        return [
            (np.where(s, e, 0.0)[..., None], s, frames_since(s))
            for e, s in zip(self.errors_m, seen, strict=True)
        ]

    def sums(
        self, noises: Sequence[tuple[float, float]], wanted: NDArray[np.bool_]
    ) -> tuple[FloatArray, FloatArray]:
        """By correlation and white share: the innovations' square, m², and log determinant.

        Restricted to what the directions leave: slow noise is like them, so that much of it was
        taken out with them.  nan of a noise that is not wanted.
        source  Patterson & Thompson 1971, Biometrika 58, 545
        """
        found = np.full((len(noises), 2), np.nan)
        for i in np.flatnonzero(wanted):
            found[i] = self._of(noises[int(i)], directions=False)
        if self.dof > 0 and self.explained[0].shape[-1] > 0:
            whites = np.array([white for _, white in noises])
            for white in np.unique(whites[wanted]):
                own = np.flatnonzero(wanted & (whites == white))
                found[own] += self._taken_out(found[own], [noises[i] for i in own.tolist()])
        return found[:, 0], found[:, 1]

    def _taken_out(self, found: FloatArray, noises: Sequence[tuple[float, float]]) -> FloatArray:
        """Changes of sums, of noises of one white share, by what is taken out: between some."""
        nodes = np.unique(np.linspace(0, len(noises) - 1, NODES).round().astype(int))
        exact = np.array([self._of(noises[i], directions=True) for i in nodes])
        if len(nodes) == len(noises):
            return np.asarray(exact - found)
        place = -np.log1p(-np.array([ar1 for ar1, _ in noises]))
        ratio = CubicSpline(place[nodes], exact[:, 0] / np.maximum(found[nodes, 0], 1e-300))(place)
        log_det = CubicSpline(place[nodes], exact[:, 1] - found[nodes, 1])(place)
        return np.stack([found[:, 0] * (ratio - 1.0), log_det], axis=1)

    def _of(self, noise: tuple[float, float], *, directions: bool) -> tuple[float, float]:
        """Square and log determinant, within what the directions leave or of all."""
        size = self.explained[0].shape[-1] * directions + 1
        gram, log_det = np.zeros((size, size)), 0.0
        for (values, seen, since), explained in zip(self._trials, self.explained, strict=True):
            columns = np.concatenate([explained, values], axis=-1) if directions else values
            white, of_trial = made_white(columns, seen, since, *noise, 0.0)
            rows = white.reshape(-1, white.shape[-1])
            gram, log_det = gram + rows.T @ rows, log_det + of_trial
        if not directions:
            return float(gram[0, 0]), log_det
        root = np.linalg.cholesky(gram[:-1, :-1])
        along = solve_triangular(root, gram[:-1, -1], lower=True)
        square = max(float(gram[-1, -1] - along @ along), 0.0)
        return square, log_det + 2.0 * float(np.log(np.diag(root)).sum())
