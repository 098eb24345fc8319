"""Gripper motions of many lanes: poses at the steps of a block and at the image times."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from cell.cable import layout as at
from cell.cable.arrays import FloatArray
from cell.cable.clamp import Instants, base_rows, pose_of
from cell.cable.effects.base import ActiveEffect
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.cable.splines import Steps, spread_steps, spread_values
from cell.cable.stepping import spread_rows

Lanes = NDArray[np.int64]

#: Coordinates of a pose.
_AXES = 3


def at_gripper(model: CableModel) -> tuple[ActiveEffect, ...]:
    """The effects that change how the gripper moves."""
    return tuple(a for a in model.effects if a.effect.clamp is not None)


class GripperMotions:
    """Motion and effects on the gripper of every lane of a batch.

    What several lanes share is computed once.

    steps  those of the longest block, at which effects are evaluated for all blocks
    """

    def __init__(
        self, paths: Sequence[Motion], models: Sequence[CableModel], steps: Steps | None = None
    ) -> None:
        self._paths = paths
        self._acting = [at_gripper(model) for model in models]
        self._keys = [(id(p), *a) for p, a in zip(paths, self._acting, strict=True)]
        self._rows: dict[Hashable, FloatArray] = {}
        if steps is None or not any(self._acting):
            return
        instants = Instants(steps)
        for lane, acting in enumerate(self._acting):
            key = self._keys[lane]
            if acting and key not in self._rows:
                self._rows[key] = base_rows(paths[lane], acting, steps, instants)

    def at_steps(self, order: Sequence[int], steps: Steps) -> FloatArray:
        """(steps, BASE_FIELDS, LANES) of the lanes in this order; see `clamp.base_rows`."""
        base = at.vectors(steps.number, at.BASE_FIELDS)
        for lane, there in self._alike(order):
            if self._acting[lane]:
                spread_rows(self._rows[self._keys[lane]][: steps.number], there, base)
                continue
            for axis, spline in enumerate(self._paths[lane].splines):
                spread_steps(*spline.pieces, steps, there, base[:, axis::_AXES])
        return base

    def at_times(self, order: Sequence[int], times_s: Sequence[FloatArray]) -> FloatArray:
        """(most times, 3, LANES) poses of the lanes in this order, each at its own times (T,)."""
        poses = at.vectors(max(map(len, times_s)), _AXES)
        for lane, there in self._alike(order, times_s):
            acting, t_s = self._acting[lane], times_s[there[0]]
            if acting:
                rows = np.stack(pose_of(self._paths[lane], acting)(t_s), axis=1)
                spread_rows(rows, there, poses)
                continue
            for axis, spline in enumerate(self._paths[lane].splines):
                spread_values(*spline.pieces, t_s, there, poses, axis)
        return poses

    def _alike(
        self, order: Sequence[int], times_s: Sequence[FloatArray] = ()
    ) -> Iterator[tuple[int, Lanes]]:
        """A lane of every distinct motion (and array of times), and its places in the order."""
        places: dict[Hashable, list[int]] = {}
        for place, lane in enumerate(order):
            key = self._keys[lane], id(times_s[place]) if times_s else None
            places.setdefault(key, []).append(place)
        for there in places.values():
            yield order[there[0]], np.array(there, dtype=np.int64)
