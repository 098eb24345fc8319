"""How studies with a known answer are judged and counted, and one of each source end to end."""

from __future__ import annotations

import csv
import subprocess
import sys
from dataclasses import asdict, fields
from pathlib import Path

import pytest

from tools.studies import diagnosis_study
from tools.studies.diagnosis_study import Row, counts
from tools.worlds.cases import Case

ROOT = Path(__file__).parents[3]
TIED = "camera_latency|robot_lag"


def row(kind="one", verdict="missing", named="", hidden="", unsaid="", power=1.0, source="made",
        partial=""):  # fmt: skip
    return Row(source, kind, "0", hidden, unsaid, power, verdict, named, partial)


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


def test_a_study_that_was_stopped_goes_on_and_its_table_names_what_changed(tmp_path, capsys):
    file, before = tmp_path / "now.csv", tmp_path / "before.csv"
    for path, verdict in ((file, "complete"), (before, "unexplained")):
        with path.open("w", newline="") as out:
            writer = csv.DictWriter(out, [f.name for f in fields(Row)])
            writer.writeheader()
            writer.writerow(asdict(row("complete", verdict)))
    case = Case("made", "complete", "0")
    diagnosis_study.run(file, [case], 1)
    assert len(diagnosis_study.read(file)) == 1
    told = "\n".join(
        diagnosis_study.table(diagnosis_study.read(file), diagnosis_study.read(before))
    )
    assert "made complete 0 (): unexplained" in told


def test_a_study_is_made_diagnosed_and_counted_by_the_command(tmp_path):
    command = [sys.executable, "-m", "tools.studies.diagnosis_study", tmp_path / "found.csv",
               "--made", "complete=1", "--workers", "1"]  # fmt: skip
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "| made complete | 1 | 1 | 1 | 0 |" in done.stdout
