"""Trials in the rows of one file, told apart by a column, are trials of their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cell.study.folder import read_study
from tests.cell.study.imports.corpus.swing import MARKERS as NAMES
from tests.cell.study.imports.corpus.swing import Swing, known_study
from tests.cell.study.imports.corpus.text import saved
from tests.cell.study.imports.made import CABLE, check_same, digits, imported, run, text

#: Of a clock on which the second trial begins so much later, s.
_LATER_S = 40.0


def _hand(s: Swing) -> np.ndarray:
    """(T, 3) gripper, mm, and its angle, deg."""
    return np.column_stack([1e3 * s.gripper_m, np.degrees(s.angle_rad)])


#: Of Stata's clock, which counts ms, under a name that tells no time.
_STATA_MS = 2.1e12


@pytest.mark.parametrize("labels", [(1, 2), ("one", "two")], ids=["numbers", "words"])
@pytest.mark.parametrize(
    "time, later_s", [("time_s", 0.0), ("time_s", _LATER_S), ("tc", _LATER_S)],
    ids=["restarts", "goes on", "is known by its size"],
)  # fmt: skip
def test_a_column_tells_trials_of_a_wide_table_apart(
    tmp_path: Path, time: str, later_s: float, labels: tuple[object, object]
) -> None:
    rows = []
    for number, s in enumerate(known_study()):
        values = np.column_stack([_hand(s), 1e3 * s.markers_m.reshape(len(s.t_s), -1)])
        for t, row in zip(s.t_s + later_s * number, digits(values, 7), strict=True):
            clock = f"{t:.6f}" if time == "time_s" else f"{_STATA_MS + 1e3 * t:.0f}"
            rows.append([labels[number], clock, *row])
    names = ["grip_x_mm", "grip_y_mm", "grip_angle_deg"]
    names += [f"{n}_{a}_mm" for n in NAMES for a in "xy"]
    file = saved(tmp_path / "all.csv", text([["trial", time, *names], *rows]))
    study = imported([str(file)], tmp_path / "s")
    check_same(study, *known_study())
    called = ["trial1", "trial2"] if labels == (1, 2) else labels
    assert [t.name for t in study.trials] == [f"all_{name}" for name in called]


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
    test_a_column_tells_trials_of_a_wide_table_apart(tmp_path, "time_s", 0.0, (1, 2))
    mapping = tmp_path / "s" / "import.yaml"
    mapping.write_text(mapping.read_text().replace("trial: 2", "trial: 3"))
    out = tmp_path / "other"
    assert "has no row with trial 3; correct `only` of the trial" in run(
        mapping, "-o", out, "--force", code=2
    )
    assert len(read_study(tmp_path / "s").trials) == 2


def test_a_column_of_words_tells_trials_apart_and_another_one_the_points(tmp_path: Path) -> None:
    """As R writes tables: rows have a number, for which no name stands; NA where nothing was seen.

    The gripper's trials have another order.
    """
    seen: list[list[object]] = [['"prueba"', '"marca"', '"tiempo"', '"x"', '"y"']]
    hand: list[list[object]] = [['"prueba"', '"tiempo"', '"x"', '"y"', '"angle [deg]"']]
    for word, s in zip("ba", known_study(), strict=True):
        for t, places in zip(1e3 * s.t_s, 1e3 * s.markers_m, strict=True):
            for n, row in zip(NAMES, digits(places, 7), strict=True):
                seen.append([f'"{len(seen)}"', f'"{word}"', f'"{n}"', f"{t:.3f}", *row])
    seen[-1][-2:] = ["NA", "NA"]
    for word, s in sorted(zip("ba", known_study(), strict=True)):
        for t, row in zip(1e3 * s.t_s, digits(_hand(s), 7), strict=True):
            hand.append([f'"{len(hand)}"', f'"{word}"', f"{t:.3f}", *row])
    markers = saved(tmp_path / "marcas.txt", text(seen, " "))
    gripper = saved(tmp_path / "pinza.txt", text(hand, " "))
    study = imported([str(markers), "--hand", str(gripper)], tmp_path / "s")
    assert [t.name for t in study.trials] == ["marcas_b", "marcas_a"]
    assert np.isnan(study.trials[1].markers.xy_m[-1, 0]).all()
    for trial, s in zip(study.trials, known_study(), strict=True):
        np.testing.assert_allclose(np.ptp(trial.grip.y_m), np.ptp(s.gripper_m[:, 1]), atol=1e-6)
        np.testing.assert_allclose(
            trial.markers.xy_m[:-1, ::-1], s.markers_m[:-1], atol=1e-3, rtol=0.0
        )


def test_blocks_of_columns_of_words_with_a_gripper_on_the_same_clock(tmp_path: Path) -> None:
    """As InfluxDB exports: a block for each kind of series, and a line for each number."""
    tables: list[list[list[object]]] = [[["table", "time", "value", "field", "marker", "trial"]]]
    tables.append([["table", "time", "value", "field", "of", "trial"]])
    for number, (word, s) in enumerate(zip(("one", "two"), known_study(), strict=True)):
        for k, name in enumerate(NAMES):
            for axis, column in zip("xy", 1e3 * s.markers_m[:, k].T, strict=True):
                tables[0] += [[k, f"{t + 60 * number:.4f}", f"{v:.7f}", axis, name, word]
                              for t, v in zip(s.t_s, column, strict=True)]  # fmt: skip
        for field, column in zip(("x", "y", "tilt_deg"), _hand(s).T, strict=True):
            tables[1] += [[9, f"{t + 60 * number + 1e-3:.4f}", f"{v:.7f}", field, "tcp", word]
                          for t, v in zip(s.t_s, column, strict=True)]  # fmt: skip
    file = saved(tmp_path / "all.csv", "\n".join(text(rows) for rows in tables))
    study = imported([str(file)], tmp_path / "s")
    assert [t.name for t in study.trials] == ["all_one", "all_two"]
    for trial, s in zip(study.trials, known_study(), strict=True):
        assert len(trial.markers.t_s) == len(trial.grip.t_s) == len(s.t_s)
        np.testing.assert_allclose(trial.grip.t_s - trial.markers.t_s, 1e-3, atol=1e-6)
        np.testing.assert_allclose(trial.grip.angle_rad, s.angle_rad, atol=1e-6)


def test_blocks_of_a_gripper_s_file_are_its_trials(tmp_path: Path) -> None:
    truth = known_study()
    names = [f"{n}_{a}_mm" for n in NAMES for a in "xy"]
    blocks, files = ["# t [s]   x [mm]   y [mm]   angle [deg]\n"], list[str]()
    for word, s in zip(("up", "left"), truth, strict=True):
        values = np.column_stack([s.t_s, 1e3 * s.markers_m.reshape(len(s.t_s), -1)])
        rows = text([["time_s", *names], *digits(values, 7)])
        files.append(str(saved(tmp_path / f"camera_{word}.csv", rows)))
    for word, s in reversed(list(zip(("up", "left"), truth, strict=True))):
        rows = text(digits(np.column_stack([s.t_s, _hand(s)]), 7), " ")
        blocks.append(f"# essai {word}\n{rows}\n")
    robot = str(saved(tmp_path / "robot.dat", "\n".join(blocks)))
    said = run(*files, "--hand", robot, "--hand", robot, "-o", tmp_path / "told", *CABLE)
    assert "camera_up: rows of robot.dat with trial 'essai up' are its gripper's, by names" in said
    study = imported([*files, "--hand", robot, "--hand", robot], tmp_path / "s")
    for trial, s in zip(study.trials, truth, strict=True):
        np.testing.assert_allclose(trial.grip.angle_rad, s.angle_rad, atol=1e-6)
    both = [*files, files[0], *["--hand", robot] * 3]
    assert "tells 2 trials apart, for 3 files" in run(
        *both, "-o", tmp_path / "many", *CABLE, code=2
    )


def test_columns_that_another_program_calls_otherwise_are_the_same_points(tmp_path: Path) -> None:
    files = []
    for k, (s, form, time) in enumerate(
        zip(known_study(), ("{n}/0/{a}", "{n} {a}"), ("Time", "T"), strict=True)
    ):
        at = {
            "gripper": s.gripper_m,
            **dict(zip(NAMES, s.markers_m.transpose(1, 0, 2), strict=True)),
        }
        order = list(at)[:: 1 - 2 * k]
        head = [form.format(n=n, a=a) for n in order for a in "XY"]
        values = np.column_stack([s.t_s, *(1e3 * at[n] * (1.0 + 0.2 * k) for n in order)])
        files.append(saved(tmp_path / f"{k}.csv", text([[time, *head], *digits(values, 7)])))
    said = run(*files, "-o", tmp_path / "s", *CABLE)
    assert "'m1 X' as 'm1/0/X'" in said
    assert "if their scales differ, import each alone" in said
    run(tmp_path / "s" / "import.yaml")
    places = read_study(tmp_path / "s").trials[1].markers.xy_m
    truth = 1.2 * known_study()[1].markers_m[:, ::-1]
    np.testing.assert_allclose(places - places[:1], truth - truth[:1], atol=1e-6)
