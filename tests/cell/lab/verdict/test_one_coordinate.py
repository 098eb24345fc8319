"""A study in which only one coordinate is measured, by a laser beside the cable, say."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cell.cable.effects import library
from cell.study.data import Markers
from cell.study.folder import write_study
from tests.command import run_cell


@pytest.fixture(scope="module")
def heights(make_study, tmp_path_factory):
    """Of a hidden late camera, the heights of two markers."""
    late = library()["camera_latency"].active(delay_s=0.006)
    study = make_study([late], seed=31)
    trials = []
    for trial in study.trials:
        xy_m = trial.markers.xy_m[:, [0, 4]].copy()
        xy_m[..., 0] = np.nan
        trials.append(replace(trial, markers=Markers(trial.markers.t_s, xy_m)))
    study = replace(study, arc_length_m=study.arc_length_m[[0, 4]], trials=tuple(trials))
    folder = tmp_path_factory.mktemp("study") / "heights"
    write_study(study, folder)
    return folder


def test_one_coordinate_is_fitted_compared_and_shown(heights, tmp_path):
    model, out, page = (tmp_path / n for n in ("model.json", "c.json", "page.html"))
    run_cell("fit", heights, "--with", "camera_latency", "-o", model)
    found = {p["name"]: p for p in json.loads(model.read_text())["parameters"]}
    delay = found["camera_latency.delay_s"]
    assert delay["low"] < 0.006 < delay["high"]
    assert delay["high"] - delay["low"] < 0.003
    given = ["compare", str(heights), "--model", str(model)]
    run_cell(*given, "--json", out, "--report", page)
    assert json.loads(out.read_text())["heldout_rms_m"] == pytest.approx(1e-4, rel=0.1)
