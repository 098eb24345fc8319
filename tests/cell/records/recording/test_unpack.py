"""A recording stands for its cycle's folder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cell.cable.geometry import Cable, Motion
from cell.files.input_error import InputError
from cell.files.plain import plain
from cell.records.recording import form
from cell.records.recording.reading import read_recording
from cell.records.recording.unpack import study_from_plain, study_to_plain, unpack
from cell.records.recording.writer import RecordingWriter
from cell.study.data import Markers, Study, Trial
from cell.study.folder import read_study

from .conftest import EPOCH_NS


def study() -> Study:
    t_s = np.linspace(0.0, 1.0, 40)
    grip = Motion(t_s, 0.1 * t_s, 0.2 - 0.05 * t_s / 3.0, 0.0 * t_s)
    arcs = np.array([0.1, 0.05, 0.0])
    xy_m = np.stack([grip.x_m[:, None] - arcs, grip.y_m[:, None] + 0.0 * arcs], axis=-1)
    xy_m += np.random.default_rng(1).normal(0.0, 1e-5, xy_m.shape)
    xy_m[3, 1] = np.nan
    trials = (
        Trial("identify", "fit", "equilibrium", grip, Markers(t_s, xy_m)),
        Trial("execute", "validate", "held", grip, Markers(t_s, xy_m), 0.25),
    )
    cable = Cable(0.1, 0.0074, 0.016, 1e-4)
    return Study("s", cable, arcs, trials, noise_std_m=1e-5)


def assert_same(one: Study, other: Study) -> None:
    assert (one.name, one.cable, one.noise_std_m) == (other.name, other.cable, other.noise_std_m)
    assert np.array_equal(one.arc_length_m, other.arc_length_m)
    for a, b in zip(one.trials, other.trials, strict=True):
        assert (a.name, a.role, a.start, a.release_s) == (b.name, b.role, b.start, b.release_s)
        assert np.array_equal(a.markers.xy_m, b.markers.xy_m, equal_nan=True)
        for key in ("t_s", "x_m", "y_m", "angle_rad"):
            assert np.array_equal(getattr(a.grip, key), getattr(b.grip, key))


def test_a_study_comes_back_from_json_to_the_last_bit() -> None:
    text = json.dumps(plain(study_to_plain(study())), allow_nan=False)
    assert_same(study_from_plain(json.loads(text)), study())


def recorded(path: Path, events: list[tuple[str, dict]]) -> Path:
    writer = RecordingWriter(path, {form.EPOCH: str(EPOCH_NS), "format": form.FORMAT})
    for number, (topic, data) in enumerate(events):
        writer.event(topic, 1.0 + number, data)
    writer.close({"complete": "true"})
    return path


CYCLE = (form.CYCLE, {"cycle": 3, "folder": "runs/20261102T063000.000-3"})


def test_what_is_in_it_becomes_the_cycles_folder(tmp_path: Path) -> None:
    path = recorded(
        tmp_path / "any.mcap",
        [
            CYCLE,
            (form.STATE, {"state": "execute", "step": "lower"}),
            (form.STATE, {"state": "complete", "step": None}),
            (form.MODEL, {"parameters": []}),
            (form.STUDY, study_to_plain(study())),
        ],
    )
    folder = unpack(read_recording(path), tmp_path / "into")
    assert folder.name == "20261102T063000.000-3"
    state = json.loads((folder / "state.json").read_text())
    assert (state["cycle"], state["closed"], state["step"]) == (3, True, "lower")
    assert json.loads((folder / "model.json").read_text()) == {"parameters": []}
    assert not (folder / "result.json").exists()
    assert_same(read_study(folder / "study"), study())


@pytest.mark.parametrize(
    ("events", "said"),
    [
        ([(form.STATE, {"state": "idle", "step": None})], "ends before its cycle has begun"),
        ([CYCLE, (form.STUDY, {"name": "s"})], "/cell/study is no study"),
    ],
)
def test_what_lacks_a_cycle_is_refused(tmp_path: Path, events: list, said: str) -> None:
    path = recorded(tmp_path / "any.mcap", events)
    with pytest.raises(InputError, match=said):
        unpack(read_recording(path), tmp_path / "into")
