"""Detects pictures that show the same points at the same places: copies, or a burst at rest.

Their noise is averaged at best; errors of the model, the pose and the lens are the same in each.
Counted as several they would make a calibration look surer than it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import FloatArray

#: Points that are so near to where they are in another picture, rms, have not moved, px: twice
#: what a corner may scatter by.
SAME_PX = 1.0
#: Pictures are compared by so many points that both show.
LEAST_POINTS = 3


class _Named(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def pixels(self) -> FloatArray: ...


SeenT = TypeVar("SeenT", bound=_Named)


@dataclass(frozen=True)
class Independent(Generic[SeenT]):
    """Pictures that differ from each other, and one sentence about each that was left out."""

    kept: tuple[SeenT, ...]
    left_out: tuple[str, ...]


def independent(
    pictures: Sequence[SeenT],
    ids: Callable[[SeenT], NDArray[np.int64]],
    known: Sequence[SeenT] = (),
) -> Independent[SeenT]:
    """Keep the first of every set of pictures that show the same points at the same places.

    ids    (N,) of a picture's points
    known  pictures that are used already
    """
    kept, left_out = list[SeenT](), []
    for picture in pictures:
        same = (p for p in (*known, *kept) if _distance_px(picture, p, ids) < SAME_PX)
        original = next(same, None)
        if original is None:
            kept.append(picture)
        else:
            left_out.append(
                f"{picture.name} shows the same as {original.name}: the two are one picture, "
                "counted once; move what is shown between pictures"
            )
    return Independent(tuple(kept), tuple(left_out))


def _distance_px(first: SeenT, second: SeenT, ids: Callable[[SeenT], NDArray[np.int64]]) -> float:
    """Rms distance of the points that two pictures show; infinite where these are few."""
    common, a, b = np.intersect1d(ids(first), ids(second), return_indices=True)
    if len(common) < max(LEAST_POINTS, 0.5 * min(len(ids(first)), len(ids(second)))):
        return float("inf")
    away = first.pixels[a] - second.pixels[b]
    return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))
