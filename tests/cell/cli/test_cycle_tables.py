"""Tables say what happened to every cable, and troubles what to do about it."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from cell.cli.cycle_tables import (
    MOST_COLUMNS,
    replayed_parts,
    results_table,
    seconds_table,
    troubles,
)
from cell.cli.output import show
from cell.files.table import TableData
from cell.records.result import Fault, Outcome, Result
from cell.wiring.replay import ReplayDifference, Replayed

INSERTED = Result(
    1,
    Outcome.INSERTED,
    "runs/a",
    offset_m=0.012,
    predicted_miss_m=-0.00123,
    measured_miss_m=-0.00119,
    margin_m=0.0035,
    probability=0.998,
    prediction_error_m=0.00008,
    wait_s=0.04,
    seconds={"grasp": 0.9, "execute": 1.4},
)
REJECTED = Result(2, Outcome.REJECTED, "runs/b", reason="little swing: 0.1 mm")
FAILED = Result(
    3, Outcome.FAILED, "runs/c", fault=Fault("lower", "fell silent", "arm", "connect again")
)
SAME = Replayed(Path("recording.mcap"), INSERTED, True, True, (), {})


STEPS = ("grasp", "execute")


def printed(table: TableData) -> str:
    text = io.StringIO()
    show(table, console=Console(file=text, width=80))
    return text.getvalue()


def test_results_are_in_millimetres_with_their_signs() -> None:
    text = printed(results_table([INSERTED, REJECTED, FAILED]))
    for shown in ("12", "-1.23", "-1.19", "+3.50", "0.08", "99.8%", "rejected", "failed"):
        assert shown in text


def test_a_second_try_is_said_and_its_steps_have_times() -> None:
    again = replace(INSERTED, stops=("stopped",), seconds={**INSERTED.seconds, "bring_back": 4.2})
    assert "inserted, try 2" in printed(results_table([INSERTED, again]))
    text = printed(seconds_table([INSERTED, again], STEPS))
    (row,) = (line.split() for line in text.splitlines() if line.split()[:1] == ["bring"])
    assert row == ["bring", "back", "4.200"]


def test_times_have_a_column_per_cable_or_a_summary_of_many() -> None:
    assert "cable 1" in printed(seconds_table([INSERTED], STEPS))
    slow = Result(2, Outcome.INSERTED, "", seconds={"grasp": 2.5})
    text = printed(seconds_table([INSERTED] * MOST_COLUMNS + [slow], STEPS))
    (row,) = (line.split() for line in text.splitlines() if line.split()[:1] == ["grasp"])
    assert row == ["grasp", "0.900", "2.500"]


def test_times_of_a_simulated_cell_are_called_simulated() -> None:
    """ "all 4.998" stood below a run that had taken 173 s."""
    assert seconds_table([INSERTED], STEPS, simulated=True).title == "simulated seconds per step"
    assert seconds_table([INSERTED], STEPS).title == "seconds per step"


def test_troubles_name_step_device_cause_and_remedy() -> None:
    assert troubles([INSERTED, REJECTED, FAILED]) == [
        "cable 2 rejected: little swing: 0.1 mm",
        "cable 3 failed in step lower: arm: fell silent; connect again",
    ]


@pytest.mark.parametrize(
    ("replayed", "said"),
    [
        (SAME, ["identical: inserted, every number to the last bit"]),
        (
            replace(SAME, complete=False, decided=False, result=FAILED),
            [
                "the recording ends before its cycle does",
                "the replay ended in step lower: fell silent",
                "nothing was decided in this cycle: only what came before is compared",
                "identical: what it holds, every number to the last bit",
            ],
        ),
        (
            replace(SAME, losses=("873 damaged bytes could not be recovered",)),
            [
                "873 damaged bytes could not be recovered",
                "identical: what it holds, every number to the last bit",
            ],
        ),
    ],
)
def test_says_what_is_the_same(replayed: Replayed, said: list[str]) -> None:
    """Of a torn recording that is what it holds, never the whole cycle."""
    assert [*replayed_parts(replayed, 3)] == said


def test_other_software_is_named() -> None:
    """Versions, before the differences that may come of them."""
    replayed = replace(
        SAME,
        software={"numpy": ("1.0", "2.0")},
        differences=(ReplayDifference("offset_m", 0.1, 0.2),),
    )
    assert next(replayed_parts(replayed, 3)) == "numpy was 1.0, now 2.0"
