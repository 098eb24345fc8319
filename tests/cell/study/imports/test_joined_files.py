"""Files of one motion that are joined: a point each, or orientations and markers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cell.study.folder import read_study

from .corpus.swing import MARKERS, Swing, straight_study
from .corpus.text import cells, lines, plane, saved, trc
from .made import CABLE, check_same, run
from .test_corpus import study_from


def _files(s: Swing, folder: Path, form: str) -> list[tuple[Path, Path | None]]:
    """A file per point, the gripper's first."""
    found: list[tuple[Path, Path | None]] = []
    for name, at in plane(s, unit_m=1.0).items():
        if name != "gripper_back":
            rows = cells(np.column_stack([s.t_s, at]), 9)
            file = folder / f"{form.format(trial=s.name, point=name)}.txt"
            found.append((saved(file, f"mass {name}\t\t\n" + lines([["t", "x", "y"], *rows], "\t")),
                          None))  # fmt: skip
    return found


@pytest.mark.parametrize("form", ["{trial}_{point}", "{point}_{trial}"])
@pytest.mark.parametrize("count", [1, 2])
def test_files_of_a_point_each_are_one_motion(tmp_path: Path, form: str, count: int) -> None:
    truth = straight_study()[:count]
    written = [pair for s in truth for pair in _files(s, tmp_path, form)]
    study, said = study_from(written, tmp_path / "study", {}, {})
    assert "one motion" in said
    check_same(study, *truth, place_m=1e-6, angle_rad=0.02)


def test_points_that_are_lost_are_missing_rows_of_files_in_a_folder_per_motion(
    tmp_path: Path,
) -> None:
    """Names of points have one word or two; the gripper is in files of its own."""
    truth, files, hands = straight_study(), list[Path](), list[Path]()
    for s in truth:
        (tmp_path / s.name).mkdir()
        for k, name in enumerate(MARKERS):
            rows = cells(np.column_stack([s.t_s, s.markers_m[:, k]]), 9)
            rows = rows[:100] + rows[101 + 3 * k :]
            called = f"point {k}" if k else name
            file = saved(tmp_path / s.name / f"{called}.txt", lines([["t", "x", "y"], *rows], "\t"))
            files.append(file)
        path = cells(np.column_stack([s.t_s, s.gripper_m, s.angle_rad]), 9)
        head = ["t_s", "tcp_x_m", "tcp_y_m", "tcp_angle_rad"]
        hands.append(saved(tmp_path / f"robot_{s.name}.csv", lines([head, *path])))
    of_hands = [word for hand in hands for word in ("--hand", str(hand))]
    said = run(*files, *of_hands, "-o", tmp_path / "study", *CABLE)
    assert "are taken as one motion's" in said
    run(tmp_path / "study" / "import.yaml")
    study = read_study(tmp_path / "study")
    for trial, s in zip(study.trials, truth, strict=True):
        lost = np.isnan(trial.markers.xy_m[:, ::-1, 0]).sum(axis=0)
        assert (len(trial.markers.t_s), lost.tolist()) == (len(s.t_s) - 1, [0, 3, 6, 9, 12])
        np.testing.assert_allclose(trial.grip.y_m, s.gripper_m[:, 1], atol=1e-6)
    assert "--hand names 1 files for 10 trials" in run(
        *files, *of_hands[:2], "-o", tmp_path / "other", *CABLE, code=2
    )


def test_orientations_alone_are_joined_to_the_markers(tmp_path: Path) -> None:
    s = straight_study()[0]
    at = {n: p for n, p in plane(s, unit_m=1.0).items() if n in ("gripper", *MARKERS)}
    head = ["time_s", *(f"{n}_{a}_m" for n in at for a in "xy")]
    places = cells(np.column_stack([s.t_s, *at.values()]), 9)
    markers = saved(tmp_path / "markers.csv", lines([head, *places]))
    turns = cells(np.column_stack([s.t_s, s.angle_rad]), 9)
    hand = saved(tmp_path / "imu.csv", lines([["time_s", "gripper_pitch_rad"], *turns]))
    study, _ = study_from([(markers, hand)], tmp_path / "study", {}, {})
    check_same(study, s, place_m=1e-6)


def test_points_of_a_gripper_that_is_not_called_so_move_as_one_body(tmp_path: Path) -> None:
    s = straight_study()[0]
    file = trc(s, tmp_path)
    file.write_text(file.read_text().replace("gripper_back", "jia2").replace("gripper", "jia1"))
    said = run(file, "-o", tmp_path / "first", *CABLE)
    assert "'jia1' is the gripping point, for 'jia2' moves with it as one body" in said
    study, _ = study_from([(file, None)], tmp_path / "study", {}, {})
    check_same(study, s, place_m=1e-6)
