"""A fault is acknowledged for the cycle that is meant, and for no other."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from typer.testing import CliRunner

from cell.cli import app
from cell.records.ledger.entry import LedgerEntry
from cell.records.ledger.ledger import Ledger, Wanted
from cell.records.result import Fault, Outcome, Result

NAME = "20261102T063000.000-1"


def test_a_cycle_of_the_same_name_on_another_line_stays_open(tmp_path: Path) -> None:
    """Two lines that a PLC starts at once share a ledger: nobody had looked at the other one."""
    ledger, at = Ledger(tmp_path / "plant", create=True), datetime(2026, 11, 2, 6, 30, tzinfo=UTC)
    fault = Fault("lower", "the arm was stopped", "arm", code="arm.stopped")
    for line in ("line3", "line4"):
        folder = tmp_path / line / NAME
        result = Result(1, Outcome.FAILED, str(folder), fault=fault)
        ledger.write([LedgerEntry(line, 1, folder, at, "inserted", ended=at, result=result)])

    def acknowledge(folder: Path) -> str:
        words = ["acknowledge", str(folder), "--ledger", str(tmp_path / "plant"), "--by", "Ada"]
        done = CliRunner().invoke(app, words)
        return f"{done.exit_code} {done.stderr}"

    said = acknowledge(tmp_path / NAME)  # where neither is
    assert said.startswith(f"2 {NAME}: is a cycle of line3 and of line4")
    assert acknowledge(tmp_path / "line4" / NAME) == "0 "
    assert [c.line for c in ledger.listed(Wanted(fault="", acknowledged=False))] == ["line3"]
    ledger.close()
