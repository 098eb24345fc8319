"""The whole chain on studies of a finer world: right verdict, nothing false beside it."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest

from cell.cable.effects import library
from cell.lab import diagnosis
from cell.lab.data.results import to_json
from cell.lab.data.rules import DEFAULT_RULES
from cell.lab.data.work import STAGES, Budget, SpentError, Work
from cell.lab.diagnosis import diagnose, with_agreement, with_limits
from cell.lab.fit.score_test import screen
from cell.lab.report.tables import nearest_table
from cell.lab.search import effect_search
from cell.lab.verdict import ties
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.ties import with_ties
from cell.study.folder import read_study
from tests.cell.lab.conftest import LONG, fits_of

SCHEMA = {
    "type": "object",
    "additionalProperties": False,
    "required": [
        "format", "noise_m", "baseline", "verdict", "missing", "ranking", "left", "partial",
        "nearest", "warnings", "limits", "agreement", "noise_is_stated", "checks",
        "independence", "knots", "fit_errors",
    ],
    "properties": {
        "format": {"const": "cable-diagnosis/1"},
        "noise_m": {"type": "number"},
        "noise_is_stated": {"type": "boolean"},
        "baseline": {"required": ["fit_rms_m", "heldout_rms_m"]},
        "left": {"required": ["rms_m", "before_rms_m", "over_noise", "explained_share", "peak"]},
        "partial": {"items": {"required": ["effect", "tied_with", "explained_share"]}},
        "nearest": {"items": {"required": ["effect", "explained_share", "fit_rms_m", "peak"]}},
        "warnings": {"items": {"required": ["code", "message"]}},
        "checks": {
            "items": {
                "required": [
                    "name", "question", "unit", "statistic", "passes", "limit", "passed", "failing",
                    "failed",
                ],
            },
        },
        "independence": {
            "required": ["effective_trials", "recordings", "motions", "held_out"],
        },
        "knots": {"type": "integer"},
        "fit_errors": {"items": {"required": ["effects", "rms_m", "noise_m"]}},
        "limits": {
            "items": {"required": ["effect", "parameter", "unit", "low", "high", "tip_m"]},
        },
        "agreement": {
            "items": {
                "required": ["parameter", "unit", "value", "spread", "p_value", "agrees"],
                "properties": {
                    "by_trial": {"items": {"required": ["trial", "value", "low", "high"]}},
                },
            },
        },
        "verdict": {"enum": ["complete", "missing", "unexplained", "cannot_tell"]},
        "missing": {
            "items": {
                "additionalProperties": False,
                "required": [
                    "effect", "tied_with", "p_value", "delta_bic", "parameters", "fit_rms_m",
                    "heldout_rms_m", "explained_share",
                ],
                "properties": {
                    k: {}
                    for k in (
                        "effect", "tied_with", "p_value", "delta_bic", "parameters", "fit_rms_m",
                        "heldout_rms_m", "explained_share",
                    )
                },
            }
        },
        "ranking": {
            "items": {
                "required": ["effect", "score", "p_value", "status"],
                "properties": {"status": {"enum": ["present", "absent", "inspect", "cannot_tell"]}},
            }
        },
    },
}  # fmt: skip


#: Enough of the library to confuse, few enough to be quick.
RIVALS = ("air_drag", "linear_air_drag", "tip_mass", "grip_angle", "natural_curvature")


def test_an_effect_that_was_refitted_is_weighed_however_much_that_took(make_study, monkeypatch):
    """Of a long study nothing was accepted, because its first refits had taken all there was."""
    drag = library()["air_drag"].active(drag_coefficient=2.0)
    accepted, ends = effect_search._accepted, []

    def begun(fits, *given):
        if not ends:
            fits.work.budget = Budget(simulated_s=fits.work.simulated_s / STAGES["search"])
        ends.append(fits)
        return accepted(fits, *given)

    monkeypatch.setattr(effect_search, "_accepted", begun)
    found = diagnose(fits_of(make_study([drag], seed=6), ("air_drag", "tip_mass"))).diagnosis
    assert [f.effect for f in found.missing] == ["air_drag"]


def test_a_second_search_is_not_cut_short_by_the_work_of_the_first(make_study, monkeypatch):
    """Models that left noise were dropped so: the search anew ended at the first effect."""
    drag = library()["air_drag"].active(drag_coefficient=2.0)
    study, names, ends_s = make_study([drag], seed=6, **LONG), ("air_drag", "tip_mass"), []
    searched = diagnosis.search_effects

    def noted(fits, *given):
        found = searched(fits, *given)
        ends_s.append(fits.work.simulated_s)
        return found

    monkeypatch.setattr(diagnosis, "search_effects", noted)
    diagnose(fits_of(study, names))
    first_s, _ = ends_s
    found = diagnose(
        fits_of(study, names, work=Work(Budget(simulated_s=first_s / STAGES["search"])))
    )
    assert [f.effect for f in found.diagnosis.missing] == ["air_drag"]
    assert ends_s[-1] > first_s


def test_whatever_its_budget_a_diagnosis_ends_and_claims_no_more(make_study):
    """Two studies of real rigs gave no answer in 400 s."""
    drag = library()["air_drag"].active(drag_coefficient=2.0)
    study, names = make_study([drag], seed=6), ("air_drag", "tip_mass", "grip_angle")
    fits = fits_of(study, names)
    right, all_s = diagnose(fits).diagnosis, fits.work.simulated_s
    assert right.verdict == "missing"
    for share in (0.25, 0.5):
        fits = fits_of(study, names, work=Work(Budget(simulated_s=share * all_s)))
        found = with_agreement(with_limits(diagnose(fits))).diagnosis
        assert fits.work.simulated_s < 1.2 * share * all_s
        assert found.verdict == right.verdict or "cut_short" in found.codes
        assert {f.effect for f in found.missing} <= {"air_drag"}
        jsonschema.validate(json.loads(json.dumps(to_json(found), allow_nan=False)), SCHEMA)
    with pytest.raises(SpentError):
        diagnose(fits_of(study, names, work=Work(Budget(simulated_s=0.01 * all_s))))


def test_a_complete_model_is_called_complete(make_study):
    examination = diagnose(fits_of(make_study(seed=5), RIVALS))
    found = examination.diagnosis
    assert found.verdict == "complete"
    assert found.missing == ()
    assert found.baseline.heldout_rms_m == pytest.approx(1e-4, rel=0.03)
    jsonschema.validate(json.loads(json.dumps(to_json(found), allow_nan=False)), SCHEMA)


def test_a_hidden_effect_is_named_measured_and_removed(make_study):
    drag = library()["air_drag"].active(drag_coefficient=2.0)
    said: list[str] = []
    fits = fits_of(
        make_study([drag], seed=6, **LONG), RIVALS, progress=lambda text, *_: said.append(text)
    )
    found = with_agreement(diagnose(fits)).diagnosis
    assert found.verdict == "missing"
    falls = [re.search(r"error (\S+) → (\S+) mm \(noise 0.1", text) for text in said]
    before, after = zip(*(map(float, fall.groups()) for fall in falls if fall), strict=True)
    assert before[0] > 0.11 and min(after) < 0.103, "who watches sees the error fall"
    assert any("refitted with air_drag, error" in text for text in said)
    refit = next(text for text in said if "refitted with tip_mass" in text)
    own, least = re.findall(r"(\S+) mm \(noise", refit)
    assert float(own) > 0.15 and float(least) < 0.103, "its own error, and that of the best"
    assert "; best so far with air_drag, error" in refit
    assert [f.effect for f in found.missing] == ["air_drag"]
    assert {a.parameter: a.agrees for a in found.agreement}["air_drag.drag_coefficient"]
    value = found.missing[0].parameters["drag_coefficient"]
    assert value.low < 2.0 < value.high
    assert value.high - value.low < 0.6
    assert found.missing[0].errors.heldout_rms_m < 1.03e-4
    assert found.baseline.heldout_rms_m > 1.1e-4
    assert found.ranking[0].status == "present"
    jsonschema.validate(json.loads(json.dumps(to_json(found), allow_nan=False)), SCHEMA)


def test_two_effects_are_both_found(make_study):
    known = library()
    hidden = [known["tip_mass"].active(mass_kg=2.5e-5), known["grip_angle"].active(angle_rad=0.03)]
    found = diagnose(fits_of(make_study(hidden, seed=7), RIVALS)).diagnosis
    assert found.verdict == "missing"
    assert {f.effect for f in found.missing} == {"tip_mass", "grip_angle"}
    assert found.missing[-1].errors.heldout_rms_m < 1.03e-4
    # the first one's too is of the model with both: alone it would stand in for the other
    parameters = {n: p for f in found.missing for n, p in f.parameters.items()}
    for name, true in (("mass_kg", 2.5e-5), ("angle_rad", 0.03)):
        assert parameters[name].low < true < parameters[name].high


def test_three_effects_are_all_found_though_two_of_them_leave_much(make_study):
    """The search ended after two where more than a tenth of the error was left."""
    known = library()
    strengths = {
        "tip_mass": {"mass_kg": 1e-4},
        "grip_angle": {"angle_rad": 0.1},
        "air_drag": {"drag_coefficient": 6.0},
    }
    hidden = [known[name].active(**values) for name, values in strengths.items()]
    found = diagnose(fits_of(make_study(hidden, seed=7), RIVALS)).diagnosis
    assert found.verdict == "missing"
    assert {f.effect for f in found.missing} == set(strengths)


def test_nothing_is_claimed_below_the_noise_that_the_study_states(make_study):
    slip = library()["grip_slip"].active(length_m=2e-5)
    study = make_study([slip], seed=4, noise_m=1e-5, ar1=0.0)
    names = ("grip_slip", "tip_mass")
    assert diagnose(fits_of(study, names)).diagnosis.verdict == "missing"
    found = diagnose(fits_of(replace(study, noise_std_m=2e-5), names)).diagnosis
    assert found.verdict == "complete"


def test_beside_a_true_effect_too_nothing_is_claimed_below_the_stated_noise(make_study):
    known = library()
    hidden = [known["tip_mass"].active(mass_kg=3e-5), known["grip_slip"].active(length_m=2e-5)]
    study = make_study(hidden, seed=4, noise_m=1e-5, ar1=0.0)
    names = ("grip_slip", "tip_mass")
    found = diagnose(fits_of(study, names)).diagnosis
    assert {f.effect for f in found.missing} == set(names)
    found = diagnose(fits_of(replace(study, noise_std_m=2.2e-5), names)).diagnosis
    assert [f.effect for f in found.missing] == ["tip_mass"]


def test_an_effect_outside_the_library_is_unexplained(make_study):
    mass = library()["tip_mass"].active(mass_kg=3e-5)
    found = diagnose(fits_of(make_study([mass], seed=8), ("air_drag", "linear_air_drag")))
    assert found.diagnosis.verdict == "unexplained"
    assert found.diagnosis.missing == ()


def test_a_wrong_effect_that_leaves_what_looks_like_noise_is_not_claimed(make_study):
    """Its whole residual is 2 % above the noise, p = 0.5; only the smooth part tells."""
    mass = library()["tip_mass"].active(mass_kg=1.2e-5)
    study = make_study([mass], seed=8, noise_m=2e-4)
    rivals = ("added_mass", "grip_angle")
    assert diagnose(fits_of(study, rivals)).diagnosis.verdict == "unexplained"
    found = diagnose(fits_of(study, (*rivals, "tip_mass"))).diagnosis
    assert found.missing[0].effect == "tip_mass"


def test_without_held_out_trials_nothing_is_claimed(make_study):
    study = make_study([library()["tip_mass"].active(mass_kg=3e-5)], seed=9)
    study = replace(study, trials=study.role("fit"))
    found = diagnose(fits_of(study, ("tip_mass", "air_drag"))).diagnosis
    assert found.verdict == "cannot_tell"
    assert to_json(found)["baseline"]["heldout_rms_m"] is None


def test_screening_a_cable_that_its_typical_nudges_would_break(make_study):
    fits = fits_of(make_study(), ("grip_compliance",))
    stiff = replace(fits.base.fit, q=fits.base.fit.q.copy())
    (found,) = screen(fits.prepared, stiff, [library()["grip_compliance"]])
    assert np.isfinite(found.score.statistic)


@pytest.mark.parametrize("name", ["bending_hysteresis", "added_mass"])
def test_practice_studies(practice, name):
    study = read_study(practice / name)
    names = ("bending_hysteresis", "added_mass", "natural_curvature", "draught", "tip_mass")
    found = diagnose(fits_of(study, names)).diagnosis
    assert found.verdict == "missing"
    assert name in (found.missing[0].effect, *found.missing[0].tied_with)
    assert len(found.missing) == 1
    assert found.missing[0].errors.heldout_rms_m < 1.05 * found.noise_m


def test_what_any_of_many_effects_does_beside_one_is_none_of_them(monkeypatch):
    """One compliant grip, and a second effect that seven others would do as well as: a pair of
    which one is in truth missing was a `cannot_tell`.
    """
    first, second = library()["grip_compliance"], library()["linear_air_drag"]
    pair = SimpleNamespace(effects=[first, second])
    alone = SimpleNamespace(effects=[first])
    fits = SimpleNamespace(
        base=None,
        library={},
        rules=DEFAULT_RULES,
        added=lambda found: found.effects,
        fit_reduced=lambda found, effect: {second: alone}.get(effect),
    )
    tied = {first: (), second: ("a", "b", "c", "d", "e", "f", "g")}
    monkeypatch.setattr(ties, "_tied", lambda _, found, effect: tied[effect])
    enough = [True]
    monkeypatch.setattr(ties, "explains", lambda *args: enough[0])
    given = Evidence(fits, pair)
    found = with_ties(given)
    assert (found.final, found.tied) == (alone, {first.name: ()})
    enough[0] = False
    assert with_ties(given).final is pair
    enough[0], tied[second] = True, ("a",)
    assert with_ties(given).final is pair
    tied[first] = tied[second] = ("a", "b", "c")
    assert with_ties(Evidence(fits, alone)).final is alone


def test_a_right_model_is_complete_though_a_trial_held_out_is_noisier(make_study):
    """Noise of one level for all would make its residual too large, and another effect of it."""
    study, rng = make_study(noise_m=1e-9), np.random.default_rng(1)
    trials = []
    for trial in study.trials:
        std_m = 2e-4 if trial.role == "validate" else 1e-4
        xy_m = trial.markers.xy_m + rng.normal(0.0, std_m, trial.markers.xy_m.shape)
        trials.append(replace(trial, markers=replace(trial.markers, xy_m=xy_m)))
    found = diagnose(fits_of(replace(study, trials=tuple(trials)), RIVALS)).diagnosis
    assert found.verdict == "complete"
    assert found.noise_m == pytest.approx(np.sqrt((1.0 + 1.0 + 4.0) / 3.0) * 1e-4, rel=0.15)


def test_an_effect_that_is_stronger_than_its_bound_says_so(make_study):
    """Pictures that come 0.15 s late, of which the library believes 0.1 s."""
    study = make_study()
    late = [replace(t, markers=replace(t.markers, t_s=t.markers.t_s + 0.15)) for t in study.trials]
    fits = fits_of(replace(study, trials=tuple(late)), ("camera_latency", "tip_mass"))
    found = diagnose(fits).diagnosis
    assert found.verdict == "unexplained"
    (latency,) = (n for n in found.nearest if n.effect == "camera_latency")
    assert latency.at_bound == ("camera_latency.delay_s 0.1 s",)
    assert "At a bound: camera_latency.delay_s 0.1 s: the effect" in nearest_table(found).note
