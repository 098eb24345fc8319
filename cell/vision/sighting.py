"""What was seen of the cable: its nodes in one picture, or why there are none."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from cell.cable.arrays import FloatArray


class Unseen(StrEnum):
    """Why a picture gives no nodes."""

    NO_JAW = "no_jaw"  # fewer than three marks agree on a place
    NO_CABLE = "no_cable"  # nothing like a cable leaves the gripping point
    TWO_CABLES = "two_cables"  # a second line runs beside the cable
    LEAVES_PICTURE = "leaves_picture"  # the cable or the jaw reaches the picture's edge
    WRONG_LENGTH = "wrong_length"  # hidden in part, or not the cable that was gripped
    SATURATED = "saturated"  # over half of the picture is at the top of the scale
    EMPTY = "empty"  # black, or without any contrast


#: Compiled functions say the place of a reason in here.
UNSEEN = tuple(Unseen)


@dataclass(frozen=True)
class Sighting:
    """Nodes of the cable in one frame, in metres in the cell's plane; or why there are none.

    t_s           time of the frame, s
    nodes_m       (11, 2) at equal arc length, tip first; nan throughout when unseen
    grip_m        (2,) gripping point from the jaw's marks; nan when the jaw is not found
    clamp_angle_rad  from the jaw's marks, positive = pointing down; nan likewise
    quality       0 (worthless) … 1 (crisp); 0 when unseen
    unseen        None, or the reason
    length_m      free length as measured; nan when the tip was not found
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


#: A length further off than this is no scatter of the tip's detection; such a frame is left alone.
SCATTER_M = 2e-4


def steady_nodes(sightings: Sequence[Sighting]) -> FloatArray:
    """(T, nodes, 2) nodes, tip first, of a cable whose length does not change; nan where unseen.

    In every single picture the tip's detection scatters, and all nodes with it, being at equal
    arc length.  Here they are moved along the cable to where the recording's median length puts
    them.
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

    free_length_m  that the cable should have
    """
    counts = Counter(s.unseen for s in sightings if s.unseen is not None).most_common()
    if not counts:
        return ""
    found = ", ".join(f"{why.value.replace('_', ' ')} in {count}" for why, count in counts)
    measured_m = [s.length_m for s in sightings if s.unseen is Unseen.WRONG_LENGTH]
    measured_m = [m for m in measured_m if np.isfinite(m)]
    if counts[0][0] is not Unseen.WRONG_LENGTH or not measured_m:
        return found
    return (
        f"{found}; the line seen is {np.median(measured_m) * 1e3:.1f} mm long, the cable "
        f"{free_length_m * 1e3:.1f} mm"
    )
