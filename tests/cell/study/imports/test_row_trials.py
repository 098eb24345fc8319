"""Trials in the rows of one file, told apart by a column, are trials of their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cell.study.folder import read_study
from tests.cell.study.imports.corpus.swing import MARKERS as NAMES
from tests.cell.study.imports.corpus.swing import Swing, known_study
from tests.cell.study.imports.corpus.text import saved
from tests.cell.study.imports.made import check_same, digits, imported, run, text

#: Of a clock on which the second trial begins so much later, s.
_LATER_S = 40.0


def _hand(s: Swing) -> np.ndarray:
    """(T, 3) gripper, mm, and its angle, deg."""
    return np.column_stack([1e3 * s.gripper_m, np.degrees(s.angle_rad)])


@pytest.mark.parametrize("later_s", [0.0, _LATER_S], ids=["restarts", "goes on"])
def test_a_column_tells_trials_of_a_wide_table_apart(tmp_path: Path, later_s: float) -> None:
    rows = []
    for number, s in enumerate(known_study(), 1):
        values = np.column_stack([_hand(s), 1e3 * s.markers_m.reshape(len(s.t_s), -1)])
        for t, row in zip(s.t_s + later_s * (number - 1), digits(values, 7), strict=True):
            rows.append([number, f"{t:.6f}", *row])
    names = ["grip_x_mm", "grip_y_mm", "grip_angle_deg"]
    names += [f"{n}_{a}_mm" for n in NAMES for a in "xy"]
    file = saved(tmp_path / "all.csv", text([["trial", "time_s", *names], *rows]))
    study = imported([str(file)], tmp_path / "s")
    check_same(study, *known_study())
    assert [t.name for t in study.trials] == ["all_trial1", "all_trial2"]


@pytest.mark.parametrize("late_s", [0.0, 0.03])
def test_a_long_table_in_any_order_with_a_gripper_of_as_many_runs(
    tmp_path: Path, late_s: float
) -> None:
    seen, hand = [], []
    for number, s in enumerate(known_study(), 1):
        t_s = s.t_s + _LATER_S * number
        for t, places in zip(t_s, 1e3 * s.markers_m, strict=True):
            seen += [[number, f"{t:.6f}", n, *row]
                     for n, row in zip(NAMES, digits(places, 7), strict=True)]  # fmt: skip
        for t, row in zip(t_s - late_s, digits(_hand(s), 7), strict=True):
            hand.append([number, f"{t:.6f}", *row])
    order = np.random.default_rng(3).permutation(len(seen))
    seen = [seen[i] for i in order]
    names = ["run", "time_s", "marker", "x_mm", "y_mm"]
    markers = saved(tmp_path / "markers.csv", text([names, *seen]))
    names = ["run", "time_s", "tcp_x_mm", "tcp_y_mm", "tcp_angle_deg"]
    gripper = saved(tmp_path / "hand.csv", text([names, *hand]))
    folder = tmp_path / "s"
    study = imported([str(markers), "--hand", str(gripper)], folder)
    assert [len(t.markers.t_s) for t in study.trials] == [len(s.t_s) for s in known_study()]
    for trial, s in zip(study.trials, known_study(), strict=True):
        at_s = trial.markers.t_s
        grip = np.column_stack([np.interp(at_s, trial.grip.t_s, v)
                                for v in (trial.grip.x_m, trial.grip.y_m)])  # fmt: skip
        np.testing.assert_allclose(grip - grip[0], s.gripper_m, atol=1e-7 if not late_s else 3e-3)


def test_rows_that_no_file_has_are_refused(tmp_path: Path) -> None:
    test_a_column_tells_trials_of_a_wide_table_apart(tmp_path, 0.0)
    mapping = tmp_path / "s" / "import.yaml"
    mapping.write_text(mapping.read_text().replace("trial: 2", "trial: 3"))
    out = tmp_path / "other"
    assert "has no row with trial 3; correct `only` of the trial" in run(
        mapping, "-o", out, "--force", code=2
    )
    assert len(read_study(tmp_path / "s").trials) == 2
