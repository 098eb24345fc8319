"""An export as sentences and a table."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cell.exchange.export import Export
from cell.exchange.peer import BAR_M
from cell.files.table import TableData


def export_parts(done: Export) -> Iterator[TableData | str]:
    """What is in the chain, what is not, and how far the tips are apart, mm."""
    yield f"chain: {done.chain.links} links, steps of {done.step_s * 1e3:g} ms"
    yield f"effects in it: {', '.join(done.effects) or 'none'}"
    for effect in done.left_out:
        yield f"left out: {effect.name}: {effect.reason}"
    yield difference_table(done)
    if not done.within_bar:
        yield (
            f"The tip differs by more than {BAR_M * 1e3:g} mm rms: give more --links, or check the "
            "model."
        )


def difference_table(done: Export) -> TableData:
    """Distances of the tips, motion by motion, mm; of the effects left out if there are any."""
    heads = ["motion", "rms", "at most", *(["rms of what is left out"] if done.missing else [])]
    rows = []
    for i, one in enumerate(done.differences):
        rows.append([one.name, _mm(one.rms_m), _mm(one.most_m)])
        if done.missing:
            rows[-1].append(_mm(done.missing[i].rms_m))
    title = "Tip in MuJoCo, from the engine, mm"
    return TableData(title, heads, rows, numbers=range(1, len(heads)))


def _mm(length_m: float) -> str:
    return "diverges" if length_m == np.inf else f"{length_m * 1e3:.3f}"
