"""How studies with a known answer are judged and counted, and one of each source end to end."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from cell.lab.verdict.checks import CHECKS
from tools.studies import diagnosis_study
from tools.studies.answers import StudyAnswer
from tools.studies.check_ablation import answer, table, verdict_of
from tools.studies.diagnosis_study import counts
from tools.studies.rows import added_rows, read_rows
from tools.worlds.cases import Case

ROOT = Path(__file__).parents[3]
TIED = "camera_latency|robot_lag"


def row(kind="one", verdict="missing", named="", hidden="", unsaid="", power=1.0, source="made",
        partial=""):  # fmt: skip
    return StudyAnswer(source, kind, "0", hidden, unsaid, power, verdict, named, partial)


def rig(*named, verdict="missing", partial="", unsaid="natural_curvature"):
    return row("all", verdict, "+".join(named), "robot_lag", unsaid, source="rigs", partial=partial)


@pytest.mark.parametrize(
    ("found", "right", "wrong"),
    [
        (row("complete", "complete"), True, False),
        (row("complete", "cannot_tell", "draught"), False, False),
        (row("one", "missing", "air_drag|draught", "draught"), True, False),
        (row("one", "missing", "air_drag+tip_mass", "air_drag"), False, True),
        (row("one", "cannot_tell", "air_drag", "draught"), False, False),
        (row("one", "missing", "camera_latency", "robot_lag"), True, False),
        (row("outside", "unexplained", hidden="magnet"), True, False),
        (row("outside", "missing", "air_drag", "magnet"), False, True),
        (row("pair", "missing", "tip_mass", "tip_mass+air_drag"), False, False),
        (row("pair", "missing", "tip_mass+air_drag", "air_drag+tip_mass"), True, False),
        (row("all", "unexplained", hidden="x_magnet", source="practice"), True, False),
        (rig(TIED), True, False),
        (rig(TIED, "natural_curvature"), True, False),
        (rig("natural_curvature"), False, False),
        (rig(TIED, "natural_curvature", unsaid=""), False, True),
        (rig(verdict="complete"), False, True),
        (rig(verdict="unexplained"), False, False),
    ],
)
def test_a_verdict_is_judged_by_all_that_is_there(found, right, wrong):
    assert (found.right, found.wrong) == (right, wrong)


@pytest.mark.parametrize(
    ("partial", "right"),
    [(TIED, True), ("natural_curvature", False), (f"{TIED}+tip_mass", False), ("", False)],
)
def test_a_partial_explanation_is_right_if_it_names_what_is_hidden(partial, right):
    assert rig(verdict="unexplained", partial=partial).right_in_part == right


def test_only_what_can_be_seen_is_counted():
    rows = [row("one", "missing", "air_drag", "air_drag"),
            row("one", "cannot_tell", "", "air_drag", power=0.2)]  # fmt: skip
    found = counts(rows)
    assert (found["studies"], found["seen"], found["right"]) == (2, 1, 1)


def test_a_study_that_was_stopped_goes_on_and_its_table_names_what_changed(tmp_path):
    file, before = tmp_path / "now.csv", tmp_path / "before.csv"
    for path, verdict in ((file, "complete"), (before, "unexplained")):
        list(added_rows(path, StudyAnswer, [row("complete", verdict)]))
    diagnosis_study.run(file, [Case("made", "complete", "0")], 1)
    (now,) = read_rows(file, StudyAnswer)
    lines = "\n".join(diagnosis_study.table([now], read_rows(before, StudyAnswer)))
    assert "made complete 0 (): unexplained" in lines


def test_a_study_is_made_diagnosed_and_counted_by_the_command(tmp_path):
    command = [sys.executable, "-m", "tools.studies.diagnosis_study", tmp_path / "found.csv",
               "--made", "complete=1", "--workers", "1"]  # fmt: skip
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "| made complete | 1 | 1 | 1 | 0 |" in done.stdout


def ended(**statistics: float) -> StudyAnswer:
    """A row of a study whose search ended at the effect that is hidden."""
    return StudyAnswer("made", "one", "0", "tip_mass", "", 1.0, "missing", "tip_mass",
               statistics=json.dumps(statistics), accepted="tip_mass")  # fmt: skip


@pytest.mark.parametrize(
    ("statistics", "without", "limits", "verdict"),
    [
        ({}, "", {}, "missing"),
        ({"ties": 5.0}, "", {}, "cannot_tell"),
        ({"ties": 5.0, "fitted_error": 1.2}, "", {}, "unexplained"),
        ({"ties": 5.0, "fitted_error": 1.2}, "fitted_error", {}, "cannot_tell"),
        ({"ties": 5.0}, "", {"ties": 6.0}, "missing"),
    ],
)
def test_a_verdict_is_the_worst_of_the_statistics_that_fail(statistics, without, limits, verdict):
    assert verdict_of(ended(**statistics), without, limits) == verdict


@pytest.mark.parametrize(
    ("kind", "hidden", "verdict", "named", "expected"),
    [
        ("complete", "", "complete", "", "right"),
        ("complete", "", "unexplained", "", "wrong"),
        ("complete", "", "cannot_tell", "draught", "no answer"),
        ("complete", "", "refused", "", "no answer"),
        ("one", "tip_mass", "missing", "air_drag|tip_mass", "right"),
        ("one", "tip_mass", "missing", "air_drag", "wrong"),
        ("one", "tip_mass", "complete", "", "wrong"),
        ("one", "tip_mass", "unexplained", "", "no answer"),
        ("pair", "tip_mass+air_drag", "missing", "tip_mass", "no answer"),
        ("pair", "tip_mass+air_drag", "missing", "tip_mass+air_drag", "right"),
        ("outside", "jet", "missing", "draught", "wrong"),
        ("outside", "jet", "unexplained", "", "right"),
    ],
)
def test_an_answer_is_right_wrong_or_none(kind, hidden, verdict, named, expected):
    assert answer(row(kind, hidden=hidden), verdict, named) == expected


def test_the_table_of_checks_has_a_line_for_each_and_for_each_limit():
    failed = ended(ties=5.0)
    lines = list(table([failed], {"ties": 6.0}))
    cells = {line.split(" | ")[0].removeprefix("| "): line.split(" | ")[1:] for line in lines}
    assert {c.name for c in CHECKS} < set(cells)
    assert cells["– (all checks)"][0] == "0 / 0 of 1"
    assert cells["ties"][0] == cells["ties 6"][0] == "1 / 0 of 1"
