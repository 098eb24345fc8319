"""Detection of the cable in one picture: its nodes, or the reason why there are none."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from cell.cable.arrays import FloatArray


class Unseen(StrEnum):
    """Reasons for a picture without nodes."""

    NO_JAW = "no_jaw"  # fewer than three marks agree on a place
    NO_CABLE = "no_cable"  # nothing like a cable leaves the gripping point
    TWO_CABLES = "two_cables"  # a second line runs next to the cable
    LEAVES_PICTURE = "leaves_picture"  # the cable or the jaw reaches the picture's edge
    WRONG_LENGTH = "wrong_length"  # hidden in part, or not the cable that was gripped
    SATURATED = "saturated"  # over half of the picture is at the top of the scale
    EMPTY = "empty"  # black, or without any contrast


#: Compiled functions return the index of a reason in this tuple.
UNSEEN = tuple(Unseen)


@dataclass(frozen=True)
class Sighting:
    """Nodes of the cable in one frame, in metres in the cell's plane; or why there are none.

    t_s           time of the frame, s
    nodes_m       (11, 2) at equal arc length, tip first; nan throughout when unseen
    grip_m        (2,) gripping point from the jaw's marks; nan when the jaw is not detected
    clamp_angle_rad  from the jaw's marks, positive = pointing down; nan likewise
    quality       0 (worthless) … 1 (crisp); 0 when unseen
    unseen        None, or the reason
    length_m      measured free length; nan when the tip was not detected
    """

    t_s: float
    nodes_m: FloatArray
    grip_m: FloatArray
    clamp_angle_rad: float
    quality: float
    unseen: Unseen | None = None
    length_m: float = float("nan")

    @property
    def seen(self) -> bool:
        """Whether the nodes may be used."""
        return self.unseen is None


#: Largest scatter of the tip's detection, m; a frame with a larger error of length is not changed.
SCATTER_M = 2e-4


def steady_nodes(sightings: Sequence[Sighting]) -> FloatArray:
    """(T, nodes, 2) nodes, tip first, of a cable whose length does not change; nan where unseen.

    The tip's detection scatters from picture to picture, and all nodes with it, as they are at
    equal arc length.  They are moved along the cable to the arc lengths of the median length.
    """
    nodes_m = np.array([s.nodes_m for s in sightings])
    length_m = np.array([s.length_m if s.seen else np.nan for s in sightings])
    if not np.isfinite(length_m).any():
        return nodes_m
    longer_m = np.nanmedian(length_m) - length_m
    longer_m = np.where(np.abs(longer_m) < SCATTER_M, longer_m, 0.0)
    along = -np.gradient(nodes_m, axis=1)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    share = np.linspace(1.0, 0.0, nodes_m.shape[1])
    steady: FloatArray = nodes_m + (longer_m[:, None] * share)[..., None] * along
    return steady


def why_unseen(sightings: Sequence[Sighting], free_length_m: float) -> str:
    """Text: reasons why images gave no nodes, with counts, most frequent first; '' if all did.

    free_length_m  expected free length
    """
    counts = Counter(s.unseen for s in sightings if s.unseen is not None).most_common()
    if not counts:
        return ""
    reasons = ", ".join(f"{why.value.replace('_', ' ')} in {count}" for why, count in counts)
    measured_m = [s.length_m for s in sightings if s.unseen is Unseen.WRONG_LENGTH]
    measured_m = [m for m in measured_m if np.isfinite(m)]
    if counts[0][0] is not Unseen.WRONG_LENGTH or not measured_m:
        return reasons
    return (
        f"{reasons}; the line seen is {np.median(measured_m) * 1e3:.1f} mm long, the cable "
        f"{free_length_m * 1e3:.1f} mm"
    )
