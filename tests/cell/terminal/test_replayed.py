"""What a person reads of a replayed cycle."""

from dataclasses import replace
from pathlib import Path

import pytest

from cell.records.result import Fault, Outcome, Result
from cell.terminal.replayed import replayed_parts
from cell.wiring.replay import ReplayDifference, Replayed

SAME = Replayed(Path("recording.mcap"), Result(1, Outcome.INSERTED, "f"), True, True, (), {})
FAILED = Result(1, Outcome.FAILED, "f", fault=Fault("execute", "frame 3 is missing"))


@pytest.mark.parametrize(
    ("replayed", "said"),
    [
        (SAME, ["identical: inserted, every number to the last bit"]),
        (
            replace(SAME, complete=False, decided=False, result=FAILED),
            [
                "the recording ends before its cycle does",
                "the replay ended in step execute: frame 3 is missing",
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
    assert replayed_parts(replayed, 3) == said


def test_other_software_is_named() -> None:
    """Versions, before the differences that may come of them."""
    replayed = replace(
        SAME,
        software={"numpy": ("1.0", "2.0")},
        differences=(ReplayDifference("offset_m", 0.1, 0.2),),
    )
    assert replayed_parts(replayed, 3)[0] == "numpy was 1.0, now 2.0"
