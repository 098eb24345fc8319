"""Trials that begin bent and held, or in motion, in a state that nobody has noted."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cell.api.lab import fit_study
from cell.cable.effects import library
from cell.cable.geometry import Motion, node_arc_lengths
from cell.cable.model import CableModel
from cell.cable.swing import mode_curvature
from cell.lab.data.named_effects import EffectSelection
from cell.lab.diagnosis import diagnose
from cell.lab.search.setup import fit_cache_of
from cell.lab.strength.compare import compare_model
from cell.study.data import Markers, Study, Trial
from cell.study.folder import read_study, write_study
from tests.command import run_cell
from tools.worlds.made_studies import CABLE, filmed, moved

ARCS_M = node_arc_lengths(0.1)[::2]
NOISE_M = 1e-4
ANGLES_RAD = (0.0, -0.9, 0.3)
ROLES = ("fit", "fit", "validate")
RELEASE_S = 0.2
RIGIDITY_N_M2 = 2.5e-5 * np.array([1.1, 0.95, 1.0, 0.9])


def truth(*effects):
    return CableModel(CABLE, RIGIDITY_N_M2, 1.05, 1e-7, effects=effects)


def held(*effects):
    """A finger pushes the tip, another the middle; let go a few milliseconds beside the time noted.

    The curvature that they add has a kink: no finite number of modes has that shape.
    """
    rng, trials = np.random.default_rng(4), []
    t = np.arange(0.0, 1.2, 0.002)
    x = np.linspace(0.0, 1.0, 2001)[:-1]
    for number, (angle, role) in enumerate(zip(ANGLES_RAD, ROLES, strict=True)):
        still = Motion(t, 0.0 * t, 0.0 * t, np.full_like(t, angle))
        added = (7.0, -5.0, 6.0)[number] * (1.0 - x) + 3.0 * np.clip(0.6 - x, 0.0, None)
        places = np.linalg.lstsq(mode_curvature(x, 6), added * 0.1, rcond=None)[0]
        bent = [np.stack([places, 0.0 * places])]
        t_s = np.arange(0.002, t[-1], 0.005)
        late_s = RELEASE_S + (0.003, -0.002, 0.004)[number]
        how = {"start": "held", "release_s": late_s, "bent": bent}
        seen = filmed(rng, truth(*effects), still, t_s, ARCS_M, noise_m=NOISE_M, **how)
        trials.append(Trial(f"trial_{number}", role, "held", still, seen, RELEASE_S))
    return Study("held", CABLE, ARCS_M, tuple(trials))


def moving(*effects):
    """Records that begin while the cable swings and, in the first of them, the gripper still
    moves."""
    rng, trials = np.random.default_rng(5), []
    t = np.arange(0.0, 1.4, 0.002)
    for number, (angle, role) in enumerate(zip(ANGLES_RAD, ROLES, strict=True)):
        motion = moved(t, (-0.015, -0.05), 0.25, begin_s=0.1, angle_rad=angle)
        t_s = np.arange(0.002, t[-1], 0.005)
        seen = filmed(rng, truth(*effects), motion, t_s, ARCS_M, noise_m=NOISE_M)
        later = t_s > (0.28, 0.4, 0.45)[number]
        markers = Markers(t_s[later], seen.xy_m[later])
        trials.append(Trial(f"trial_{number}", role, "moving", motion, markers))
    return Study("moving", CABLE, ARCS_M, tuple(trials), noise_std_m=NOISE_M)


def after(grip, begin_s):
    kept = grip.t_s > begin_s
    return Motion(grip.t_s[kept], grip.x_m[kept], grip.y_m[kept], grip.angle_rad[kept])


@pytest.fixture(scope="module", params=[held, moving], ids=["held", "moving"])
def begun(request):
    """How studies are made whose trials begin bent, and one of them without hidden effects."""
    return request.param, request.param()


def examined(study, *names):
    candidates = {n: e for n, e in library().items() if n in names}
    return diagnose(fit_cache_of(study, EffectSelection((), candidates))).diagnosis


def test_a_release_noted_30_ms_early_is_found():
    """A bar's was, and a late camera named: a note was believed to 5 ms, and to 20 at most."""
    t = np.arange(0.0, 1.2, 0.002)
    still = Motion(t, 0.0 * t, 0.0 * t, 0.0 * t)
    t_s = np.arange(0.002, t[-1], 0.01)
    rng, how = np.random.default_rng(6), {"start": "straight", "release_s": 0.13}
    seen = filmed(rng, truth(), still, t_s, ARCS_M, noise_m=NOISE_M, **how)
    trial = Trial("let_go", "fit", "straight", still, seen, 0.1)
    fit = fit_cache_of(Study("s", CABLE, ARCS_M, (trial,)), EffectSelection((), {})).base.fit
    assert fit.initial_states["let_go"][0] == pytest.approx(0.03, abs=5e-4)
    assert fit.rms_m == pytest.approx(NOISE_M, rel=0.05)


def test_the_cable_is_found_however_it_begins(begun):
    _, study = begun
    model, candidate, _ = fit_study(fit_cache_of(study, EffectSelection((), {})))
    found = {n: (q, s) for n, q, s in zip(
        model.space.names, model.mean, np.sqrt(np.diag(model.covariance)), strict=True
    )}  # fmt: skip
    value, std = found["exponent"]
    assert abs(value - 1.05) < 4.0 * std + 0.002
    places = np.linspace(0.0, 0.08, 5)  # the tip's own rigidity bends nothing
    error = np.log(candidate.fit.model.rigidity_at(places) / truth().rigidity_at(places))
    stds = np.array([found[f"rigidity_{i}"][1] for i in range(5)])
    assert np.all(np.abs(error) < 4.0 * stds + 0.01)
    assert candidate.heldout.rms_m == pytest.approx(NOISE_M, rel=0.03)
    compared = compare_model(study, candidate.fit.model)
    assert compared.heldout_rms_m == pytest.approx(NOISE_M, rel=0.03)


def test_what_is_missing_is_named_and_a_right_model_complete(begun):
    made, study = begun
    tried = ("tip_mass", "air_drag", "natural_curvature")
    assert examined(study, *tried).verdict == "complete"
    found = examined(made(library()["tip_mass"].active(mass_kg=2.5e-5)), *tried)
    assert (found.verdict, [m.effect for m in found.missing]) == ("missing", ["tip_mass"])
    mass = found.missing[0].parameters["mass_kg"]
    assert mass.low < 2.5e-5 < mass.high
    assert mass.high - mass.low < 0.2 * 2.5e-5


def test_taken_for_a_start_at_rest_it_is_told_what_to_write(begun, tmp_path):
    made, study = begun
    mistaken = [replace(t, start="equilibrium", release_s=None) for t in study.trials]
    if made is moving:  # records that begin when the gripper has stopped
        mistaken = [replace(t, grip=after(t.grip, t.markers.t_s[0])) for t in mistaken[1:]]
    write_study(replace(study, trials=tuple(mistaken)), tmp_path)
    notes = read_study(tmp_path).notes
    assert len(notes) == len(mistaken)
    word = "start: moving" if made is moving else "start: held` with release_s: 0.2"
    assert all(word in note for note in notes)


def test_a_study_without_rests_asks_for_its_noise(tmp_path):
    study = moving()
    write_study(replace(study, noise_std_m=None), tmp_path / "unknown")
    refused = run_cell("fit", tmp_path / "unknown", "-o", "model.json", code=2)
    assert "give noise_std_m" in refused.output.replace("\n", " ")
    write_study(study, tmp_path / "known")
    assert [t.start for t in read_study(tmp_path / "known").trials] == ["moving"] * 3
    model = tmp_path / "model.json"
    run_cell("fit", tmp_path / "known", "-o", model)
    assert json.loads(model.read_text())["residual_rms_m"] == pytest.approx(NOISE_M, rel=0.03)
