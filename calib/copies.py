"""Detects pictures that show the same points at the same places: copies, or a burst at rest.

Their errors of model, pose and lens are the same; only their noise differs.  Counted as independent
they would make the stated uncertainty of a calibration too small.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import FloatArray

#: Largest rms distance between the points of pictures that count as the same, px: twice the scatter
#: of a corner.
SAME_PX = 1.0
#: Fewest common points for a comparison of two pictures.
LEAST_POINTS = 3


class _Named(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def pixels(self) -> FloatArray: ...


ViewT = TypeVar("ViewT", bound=_Named)


@dataclass(frozen=True)
class Independent(Generic[ViewT]):
    """Pictures that differ from each other, and one sentence about each omitted one."""

    distinct: tuple[ViewT, ...]
    left_out: tuple[str, ...]


def independent(
    pictures: Sequence[ViewT],
    ids: Callable[[ViewT], NDArray[np.int64]],
    known: Sequence[ViewT] = (),
) -> Independent[ViewT]:
    """The first of every set of pictures that show the same points at the same places.

    ids    (N,) of a picture's points
    known  pictures that are used already
    """
    distinct, left_out = list[ViewT](), []
    for picture in pictures:
        same = (p for p in (*known, *distinct) if _distance_px(picture, p, ids) < SAME_PX)
        original = next(same, None)
        if original is None:
            distinct.append(picture)
        else:
            left_out.append(
                f"{picture.name} shows the same as {original.name}: the two are one picture, "
                "counted once; move what is shown between pictures"
            )
    return Independent(tuple(distinct), tuple(left_out))


def _distance_px(first: ViewT, second: ViewT, ids: Callable[[ViewT], NDArray[np.int64]]) -> float:
    """Rms distance of the points that two pictures show; infinite where these are few."""
    common, a, b = np.intersect1d(ids(first), ids(second), return_indices=True)
    if len(common) < max(LEAST_POINTS, 0.5 * min(len(ids(first)), len(ids(second)))):
        return float("inf")
    away = first.pixels[a] - second.pixels[b]
    return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))
