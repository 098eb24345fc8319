"""Lost time as texts for the pages: pure functions of the ledger's data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cell.records.ledger.losses import ShiftLosses, merged, minutes_in
from cell.web.watching import WatchedState
from cell.web.wording import Translate

#: Cycles of a cause that are linked, the newest.
MOST_LINKS = 50


@dataclass(frozen=True)
class LossRow:
    """One cause, as texts.

    width   of its bar, as a share of the largest
    so_far  share of all lost time of this cause and those above it
    links   name of a cycle's folder, and its words; the newest first
    """

    cause: str
    minutes: str
    share: str
    so_far: str
    width: float
    evidence: str
    cycles: int
    links: tuple[tuple[str, str], ...]


def loss_rows(shifts: Sequence[ShiftLosses], t: Translate) -> list[LossRow]:
    """A row for each cause, the longest first, in a language."""
    losses = merged(shifts)
    lost_min = sum(minutes_in(loss.lasted) for loss in losses)
    rows: list[LossRow] = []
    so_far_min = 0.0
    for loss in losses:
        minutes = minutes_in(loss.lasted)
        so_far_min += minutes
        links = tuple(
            (c.folder.name, f"{c.started:%m-%d %H:%M:%S} · {c.cycle}")
            for c in reversed(loss.cycles[-MOST_LINKS:])
        )
        rows.append(
            LossRow(
                t(loss.text),
                t(f"{minutes:.1f}"),
                t(f"{100.0 * minutes / lost_min:.0f}"),
                t(f"{100.0 * so_far_min / lost_min:.0f}"),
                minutes / minutes_in(losses[0].lasted),
                "; ".join(t(text) for text in (loss.evidence, loss.physics) if text),
                len(loss.cycles),
                links,
            )
        )
    return rows


def time_text(shifts: Sequence[ShiftLosses], t: Translate) -> str:
    """Where the planned time went, in a language."""
    if not shifts:
        return t("The cell has not run.")
    planned = sum(minutes_in(s.planned) for s in shifts)
    good = sum(minutes_in(s.productive) for s in shifts)
    cables = sum(s.inserted for s in shifts)
    return t(
        f"{planned:.1f} min planned = {good:.1f} min of inserted cables ({cables}) + "
        f"{planned - good:.1f} min lost"
    )


def waits_now(seen: WatchedState, now_s: float) -> dict[str, float]:
    """What the cell waits for now, and for how long, s: not in the ledger yet.

    now_s  Unix time
    """
    status = seen.status
    if status is None or not seen.connected:
        return {}
    return dict.fromkeys(status.waiting_for[:1], now_s - status.since_s)
