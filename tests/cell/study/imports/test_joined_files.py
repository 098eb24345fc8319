"""Files of one motion that are joined: a point each, or orientations and markers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cell.files.input_error import InputError
from cell.study.folder import read_study
from cell.study.imports.joined_files import frame_numbers
from cell.study.imports.read import read_capture

from .corpus.swing import MARKERS, Swing, known_study, straight_study
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


#: Lines above a frame's table, and columns and values before those of its points.
FRAMES: dict[str, tuple[str, list[str], str]] = {
    "remark": ("# Stage: 1\n# Time: {t:.4f} s\n# Unit: m\n", ["Name", "X", "Y"], "{name}"),
    "column": ("", ["Time", "name", "x_m", "y_m"], "{t:.4f};{name}"),
    "rate": ("", ["Point ID", "Points:0", "Points:1"], "{number}"),
    "rows": ("", ["x_m", "y_m"], ""),
}


def _frames(s: Swing, folder: Path, form: str) -> list[tuple[Path, Path | None]]:
    """A file per frame, whose numbers have no leading zeros, in the order of a shell."""
    folder.mkdir()
    above, head, first = FRAMES[form]
    at = plane(s, unit_m=1.0).items()
    for i, t in enumerate(s.t_s):
        rows = [[*filter(None, first.format(t=t, name=name, number=k).split(";")),
                 *cells(place[i : i + 1], 9, lost="nan")[0]]
                for k, (name, place) in enumerate(at)]  # fmt: skip
        if form in ("remark", "column"):
            rows = [row for row in rows[i % 3 :] + rows[: i % 3] if row[-1] != "nan"]
        saved(folder / f"stage_{i}_0.csv", above.format(t=t) + lines([head, *rows], ";"))
    return [(file, None) for file in sorted(folder.iterdir())]


@pytest.mark.parametrize("form", ["remark", "column"])
def test_files_of_a_frame_each_are_a_motion_for_each_folder(tmp_path: Path, form: str) -> None:
    truth = [s.with_lost_tip() for s in known_study()]
    written = [pair for s in truth for pair in _frames(s, tmp_path / s.name, form)]
    study, said = study_from(written, tmp_path / "study", {}, {})
    assert "one motion" in said
    assert [t.name for t in study.trials] == [s.name for s in truth]
    check_same(study, *truth, place_m=1e-6)


@pytest.mark.parametrize("form", ["rate", "rows"])
def test_frames_without_times_need_a_rate(tmp_path: Path, form: str) -> None:
    s = straight_study()[0].with_lost_tip()
    files = [file for file, _ in _frames(s, tmp_path / "frames", form)]
    said = run(*files, "-o", tmp_path / "study", *CABLE, code=1)
    assert "--rate" in said
    run(*files, "-o", tmp_path / "study", *CABLE, "--rate", "200", "--force")
    run(tmp_path / "study" / "import.yaml")
    (trial,) = read_study(tmp_path / "study").trials
    np.testing.assert_allclose(trial.markers.t_s - trial.markers.t_s[0], s.t_s, atol=1e-6)
    tip_m = trial.markers.xy_m[:, 0]
    tip_m = tip_m - tip_m[0] - (s.markers_m[:, -1] - s.markers_m[0, -1])
    assert np.nanmax(np.abs(tip_m)) < 1e-6
    assert np.isnan(tip_m[:, 0]).sum() == 8


def test_frames_of_other_columns_are_refused(tmp_path: Path) -> None:
    files = _frames(straight_study()[0], tmp_path / "frames", "remark")
    files[7][0].write_text(files[7][0].read_text().replace("X;Y", "X;Z"))
    with pytest.raises(InputError, match=r"has columns Name, X, Z; the first frame has Name, X, Y"):
        study_from(files, tmp_path / "study", {}, {})


def test_files_of_more_rows_than_files_are_no_frames(tmp_path: Path) -> None:
    s = straight_study()[0]
    tables = [lines([["x_m", "y_m"], *cells(s.markers_m[:, 0], 6)]) for _ in range(12)]
    files = [saved(tmp_path / f"point_{k}.csv", table) for k, table in enumerate(tables)]
    assert frame_numbers([read_capture(file) for file in files]) is None


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
