"""The result of looking for the cable in one picture: its nodes, or why there are none."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

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
