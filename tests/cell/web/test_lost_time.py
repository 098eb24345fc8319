"""Lost time as the history page shows it."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import pytest

from cell.plant.messages import Status
from cell.records.ledger.ledger import Ledger, LedgerQuery
from cell.records.ledger.losses import Loss, PassingShare, ShiftLosses
from cell.records.ledger.timeline import LossKind
from cell.run.machine import CellState
from cell.web.pages.lost_time import MOST_LINKS, loss_rows, time_text, waits_now
from cell.web.watching import WatchedState
from cell.web.wording import sentences, translation
from tests.cell.records.ledger.conftest import BEGUN, ended


@pytest.fixture
def shift(tmp_path: Path) -> ShiftLosses:
    ledger = Ledger(tmp_path / "runs", create=True)
    ledger.write([ended(n) for n in range(60)])
    cycles = tuple(ledger.listed(LedgerQuery()))
    ledger.close()
    losses = (
        Loss(LossKind.WAITING, "start", timedelta(minutes=30), cycles, "no cycle is listed"),
        Loss(
            *(LossKind.MISSED, "…", timedelta(minutes=10), cycles[:1]),
            "the tip missed the destination by 0.42 mm",
            PassingShare("air_drag", 6, 7, 0.42, 0.996),
        ),
    )
    end = BEGUN + timedelta(hours=1)
    return ShiftLosses("line3", BEGUN, end, timedelta(minutes=20), 50, losses)


def test_causes_stand_by_their_time_with_links_to_their_cycles(shift: ShiftLosses) -> None:
    first, second = loss_rows([shift, shift], str)
    assert (first.cause, first.minutes, first.share, first.so_far, first.width) == (
        *("waiting for a start", "60.0", "75", "75"),
        1.0,
    )
    assert (second.so_far, second.width) == ("100", pytest.approx(1.0 / 3.0))
    assert (first.cycles, len(first.links), first.links[0][0]) == (60, MOST_LINKS, "00059")
    assert second.evidence == (
        "the tip missed the destination by 0.42 mm; "
        "with air_drag 6 of 7 forecasts pass (42% to 100%)"
    )
    assert time_text([shift], str) == (
        "60.0 min planned = 20.0 min of inserted cables (50) + 40.0 min lost"
    )
    assert (loss_rows([], str), time_text([], str)) == ([], "The cell has not run.")


def test_causes_are_said_in_the_language(shift: ShiftLosses) -> None:
    t, known = translation("de"), sentences("de")
    rows = loss_rows([shift], t)
    assert rows[0].cause == "wartet auf einen Start"
    assert rows[1].evidence.startswith(
        "die Spitze verfehlte das Ziel um 0,42 mm; mit air_drag treffen 6"
    )
    texts = [Loss(kind, "inserted", timedelta(1)).text for kind in LossKind]
    assert [text for text in texts if known.find(text) is None] == []
    assert time_text([shift], t).startswith("60,0 min geplant = 20,0 min eingeführter Kabel (50)")


@pytest.mark.parametrize(
    ("connected", "reasons", "found"),
    [(True, ("start",), {"start": 30.0}), (True, (), {}), (False, ("start",), {})],
)
def test_what_is_waited_for_now_is_what_the_cell_says(
    connected: bool, reasons: tuple[str, ...], found: dict[str, float]
) -> None:
    status = Status("run", 1, CellState.IDLE, 70.0, waiting_for=reasons)
    assert waits_now(WatchedState(status, connected), 100.0) == found
