"""What the pictures of one recording say together that none of them says alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from cell.cable.arrays import FloatArray
from cell.vision.sighting import Sighting, Unseen

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
    """Why pictures gave no nodes, with their numbers, the most frequent first; '' if all did.

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
