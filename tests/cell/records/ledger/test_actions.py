"""What people do at the pages comes into the ledger, once, and can be asked for."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cell.cli import app
from cell.records.ledger.actions import listed_actions, take_over
from cell.records.ledger.entry import LedgerError
from cell.records.ledger.ledger import Ledger
from cell.web.audit import Audit, audit_file


def test_actions_are_taken_over_once(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    log = Audit(audit_file(runs))
    assert take_over(runs, log.file, "line 3") == 0
    log.write("ada", "start", True)
    with pytest.raises(LedgerError):  # there is no ledger yet: the log keeps them
        take_over(runs, log.file, "line 3")
    Ledger(runs, create=True).close()
    log.write("eve", "stop", False, "you may not – do this")
    assert take_over(runs, log.file, "line 3") == 2
    assert take_over(runs, log.file, "line 3") == 0
    with log.file.open("ab") as file:
        file.write(b'{"at": torn\n{"at": "2026')
    assert take_over(runs, log.file, "line 3") == 0
    first, second = listed_actions(runs)
    assert (first.by, first.action, first.done, first.line) == ("ada", "start", True, "line 3")
    assert (second.done, second.note) == (False, "you may not – do this")
    assert listed_actions(runs, most=1) == [second]
    now = datetime.now(UTC)
    assert listed_actions(runs, since=now + timedelta(minutes=1)) == []
    said = CliRunner().invoke(app, ["actions", "--runs", str(runs), "-n", "1"]).stdout
    assert "eve  stop  refused  you may not – do this" in said and "ada" not in said


def test_actions_of_a_log_that_was_begun_anew_are_taken_over_too(tmp_path: Path) -> None:
    """A program that rotates logs has moved the one before away."""
    runs = tmp_path / "runs"
    Ledger(runs, create=True).close()
    log = Audit(audit_file(runs))
    for n in range(3):
        log.write("ada", "start", True, f"{n}")
    assert take_over(runs, log.file, "line 3") == 3
    for n in (3, 4):  # of the same length as those before
        log.file.rename(tmp_path / f"{n}")
        log.write("ada", "start", True, f"{n}")
        assert take_over(runs, log.file, "line 3") == 1
        log.write("ada", "start", True, f"{n}")
        assert take_over(runs, log.file, "line 3") == 1
        assert take_over(runs, log.file, "line 3") == 0
    assert [a.note for a in listed_actions(runs)] == ["0", "1", "2", "3", "3", "4", "4"]
