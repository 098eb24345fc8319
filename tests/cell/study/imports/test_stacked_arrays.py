"""Arrays of several points or trials: whose the names are, and which dimension is the trials'."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cell.study.folder import read_study
from cell.study.imports.contents import contents
from cell.study.imports.read import read_capture

from .corpus.swing import BACK_M, MARKERS, Swing, known_study
from .made import CABLE, check_same, imported, run
from .test_groups import PLACE_M, _study


def _spatial(places_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (…, 2) with a y out of the plane."""
    return np.insert(places_m, 1, 0.0, axis=-1)


def _saved(file: Path, arrays: dict[str, NDArray[np.float64]], names: list[str]) -> Path:
    """Arrays, and an array of words; in a .mat of version 7.3 the words are references."""
    import h5py

    if file.suffix == ".npz":
        np.savez(file, labels=np.array(names), **arrays)  # type: ignore[arg-type]
        return file
    with h5py.File(file, "w", userblock_size=512 if file.suffix == ".mat" else 0) as store:
        for name, values in arrays.items():
            store[name] = values.T if file.suffix == ".mat" else values
        if file.suffix != ".mat":
            store["labels"] = np.array(names, dtype=h5py.string_dtype())
            return file
        references = np.empty((1, len(names)), dtype=h5py.ref_dtype)
        for k, name in enumerate(names):
            text = store.create_dataset(f"#refs#/{k}", data=np.array([[ord(c)] for c in name]))
            text.attrs["MATLAB_class"] = np.bytes_("char")
            references[0, k] = text.ref
        store.create_dataset("labels", data=references, dtype=h5py.ref_dtype)
    file.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + file.read_bytes()[512:])
    return file


@pytest.mark.parametrize("count, form", list(product((3, 4), ("npz", "h5", "mat"))))
@pytest.mark.parametrize("array", ["tcp_quat", "tool_quaternion"])
def test_names_of_points_are_not_those_of_a_quaternion_or_of_one_place(
    tmp_path: Path, count: int, form: str, array: str
) -> None:
    """As many points as a quaternion has numbers, or a place; w is first, which no name states."""
    s = known_study()[1]
    points = [0, 2, 4] if count == 3 else [0, 1, 2, 4]
    half, none = s.angle_rad / 2, np.zeros(len(s.t_s))
    arrays = {
        "time": s.t_s,
        "pos": _spatial(s.markers_m[:, points]),
        "tcp_pos": _spatial(s.gripper_m),
        array: np.column_stack([np.cos(half), none, -np.sin(half), none]),
    }
    file = _saved(tmp_path / f"t.{form}", arrays, [MARKERS[i] for i in points])
    study, _ = _study(file)
    check_same(study, replace(s, markers_m=s.markers_m[:, points]), place_m=PLACE_M)
    assert [n for n in read_capture(file).names if "quat" in n] == [
        f"{array} {axis}" for axis in "xyzw"
    ]


def test_names_of_points_are_those_of_columns_that_tell_whether_they_are_seen(
    tmp_path: Path,
) -> None:
    s = known_study()[1]
    arrays = {"time": s.t_s, "pos": s.markers_m, "confidence": np.ones((len(s.t_s), len(MARKERS)))}
    names = read_capture(_saved(tmp_path / "t.npz", arrays, list(MARKERS))).names
    assert names[-len(MARKERS) :] == tuple(f"{m} confidence" for m in MARKERS)


@pytest.mark.parametrize("apart_m, is_line", [(0.0, False), (BACK_M, True)])
def test_two_points_nearer_than_their_noise_are_no_line(
    tmp_path: Path, apart_m: float, is_line: bool
) -> None:
    s = known_study()[0]
    noise_m = np.random.default_rng(5).normal(0.0, 2e-4, s.gripper_m.shape)
    second_m = s.gripper_m + apart_m / BACK_M * (s.back_m - s.gripper_m) + noise_m
    arrays = {"time": s.t_s, "tcp": s.gripper_m, "clamp": second_m}
    arrays |= dict(zip(MARKERS, s.markers_m.transpose(1, 0, 2), strict=True))
    file = _saved(tmp_path / "t.npz", arrays, [])
    run(file, "-o", tmp_path / "s", *CABLE)
    assert ("towards" in (tmp_path / "s" / "import.yaml").read_text()) == is_line


def _netcdf(file: Path, trials: tuple[Swing, ...], dimension: str, order: str) -> Path:
    """As xarray writes it; order of the dimensions by their first letters."""
    import h5py

    letter = {dimension: "T", "time": "t", "marker": "m", "axis": "a"}
    arrays = {
        "position": ("Ttma", np.stack([_spatial(s.markers_m) for s in trials])),
        "gripper_position": ("Tta", np.stack([_spatial(s.gripper_m) for s in trials])),
        "gripper_pitch": ("Tt", np.stack([s.angle_rad for s in trials])),
    }
    with h5py.File(file, "w") as store:
        words = {dimension: [s.name for s in trials], "marker": MARKERS, "axis": "xyz"}
        for name, values in words.items():
            store[name] = np.array(list(values), dtype=h5py.string_dtype())
        store["time"] = (1e6 * trials[0].t_s).round()
        store["time"].attrs["units"] = "microseconds since 2026-11-30"
        for name in letter:
            store[name].make_scale(name)
        for name, (own, values) in arrays.items():
            letters = [a for a in order if a in own]
            store[name] = values.transpose([own.index(a) for a in letters])
            for k, a in enumerate(letters):
                scale = next(n for n, first in letter.items() if first == a)
                store[name].dims[k].attach_scale(store[scale])
        store["position"].attrs["units"] = "m"
    return file


@pytest.mark.parametrize("dimension", ["trial", "run"])
@pytest.mark.parametrize("order", ["Ttma", "Tmta", "tTma", "tmaT", "maTt"])
def test_a_dimension_of_trials_is_a_trial_each(tmp_path: Path, dimension: str, order: str) -> None:
    truth = known_study()
    study, said = _study(_netcdf(tmp_path / "swings.nc", tuple(truth), dimension, order))
    assert [t.name for t in study.trials] == ["down", "turning"]
    check_same(study, *truth, place_m=PLACE_M)
    assert "time is" not in said  # the file says µs


@pytest.mark.parametrize("own_times", [False, True])
@pytest.mark.parametrize("numbers", [None, (7, 9), (0, 0)])
def test_places_in_four_dimensions_are_trials_also_without_names(
    tmp_path: Path, own_times: bool, numbers: tuple[int, int] | None
) -> None:
    truth = known_study()
    arrays = {
        "time": np.stack([s.t_s for s in truth]) if own_times else truth[0].t_s,
        "pos": np.stack([_spatial(s.markers_m) for s in truth]),
        "tcp_pos": np.stack([_spatial(s.gripper_m) for s in truth]),
        "tcp_pitch": np.stack([s.angle_rad for s in truth]),
    } | ({} if numbers is None else {"run_id": np.array(numbers)})
    file = _saved(tmp_path / "all.npz", arrays, list(MARKERS))
    study = imported([str(file)], tmp_path / "s")
    check_same(study, *truth, place_m=PLACE_M)


def test_points_one_after_the_other_in_a_row_and_trials_without_times(tmp_path: Path) -> None:
    import h5py

    truth, file = known_study(), tmp_path / "demo.hdf5"
    with h5py.File(file, "w") as store:
        for k, s in enumerate(truth):
            of = store.create_group(f"data/demo_{k}/obs")
            of["cable_keypoints"] = _spatial(s.markers_m).reshape(len(s.t_s), -1)
            of["robot0_eef_pos"] = _spatial(s.gripper_m)
            of["robot0_eef_angle_rad"] = s.angle_rad
            store[f"data/demo_{k}/rewards"] = np.zeros(len(s.t_s))
    study = imported([str(file), "--rate", "200"], tmp_path / "s")
    assert [t.name for t in study.trials] == ["demo_0", "demo_1"]
    check_same(study, *truth, place_m=PLACE_M)


@pytest.mark.parametrize("name", ["joint_positions", "qdot", "setpoint", "markers_seen"])
def test_six_numbers_in_a_row_that_are_no_chain_are_no_points(tmp_path: Path, name: str) -> None:
    """Joints of an arm that rests at first; the last name has a word of points."""
    s = known_study()[0]
    joints = np.array([0.1, -1.5, 1.5, 0.2, 1.6, 0.0]) + np.outer(
        20.0 * s.gripper_m[:, 1], np.arange(6.0)
    )
    arrays = {"time": s.t_s, "gripper": s.gripper_m, name: 30.0 * joints}
    capture = read_capture(_saved(tmp_path / "t.npz", arrays, []))
    assert [p.name for p in contents(capture).points] == ["gripper"]


@pytest.mark.parametrize("first", ["a_copy", "other_copy"])
def test_a_point_with_the_places_of_another_is_left_out(tmp_path: Path, first: str) -> None:
    s = known_study()[0]
    arrays = {"time": s.t_s, "gripper": s.gripper_m, "angle_rad": s.angle_rad}
    arrays |= dict(zip(MARKERS, s.markers_m.transpose(1, 0, 2), strict=True))
    arrays |= {first: s.gripper_m}
    file = _saved(tmp_path / "t.npz", dict(sorted(arrays.items())), [])
    told = run(file, "-o", tmp_path / "s", *CABLE)
    assert f"'{first.replace('_', ' ')}' has the places of 'gripper' in all rows" in told
    run(tmp_path / "s" / "import.yaml")
    check_same(read_study(tmp_path / "s"), s, place_m=PLACE_M)
