"""Ledgers in a file and on a server: the same tests for both."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from cell.records.ledger.entry import LedgerEntry, LedgerEstimate
from cell.records.ledger.ledger import Ledger
from cell.records.result import Fault, Outcome, Result

from .server import Server, programs

BEGUN = datetime(2026, 11, 2, 6, 30, tzinfo=UTC)


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    found = programs()
    if found is None:
        pytest.skip("no PostgreSQL server is installed")
    server = Server(found)
    server.start()
    yield server
    server.close()


@pytest.fixture(params=["sqlite", "postgresql"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Where a new ledger may be."""
    if request.param == "sqlite":
        return str(tmp_path / "runs")
    return str(request.getfixturevalue("server").new_database())


@pytest.fixture
def ledger(place: str) -> Iterator[Ledger]:
    ledger = Ledger(place, create=True)
    yield ledger
    ledger.close()


def begun(number: int = 1, **changes) -> LedgerEntry:
    """A cycle that has begun: one a minute."""
    given = {
        "line": "line3",
        "cycle": number,
        "folder": Path(f"/records/{number:05d}"),
        "started": BEGUN + timedelta(minutes=number),
        "aim": "inserted",
    }
    return LedgerEntry(**(given | changes))


def ended(
    number: int = 1, outcome: Outcome = Outcome.INSERTED, fault=None, **changes
) -> LedgerEntry:
    """A cycle that has ended."""
    result = Result(
        number,
        outcome,
        "runs/x",
        offset_m=0.02,
        predicted_miss_m=0.1e-3,
        measured_miss_m=0.3e-3,
        predicted_std_m=0.1e-3,
        residual_rms_m=2e-5,
        noise_m=1e-5,
        model="abc",
        seconds={"lower": 0.5, "hold and capture": 1.0},
        state_seconds={"execute": 20.0, "completing": 5.0, "held": 100.0},
        fault=fault,
    )
    given = {
        "ended": BEGUN + timedelta(minutes=number, seconds=25),
        "result": result,
        "estimates": (
            LedgerEstimate("rigidity_0", 2e-5, 1e-5, 3e-5),
            LedgerEstimate("viscosity", 1e-7),
        ),
        "software": "0.1.0",
        "calibration": "c0ffee",
    }
    return begun(number, **(given | changes))


def stopped(number: int, code: str = "stop") -> LedgerEntry:
    """A cycle that a fault has ended."""
    fault = Fault("lower", f"cause {number}", "arm", "remedy", "in the jaws", code)
    return ended(number, Outcome.FAILED, fault)
