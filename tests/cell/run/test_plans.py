"""Steps are data: what a plan says is what is done, timed, recorded and shown."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import cast

import pytest

from cell.plan.measuring import Measuring, Move
from cell.run.findings import Filming, Findings, required
from cell.run.plans import INSERTING, Plan, Repeat, Step, changing_over, filmed, measuring
from cell.run.station import Station
from cell.settings import load_settings
from cell.wiring.build import cell_task
from drivers.interfaces import Pose

FORMER = cell_task(load_settings(Path(__file__).parents[3] / "config" / "fake.yaml"))
MOTION = Measuring("m", Pose(0.0, 0.0), 0.2, (Move(Pose(0.0, -0.05), 0.4),), 0.5)


@pytest.mark.parametrize("plan", [INSERTING, measuring(MOTION)])
def test_a_cable_is_held_from_the_grasp_to_the_release_and_nowhere_else(plan: Plan) -> None:
    holding = [step.name for step in plan.steps if step.holding]
    begin, end = plan.names.index("grasp"), plan.names.index("release")
    assert holding == list(plan.names[begin + 1 : end])


@pytest.mark.parametrize("plan", [INSERTING, measuring(MOTION)])
def test_what_is_held_is_let_go_and_the_hand_goes_home_with_a_rejected_cable_too(
    plan: Plan,
) -> None:
    anyway = [step.name for step in plan.steps if step.with_rejected]
    assert anyway[-2:] == ["release", "go_home"]


@pytest.mark.parametrize("plan", [INSERTING, measuring(MOTION)])
def test_what_keeps_the_computer_busy_is_done_before_any_device_is_connected(plan: Plan) -> None:
    """A camera whose pictures nobody takes for a second is lost."""
    assert plan.names[:2] == ("warm_up", "connect")


@pytest.mark.parametrize("plan", [INSERTING, measuring(MOTION)])
def test_a_change_empties_the_jaws_before_anything_of_the_new_product(plan: Plan) -> None:
    reset = changing_over(plan, FORMER, at_start=False)
    assert [s.name for s in reset.resetting] == [
        *("warm_up", "connect", "empty_jaws", "check_paths", "reset")
    ]
    ready = changing_over(plan, FORMER, at_start=True)
    assert ready.resetting == plan.resetting
    assert [s.name for s in ready.starting] == ["empty_jaws", "check_paths", "reset", "start"]
    assert ready.execute == reset.execute == plan.execute


def test_steps_with_the_same_name_are_one_row() -> None:
    plan = replace(INSERTING, starting=(*INSERTING.starting, *INSERTING.completing))
    assert plan.names.count("go_home") == 1
    assert len(plan.steps) == len(INSERTING.steps) + 1


def test_steps_that_are_repeated_are_in_the_table_where_they_are_done_first() -> None:
    (whole,) = (e for e in INSERTING.execute if isinstance(e, Repeat))
    (choosing,) = (e for e in whole.steps if isinstance(e, Repeat))
    for repeat in (whole, choosing):
        names = [step.name for step in repeat.flat]
        at = INSERTING.names.index(names[0])
        assert list(INSERTING.names[at : at + len(names)]) == names
    at = INSERTING.names.index("simulate")
    assert INSERTING.names[at - 1 : at + 3 : 3] == ("identify", "execute")
    assert [s.name for s in whole.before_repeat] == ["bring_back"]
    assert "bring_back" not in INSERTING.names, "most cables never come to it"


FILMS = [filmed(Filming(0.0, 1.0, 2.0, 9), decides=decides) for decides in (True, False)]


@pytest.mark.parametrize("plan", [INSERTING, measuring(MOTION), *FILMS])
def test_what_a_step_reads_an_earlier_one_has_added(plan: Plan) -> None:
    added = set[str]()
    for step in plan.steps:
        assert set(step.reads.split()) <= added, step.name
        added |= set(step.adds.split())
    assert added <= {field.name for field in fields(Findings)}


def test_a_step_sees_what_it_reads_and_changes_what_it_adds() -> None:
    def act(station: Station, findings: Findings) -> Findings:
        assert (findings.stopped, findings.wait_s, findings.lead_s) == ("so", None, 2.0)
        return replace(findings, lead_s=3.0, reason="unsaid")

    step = Step("act", act, reads="stopped", adds="lead_s")
    before = Findings(stopped="so", wait_s=1.0, lead_s=2.0)
    after = step.apply(cast(Station, None), before)
    assert (after.stopped, after.wait_s, after.lead_s, after.reason) == ("so", 1.0, 3.0, None)


def test_a_step_that_comes_too_early_is_a_mistake_of_the_plan() -> None:
    with pytest.raises(LookupError, match="no step before it"):
        required(Findings().held)
