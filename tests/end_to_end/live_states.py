"""The pages of a cell that is not there: a server whose live page shows a state of one's choice.

Run as a program with a folder of records and a port; each line that it reads names a state.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from cell.plant.client import Client
from cell.plant.messages import FaultNotice, Status, possible_in
from cell.plant.users import Users
from cell.records.ledger.effectiveness import Shift
from cell.records.ledger.ledger import ListedCycle
from cell.records.result import Outcome
from cell.run.machine import CellState
from cell.settings import load_settings
from cell.web.camera import LiveCamera, LivePicture
from cell.web.serve import serve
from cell.web.visit import PagesContext
from cell.web.watching import ShiftFigures, WatchedState

CONFIG = Path(__file__).parents[2] / "config" / "fake.yaml"
#: Time of every state, Unix time, and of the newest cable.
NOW = datetime(2026, 11, 25, 14, 30, tzinfo=UTC)
_ENDED = {
    Outcome.INSERTED: "",
    Outcome.MISSED: "the tip missed the destination by 1.20 mm",
    Outcome.REJECTED: "no offset passes with probability ≥ 0.95: the best, 12 mm, with 0.41 "
    "(margin -1.20 mm)",
    Outcome.FAILED: "",
}


def cable(number: int, outcome: Outcome, runs: Path) -> ListedCycle:
    """A cable of the ledger; misses and errors of the forecasts go up and down."""
    executed = outcome in (Outcome.INSERTED, Outcome.MISSED)
    miss_m = 6.2e-3 if outcome is Outcome.MISSED else 1e-3 * (number * 7 % 5 - 2.0)
    error_m = 1e-4 * (number * 11 % 7 - 3.0)
    numbers = {
        "predicted_miss_m": miss_m - error_m if executed else None,
        "measured_miss_m": miss_m if executed else None,
        "predicted_std_m": 1.5e-4,
        "margin_m": 5e-3 - abs(miss_m) if executed else None,
        "probability": 0.9996 if executed else 0.41,
    }
    at = NOW - timedelta(minutes=21 - number)
    folder = runs / f"{at:%Y%m%dT%H%M%S}.000-{number}"
    ids = (number, f"LOT7-{number:04d}", None, folder, at, at, outcome, _ENDED[outcome])
    return ListedCycle("line", *ids, None, None, None, None, numbers, None)


def states(runs: Path) -> dict[str, WatchedState]:
    """Everything that the live page may show, by name."""
    outcomes = {3: Outcome.REJECTED, 11: Outcome.MISSED}
    cables = tuple(cable(n, outcomes.get(n, Outcome.INSERTED), runs) for n in range(1, 21))
    counts = {"inserted": 18, "missed": 1, "rejected": 1}
    shift = Shift(NOW, NOW, 28_800.0, 23_000.0, 60.0, 20, 18)

    def seen(state: CellState, last: Outcome = Outcome.INSERTED, **more: Any) -> WatchedState:
        newest = (*cables[:-1], cable(20, last, runs))
        end: Mapping[str, Any] = {**newest[-1].to_json(), "seconds": {"hold_and_capture": 4.0}}
        figures = ShiftFigures(counts, shift, (("missed", 1, _ENDED[Outcome.MISSED]),))
        status = Status("run", 1, state, NOW.timestamp(), cycle=20, part="LOT7-0020", last=end)
        status = replace(status, possible=possible_in(state), **more)
        begun_s = NOW.timestamp() - 2.0 if status.step else None
        return WatchedState(
            status, True, None, begun_s, replace(figures, newest=newest, is_planned=False)
        )

    fault = FaultNotice(
        *(20, "lower", "the controller is in protective stop: 5.2 N·m at joint 3, limit 4 N·m"),
        *(NOW.timestamp(), "arm", "find its cause, unlock it at the panel after 5 s, then reset"),
        "a cable is in the jaws",
    )
    idle = seen(CellState.IDLE)
    return {
        "idle": idle,
        "running": seen(CellState.EXECUTE, step="hold_and_capture", product="soft 90 mm"),
        "held": seen(CellState.HELD),
        "fault": seen(
            CellState.STOPPED,
            Outcome.FAILED,
            fault=fault,
            waiting_for=("acknowledgement",),
            adapters={"handshake": "has ended: exit code 1; it is started again"},
        ),
        "stopped": seen(CellState.STOPPED),
        "rejected": seen(CellState.IDLE, Outcome.REJECTED),
        "missed": seen(CellState.IDLE, Outcome.MISSED, waiting_for=("part",)),
        "away": replace(idle, connected=False),
        "unknown": replace(idle, connected=False, unknown_s=NOW.timestamp()),
        "empty": WatchedState(),
    }


class FixedWatch:
    """In place of `CellWatch`: what is known does not change by itself."""

    state = WatchedState()

    def __enter__(self) -> FixedWatch:
        return self

    def __exit__(self, *of_error: object) -> None:
        pass


class FixedCamera(LiveCamera):
    """In place of `LiveCamera`: always the same picture."""

    def ask(self) -> LivePicture | None:
        return self.newest


def main(runs: Path, port: int) -> None:
    """Serve until the program is killed."""
    known = states(runs)
    watch, camera = FixedWatch(), FixedCamera(runs)
    picture = runs / "live.jpg"
    if picture.exists():
        camera.newest = LivePicture(1, NOW.timestamp(), picture.read_bytes())
    parts = (Client(runs), watch, None)
    room = PagesContext(CONFIG, load_settings(CONFIG), runs, *parts)  # type: ignore[arg-type]
    room.camera = camera

    def choose() -> None:
        for line in sys.stdin:
            watch.state = known[line.strip()]

    threading.Thread(target=choose, daemon=True).start()
    serve(room, Users(runs / "users.json"), ("127.0.0.1", port), None)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
