"""Held-out trials confirm what they can see only."""

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.effects import library
from cell.lab.diagnosis import diagnose
from cell.lab.report.tables import sentence
from cell.study.data import Markers
from tests.cell.lab.conftest import fits_of

KNOWN = library()


def at_rest(trial):
    """What was seen before the gripper moved: there no picture tells when it was taken."""
    still = slice(0, int(np.searchsorted(trial.markers.t_s, 0.2)))
    seen = Markers(trial.markers.t_s[still], trial.markers.xy_m[still])
    return replace(trial, markers=seen)


@pytest.fixture(scope="module")
def late(make_study):
    """Pictures 5 ms late, and held-out frames in which nothing moves."""
    study = make_study([KNOWN["camera_latency"].active(delay_s=0.005)], seed=14)
    trials = [at_rest(t) if t.role == "validate" else t for t in study.trials]
    return replace(study, trials=tuple(trials))


def test_an_effect_that_the_held_out_frames_cannot_see_is_found_and_not_confirmed(late):
    found = diagnose(fits_of(late, ("camera_latency", "tip_mass", "air_drag"))).diagnosis
    assert found.verdict == "cannot_tell"
    assert [f.effect for f in found.missing] == ["camera_latency"]
    assert "heldout_insensitive" in [w.code for w in found.warnings]
    assert "it is not confirmed" in sentence(found)


def test_held_out_frames_that_see_nothing_make_no_model_complete(late):
    """The trials fitted to are not explained, whatever frames at rest say."""
    found = diagnose(fits_of(late, ("air_drag",))).diagnosis
    assert found.verdict == "unexplained"
    assert found.missing == ()


def test_held_out_frames_that_see_it_confirm_it(make_study):
    study = make_study([KNOWN["camera_latency"].active(delay_s=0.005)], seed=14)
    found = diagnose(fits_of(study, ("camera_latency", "tip_mass"))).diagnosis
    assert found.verdict == "missing"
    assert [f.effect for f in found.missing] == ["camera_latency"]
    assert "heldout_insensitive" not in [w.code for w in found.warnings]
