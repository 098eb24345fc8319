"""The page of a cycle says how it ended, and leaves out what is not known."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from cell.records.cycle_page import cycle_page
from cell.records.folder import Record, read_record
from cell.records.result import Fault, Outcome, Result


@pytest.mark.parametrize(
    ("outcome", "more", "said"),
    [
        (Outcome.INSERTED, {"offset_m": 0.024, "part": "<A-1>"}, "inserted at offset 24 mm"),
        (Outcome.REJECTED, {"reason": "no offset passes"}, "rejected: no offset passes"),
        (
            Outcome.FAILED,
            {"fault": Fault("lower", "cause & more", "arm", "mend it", "in the jaws", "arm.lost")},
            "failed in step lower: cause &amp; more. mend it in the jaws",
        ),
        (None, {}, "ended without a result in step lower"),
    ],
)
def test_the_first_line_says_how_it_ended(
    tmp_path: Path, outcome: Outcome | None, more: dict, said: str
) -> None:
    made = Record(tmp_path, 3, datetime(2026, 11, 24, 6, 30))
    made.state(step="lower")
    made.pictures({"seen": np.full((40, 50, 3), 128, np.uint8)})
    if outcome is not None:
        seconds = {"lower": 0.5, "hold": 1.0}
        made.close(Result(3, outcome, str(made.folder), seconds=seconds, **more))
    page = cycle_page(read_record(made.folder), None)
    assert said in page
    assert ('class="says bad"' in page) == (outcome is not Outcome.INSERTED)
    assert page.count("data:image/jpeg;base64,") == 1
    assert ("&lt;A-1&gt;" in page) == ("part" in more)
    assert "<h2>Decision</h2>" not in page
    assert ("<h2>Times</h2>" in page) == (outcome is not None)
