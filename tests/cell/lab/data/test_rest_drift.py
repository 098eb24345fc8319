"""A start is tested by the data: a cable that is said to rest, and moves, is taken as moving."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.cable.effects import library
from cell.cable.geometry import node_arc_lengths
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.cli import app
from cell.lab.data.named_effects import EffectSelection
from cell.lab.data.noise_model import noise_model_of
from cell.lab.data.opened_study import VALUES, open_study, rest_drifts
from cell.lab.diagnosis import diagnose
from cell.lab.search.setup import fit_cache_of
from cell.study.data import Markers, Study, Trial
from cell.study.folder import write_study
from tests.cell.lab.conftest import coloured
from tools.worlds.made_studies import CABLE, filmed, moved

ARCS_M = node_arc_lengths(0.1)[::5]
NOISE_M = 1e-4
#: Of the first mode, in free lengths and free lengths a second: some millimetres of the tip.
SWINGS = {"up": (0.01, 0.1), "down": (-0.01, 0.08)}


def noise_m(shape, ar1, seed):
    return NOISE_M * coloured(np.random.default_rng(seed), shape, ar1)


@pytest.fixture(scope="module")
def swinging():
    """The gripper waits for 0.2 s and moves down; the cable has never come to rest."""
    t = np.arange(0.0, 0.8, 0.002)
    motion = moved(t, (0.0, -0.05), 0.25)
    t_s = np.arange(0.002, t[-1], 0.005)
    model, trials = CableModel(CABLE, np.full(4, 2.5e-5), 1.05, 1e-7), []
    for seed, (name, (place, velocity)) in enumerate(SWINGS.items()):
        modes = np.zeros((2, 4))
        modes[:, 0] = place, velocity
        how = {"solver": Solver(), "start": "moving", "bent": [modes]}
        rng = np.random.default_rng(seed)
        seen = filmed(rng, model, motion, t_s, ARCS_M, noise_m=NOISE_M, colour=0.3, **how)
        trials.append(Trial(name, "fit", "equilibrium", motion, seen))
    trials[1] = replace(trials[1], role="validate")
    return Study("swinging", CABLE, ARCS_M, tuple(trials))


@pytest.fixture(scope="module")
def folder(swinging, tmp_path_factory):
    path = tmp_path_factory.mktemp("swinging")
    write_study(swinging, path)
    return path


def test_a_rest_that_drifts_is_named_with_the_remedy(folder):
    done = CliRunner().invoke(app, ["look", str(folder)])
    said = " ".join(done.output.split())
    assert "Nothing is odd" not in said
    for name in SWINGS:
        assert f"{name}: the cable drifts by" in said
    assert "give `start: moving` in study.yaml" in said


def test_it_is_taken_as_moving_and_the_noise_is_known_all_the_same(folder):
    opened = open_study(folder)
    assert [t.start for t in opened.trials] == ["moving"] * len(SWINGS)
    assert sum("here it is taken as moving" in note for note in opened.notes) == len(SWINGS)
    assert noise_model_of(opened).noise.std_m == pytest.approx(NOISE_M, rel=0.15)


def test_a_right_model_of_a_rest_that_drifts_is_complete(folder):
    candidates = {n: library()[n] for n in ("tip_mass", "natural_curvature")}
    fits = fit_cache_of(open_study(folder), EffectSelection((), candidates))
    assert diagnose(fits).diagnosis.verdict == "complete"


def test_too_few_values_bear_no_unknown_start(swinging, tmp_path):
    few = []
    for trial in swinging.trials:
        xy_m = trial.markers.xy_m[:, :1].copy()
        xy_m[60:] = np.where(np.arange(len(xy_m) - 60)[:, None, None] % 5, np.nan, xy_m[60:])
        assert np.isfinite(xy_m).sum() < 8 * VALUES
        few.append(replace(trial, markers=Markers(trial.markers.t_s, xy_m)))
    write_study(replace(swinging, trials=tuple(few), arc_length_m=ARCS_M[:1]), tmp_path)
    opened = open_study(tmp_path)
    assert {t.start for t in opened.trials} == {"equilibrium"}
    assert any("the cable drifts by" in note for note in opened.notes)


@pytest.mark.parametrize("ar1", [0.0, 0.6, 0.95])
def test_slow_noise_at_rest_is_no_drift(swinging, ar1):
    still = swinging.trials[0].markers.xy_m[:1]
    for seed in range(5):
        trial = swinging.trials[0]
        error_m = noise_m(trial.markers.xy_m.shape, ar1, seed)
        rests = replace(trial, markers=Markers(trial.markers.t_s, still + error_m))
        assert not list(rest_drifts(replace(swinging, trials=(rests,))))


def test_a_rest_of_few_frames_is_no_course(swinging):
    """A polynomial of degree 5 went through 6 frames, and left nothing to divide by."""
    trial = swinging.trials[0]
    few = trial.markers.t_s >= 0.2 - 5.5 * 0.005
    short = Markers(trial.markers.t_s[few], trial.markers.xy_m[few])
    study = replace(swinging, trials=(replace(trial, markers=short),))
    assert list(rest_drifts(study)) == []
