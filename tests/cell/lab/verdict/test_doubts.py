"""Doubtful fits say so, in words, in the JSON, and without ending the command."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cell.api import lab
from cell.cable.effects import library
from cell.cable.geometry import Cable, Motion
from cell.identify.gauss_newton import Options, UnsimulatedError
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy
from cell.lab.diagnosis import diagnose
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import at_bound
from cell.lab.verdict.doubts import fit_doubts
from cell.study.data import Markers
from cell.study.folder import write_study
from tests.cell.lab.conftest import fits_of
from tests.command import run_cell


@pytest.fixture(scope="module")
def loaded(make_study):
    return make_study([library()["tip_mass"].active(mass_kg=2.5e-5)], seed=11, hold_s=0.8)


@pytest.fixture(scope="module")
def loaded_fits(loaded):
    return fits_of(loaded)


def fitted(folder, tmp_path, *more):
    out = tmp_path / "model.json"
    done = run_cell("fit", folder, "-o", out, *more)
    return json.loads(out.read_text()), done.output


def test_a_fit_that_cannot_be_right_says_so_in_its_first_line(loaded, tmp_path):
    """The tip's swing is delayed by half a second: nothing follows the gripper.

    Said to begin in motion, lest the clocks that differ be refused before.
    """
    trials = []
    for trial in loaded.trials:
        xy_m = np.roll(trial.markers.xy_m[:, :1], 110, axis=0)
        creeps_m = 1e-6 * np.arange(110.0)[:, None, None]  # exactly still: one that is lost
        xy_m[:110] = trial.markers.xy_m[0, :1] + creeps_m
        trial = replace(trial, start="moving")
        trials.append(replace(trial, markers=Markers(trial.markers.t_s, xy_m)))
    late = replace(loaded, arc_length_m=loaded.arc_length_m[:1], noise_std_m=1e-4)
    write_study(replace(late, trials=tuple(trials)), tmp_path / "late")
    model, said = fitted(tmp_path / "late", tmp_path)
    assert "hopeless" in {w["code"] for w in model["warnings"]}
    assert said.startswith("Warning: the fit misses")


def test_an_answer_at_its_bound_is_flagged(make_study, tmp_path):
    late = library()["camera_latency"].active(delay_s=0.09)
    study = make_study([late], seed=32)
    trials = [
        replace(t, markers=Markers(t.markers.t_s + 0.05, t.markers.xy_m)) for t in study.trials
    ]
    write_study(replace(study, trials=tuple(trials), noise_std_m=1e-4), tmp_path / "late")
    model, said = fitted(tmp_path / "late", tmp_path, "--with", "camera_latency")
    assert "at_bound" in {w["code"] for w in model["warnings"]}
    assert "camera_latency.delay_s is at its bound" in " ".join(said.split())


@pytest.mark.parametrize(("kg_per_m", "flagged"), [(0.9989, True), (1.0, True), (0.9, False)])
def test_what_is_all_but_at_its_bound_is_there(kg_per_m, flagged):
    """An added mass of 0.9989 kg/m, bound 1, was named as what a study lacks."""
    cable = Cable(0.1, 0.0074, 0.016, 1e-4)
    space = ParameterSpace.of(cable, effects=(library()["added_mass"],))
    space.low[-1] = space.high[-1]  # `along` is a constant
    q = space.mean.copy()
    q[-2] = kg_per_m
    assert bool(at_bound(SimpleNamespace(space=space, q=q))) is flagged
    q[-2] = 0.0
    assert at_bound(SimpleNamespace(space=space, q=q)) == []


LIKELY = np.array([3.0, 2.5, 2.0, 2.0, 2.5, 3.0]) * 1e-5


@pytest.mark.parametrize(
    ("rigidity_n_m2", "elsewhere_n_m2", "left_mm", "codes"),
    [
        (LIKELY * [100.0, 1, 1, 1, 1, 1], LIKELY * [100.0, 1, 1, 1, 1, 1], 3.0, {"implausible"}),
        (LIKELY, LIKELY * [1, 1, 1, 1, 4.0, 1], 3.0, {"starts_disagree"}),
        (LIKELY, LIKELY * [1.5, 1, 1, 1, 1, 1], 3.0, set()),
        (LIKELY, None, 3.0, set()),
        (LIKELY * [100.0, 1, 1, 1, 1, 1], LIKELY, 0.25, set()),
    ],
)
def test_a_wrong_minimum_far_above_the_noise_says_so(
    loaded, rigidity_n_m2, elsewhere_n_m2, left_mm, codes
):
    """Twenty millimetres were left by a cable of which EI differed 1000-fold, without a warning."""
    space = ParameterSpace.of(loaded.cable)

    def fit(rigidity_n_m2):
        q = space.mean.copy()
        q[:6] = np.log(rigidity_n_m2)
        return SimpleNamespace(
            space=space, q=q, model=space.model(q), rms_m=left_mm * 1e-3, arrived=True
        )

    candidate = SimpleNamespace(fit=fit(rigidity_n_m2), heldout=None)
    fits = SimpleNamespace(
        prepared=PreparedStudy.of(replace(loaded, noise_std_m=1e-4)),
        base=candidate,
        second_start=lambda: None if elsewhere_n_m2 is None else fit(elsewhere_n_m2),
        second=None,
        prior_q=None,
    )
    found = {w.code for w in fit_doubts(fits, candidate)}
    assert found - {"beyond_noise"} == codes


def test_a_fit_whose_second_start_ends_at_another_place_of_an_effect_says_so(loaded):
    """A magnet's fit ended at 1.03 mm beside its place without a word, with EI as it should be."""
    magnet = library()["tip_mass"]
    space = ParameterSpace.of(loaded.cable, effects=(magnet,))
    count = len(space.names)
    where = space.names.index("tip_mass.mass_kg")

    def fit(mass_kg, rms_m):
        natural = space.natural(space.mean)
        natural[where] = mass_kg
        q = space.coordinates(natural)
        return SimpleNamespace(
            space=space, q=q, model=space.model(q), rms_m=rms_m, widening=2.0, arrived=True,
            covariance=1e-14 * np.eye(count),
        )  # fmt: skip

    def said(second, rms_m):
        first = SimpleNamespace(fit=fit(1e-5, rms_m), heldout=None)
        fits = SimpleNamespace(
            prepared=PreparedStudy.of(replace(loaded, noise_std_m=1e-4)),
            base=first,
            second_start=lambda: second,
            second=second,
            prior_q=None,
        )
        return {w.code: w.message for w in fit_doubts(fits, first)}

    found = said(fit(4e-5, 1.1e-3), 1e-3)["starts_disagree"]
    assert "one misses 1 mm, the other 1.1 mm, with tip_mass.mass_kg 1e-05 and 4e-05 kg" in found
    # near the noise, too, if the other is as good; what is far worse is no rival
    assert "starts_disagree" in said(fit(4e-5, 1.05e-4), 1e-4)
    assert "starts_disagree" not in said(fit(4e-5, 1e-3), 1e-4)
    assert "starts_disagree" not in said(fit(1e-5 + 1e-8, 1e-3), 1e-3)


def test_a_prior_of_another_cable_is_named_as_a_cause(make_study, tmp_path):
    """Its error was called a missing effect."""
    study, path = make_study(seed=3), tmp_path / "model.json"
    lab.fit(study).write(path)
    assert "beyond_noise" not in {w.code for w in lab.fit(study, prior=path).warnings}
    model = json.loads(path.read_text())
    for parameter in model["parameters"]:
        if parameter["name"].startswith("rigidity"):
            for key in ("value", "low", "high"):
                parameter[key] *= 1.6
    path.write_text(json.dumps(model))
    said = {w.code: w.message for w in lab.fit(study, prior=path).warnings}
    assert "the prior is that of another cable, or the model lacks" in said["beyond_noise"]


@pytest.mark.parametrize(("promised", "said"), [(1.9, None), (18.0, "about 3 standard deviations")])
def test_a_fit_left_before_its_minimum_says_how_far_it_is(loaded_fits, promised, said):
    base = loaded_fits.base
    fit = replace(base.fit, solution=replace(base.fit.solution, promised=promised))
    count = int(np.count_nonzero(fit.solution.residual))
    fit = replace(fit, chi2=2.0 * count)
    warned = {w.code: w.message for w in fit_doubts(loaded_fits, replace(base, fit=fit))}
    assert (said is None) == ("not_converged" not in warned)
    assert said is None or said in warned["not_converged"]


def test_a_fit_of_too_few_passes_warns_and_writes_that_it_did_not_converge(
    loaded, tmp_path, monkeypatch
):
    write_study(loaded, tmp_path / "loaded")
    for name in ("REFIT", "POLISH"):
        monkeypatch.setattr(f"cell.lab.search.baseline.{name}", Options(max_iterations=1))
        monkeypatch.setattr(f"cell.lab.search.fit_cache.{name}", Options(max_iterations=1))
    model, said = fitted(tmp_path / "loaded", tmp_path, "--with", "tip_mass")
    assert model["converged"] is False
    assert "not_converged" in {w["code"] for w in model["warnings"]}
    assert "before its minimum" in " ".join(said.split())


def test_of_a_baseline_that_cannot_fit_a_second_start_is_looked_at(make_study):
    poor = fits_of(make_study([library()["camera_latency"].active(delay_s=0.03)]))
    assert poor.second_start().objective >= 0.999 * poor.base.fit.objective
    assert fits_of(make_study()).second_start() is None


def test_a_prior_and_an_effect_that_it_lacks_go_together(loaded, tmp_path):
    write_study(loaded, tmp_path / "loaded")
    prior = tmp_path / "prior.json"
    run_cell("fit", tmp_path / "loaded", "-o", prior)
    more = ["--prior", str(prior), "--with", "tip_mass"]
    model, _ = fitted(tmp_path / "loaded", tmp_path, *more)
    found = {p["name"]: p for p in model["parameters"]}["tip_mass.mass_kg"]
    assert found["low"] <= found["value"] <= found["high"]


def test_a_held_out_trial_that_diverges_is_a_finding_not_an_end(loaded, tmp_path):
    last = loaded.trials[-1]
    t_s = last.grip.t_s
    thrown = np.where(t_s < 0.15, 0.0, 1.0)
    shaken = Motion(
        t_s, 40.0 * thrown * np.sin(60.0 * t_s), last.grip.y_m, 6.0 * thrown * np.sin(40.0 * t_s)
    )
    seen = np.full_like(last.markers.xy_m, np.nan)
    seen[:20] = last.markers.xy_m[:20]
    shaken_trial = replace(last, grip=shaken, markers=replace(last.markers, xy_m=seen))
    write_study(replace(loaded, trials=(*loaded.trials[:-1], shaken_trial)), tmp_path / "shaken")
    model, said = fitted(tmp_path / "shaken", tmp_path)
    assert "diverges" in {w["code"] for w in model["warnings"]}, said
    out, page = tmp_path / "c.json", tmp_path / "c.html"
    given = ["compare", str(tmp_path / "shaken"), "--model", str(tmp_path / "model.json")]
    run_cell(*given, "--json", out, "--report", page)
    assert json.loads(out.read_text())["heldout_rms_m"] is None


def test_beside_what_is_no_model_of_the_cable_nothing_is_looked_for(make_study, monkeypatch):
    """Seen upside down: a minute went into effects that might make up for it."""
    flipped = make_study(seed=2).with_places(lambda trial: trial.markers.xy_m * [1.0, -1.0])
    fits = fits_of(flipped, ("tip_mass",))
    monkeypatch.setattr(FitCache, "fit_extended", None)
    found = diagnose(fits).diagnosis
    assert (found.verdict, found.missing, found.partial) == ("unexplained", (), ())
    assert [w.code for w in found.warnings][:2] == ["not_searched", "hopeless"]
    assert "signs of y_m" in found.warnings[0].message


def test_a_search_that_cannot_go_on_tells_what_it_knew(make_study, monkeypatch):
    fits = fits_of(make_study(seed=2), ("tip_mass",))

    def impossible(*args):
        raise UnsimulatedError

    monkeypatch.setattr(FitCache, "fit_extended", impossible)
    found = diagnose(fits).diagnosis
    assert found.verdict == "cannot_tell"
    assert [w.code for w in found.warnings] == ["unsimulated"]
    assert found.baseline.fit_rms_m > 0.0
