"""Which steps are done again."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import MagicMock

from cell.records.result import AgreementCheck
from cell.run.clocks import CalibratedDelays
from cell.run.commands import Commands
from cell.run.findings import Findings
from cell.run.machine import Machine
from cell.run.plans import CHECK_CLOCKS
from cell.run.step_runner import StepRunner

LATE, LAG = (
    AgreementCheck("camera: timestamps late by", 0.0, "s", -1e-3, 1e-3),
    AgreementCheck("arm: lag", 0.0, "s"),
)
KNOWN = CalibratedDelays(1e-4, 2e-4, 1e-3, "run `cell calibrate time`")


def cycles_with_a_check(
    found: list[tuple[AgreementCheck, ...]], delays: CalibratedDelays | None
) -> list[int]:
    """Numbers of the cycles in which the clocks are checked, and find this one after another."""
    left, done = list(found), list[int]()
    runner = StepRunner(Machine(lambda: 0.0), Commands(), lambda number, step: done.append(number))
    station = SimpleNamespace(task=SimpleNamespace(delays=delays))
    step = replace(CHECK_CLOCKS, act=lambda _, findings: replace(findings, checks=left.pop(0)))
    for number in range(1, 1 + len(found)):
        progress = MagicMock(number=number, findings=Findings(), product=None, station=station)
        progress.seconds = {}
        runner.carry_out(cast(Any, progress), [step])
    return done


def test_clocks_are_checked_until_a_motion_has_told_both() -> None:
    """After a first cable whose jaw was hidden they were never checked again."""
    told = LATE, replace(LAG, low=-1e-3, high=1e-3)
    assert cycles_with_a_check([told, told], KNOWN) == [1]
    assert cycles_with_a_check([(), (LATE, LAG), told, told], KNOWN) == [1, 2, 3]


def test_clocks_of_which_nothing_is_known_are_looked_at_once() -> None:
    assert cycles_with_a_check([(), ()], None) == [1]
