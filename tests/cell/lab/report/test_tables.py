"""The sentences that people read: grammar, size of numbers, and what to do next."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cell.cable.effects import library
from cell.lab.data.check import CheckOutcome, Reading
from cell.lab.data.results import Diagnosis, Doubt, Errors, MissingEffect
from cell.lab.next.advice import Paths, advice
from cell.lab.next.discover import Discovery
from cell.lab.report.model_tables import comparison_sentence, discovery_sentence, model_table
from cell.lab.report.tables import (
    _worst_place,
    diagnosis_parts,
    sentence,
    steps_text,
    verdict_line,
    waterfall_table,
)
from cell.lab.report.wording import apart, mm, noise_in_words, residual_in_words
from cell.lab.strength.compare import Comparison, compare_model
from cell.lab.strength.estimate import identified
from cell.lab.verdict.checks import CHECKS
from cell.study.hand_drift import HandDrift
from tests.cell.lab.conftest import fits_of


def diagnosis(verdict, *names, tied=(), noise_m=1e-4, after_m=1e-4):
    missing = tuple(MissingEffect(n, tied, 1e-9, 90.0, {}, Errors(after_m, after_m)) for n in names)
    return Diagnosis(noise_m, Errors(9e-4, 9e-4), verdict, missing)


def test_what_effects_do_to_the_error_is_said_in_millimetres():
    """A share of squares is none of millimetres: "46 %" of nearly nothing, "99 %" of everything."""
    one = sentence(diagnosis("missing", "tip_mass"))
    assert "misses 0.90 mm; with tip mass in it 0.10 mm: camera noise (0.10 mm)." in one
    left = sentence(diagnosis("cannot_tell", "tip_mass", after_m=5e-4))
    assert "with tip mass in it 0.50 mm: 5.0 times the noise, not yet explained." in left
    assert "%" not in one + left
    both = sentence(diagnosis("missing", "tip_mass", "air_drag"))
    assert "with tip mass and air drag in it 0.10 mm" in both


def test_intervals_say_from_which_trials_they_are(make_study):
    """Of one effect `diagnose` and `fit` printed different intervals, and not why."""
    heads = waterfall_table(diagnosis("missing", "tip_mass")).heads
    assert "parameters (95 %, all trials)" in heads
    fits = fits_of(make_study(seed=5), [])
    model = identified(fits.prepared, fits.base.fit)
    assert model_table(model, "the fit trials").title.endswith("intervals, from the fit trials")
    assert model_table(model).title == "Parameters, 95 % intervals"


def test_sensitivity_of_heldout_trials_is_not_called_evidence():
    (check,) = [c for c in CHECKS if c.name == "heldout_insensitive"]
    assert "sensitive" in check.question and check.unit == "ln LR"
    assert "no evidence" in check.reason


def test_where_the_noise_is_not_known_no_effect_is_said_to_lack_and_rest_is_asked_for():
    """Of what may be noise: "lacks an effect", and a motion to tell apart effects of which none was
    named.
    """
    unknown = replace(diagnosis("cannot_tell"), warnings=(Doubt("noise_unknown", "…"),))
    unknown = replace(unknown, checks=(failed("noise_unknown"),))
    assert sentence(unknown).endswith("too few to decide whether that is noise.")
    assert "the model lacks an effect, and" not in verdict_line(unknown)
    said = steps_text(advice(unknown))
    assert "frames at rest" in said
    assert "cell suggest" not in said


def failed(name):
    """A check that failed."""
    (check,) = [c for c in CHECKS if c.name == name]
    return CheckOutcome(check, Reading(0.0, ("tip_mass",)), passed=False).result


def test_one_effect_that_a_prior_alone_asks_for_is_not_told_from_others():
    found = diagnosis("cannot_tell", "tip_mass")
    asked = replace(found, checks=(failed("prior_driven"),))
    assert sentence(asked).endswith("Without the prior the study does not confirm this.")
    tied = replace(found, checks=(failed("ties"),))
    assert sentence(tied).endswith("These motions cannot tell them apart.")


def test_small_noise_is_not_rounded_to_nothing():
    said = sentence(diagnosis("unexplained", noise_m=2.4e-6))
    assert "camera noise is 0.0024 mm" in said
    assert "misses 0.90 mm" in said


@pytest.mark.parametrize(
    ("found", "says"),
    [
        (diagnosis("complete"), "Nothing"),
        (diagnosis("missing", "tip_mass"), "cell fit STUDY --with tip_mass -o"),
        (diagnosis("missing", "tip_mass"), "cell compare STUDY --model before.json --model"),
        (diagnosis("missing", "tip_mass", tied=("added_mass",)), "cell suggest STUDY"),
        (diagnosis("unexplained"), "cell discover STUDY"),
        (diagnosis("cannot_tell"), "cell suggest STUDY"),
    ],
)
def test_the_advice_fits_the_verdict(found, says):
    assert says in steps_text(advice(found))


def test_commands_name_what_was_given_and_quote_it():
    paths = Paths(Path("my study"), {"fan": Path("effects/fan.py")})
    said = steps_text(advice(diagnosis("missing", "fan"), paths))
    assert "cell fit 'my study' --with effects/fan.py -o after.json" in said
    assert "`" not in said


def test_a_law_of_ones_own_that_does_not_explain_all_does_not_end_in_a_circle():
    paths = Paths(Path("s"), {"discovered": Path("discovered.py")})
    said = steps_text(advice(diagnosis("unexplained"), paths, accepted=("discovered",)))
    assert "cell fit s --with discovered.py -o after.json" in said
    assert "cell discover s --with discovered.py -o discovered_2.py" in said


def test_one_statement_about_noise_where_the_study_states_it_and_the_camera_is_better(make_study):
    """A small mass leaves a pattern below the stated error: nobody may call it camera noise."""
    mass = library()["tip_mass"].active(mass_kg=2e-6)
    study = make_study([mass], seed=4, noise_m=2e-6, ar1=0.0)
    study = replace(study, noise_std_m=2e-5)
    shown = compare_model(study, fits_of(study).base.fit.model)
    assert shown.patterns() > 0
    assert shown.noise_at_rest_m == pytest.approx(2e-6, rel=0.1)
    small = Errors(shown.fit_rms_m, shown.heldout_rms_m)
    said = sentence(Diagnosis(shown.noise_m, small, "complete"), shown, shown)
    assert "within the stated error of the measurement (0.02 mm)" in said
    assert "camera noise at rest is 0.002 mm" in said
    assert f"in {shown.patterns()} of 3 trials it has a pattern" in said
    assert "camera noise (0.02" not in said
    words = {residual_in_words(w, shown) for w in shown.where}
    assert words <= {"noise", "a pattern within the stated error"}
    assert "as stated (camera noise at rest 0.002 mm)" in noise_in_words(shown)
    # what the study states of sensors is told beside the verdict
    first, *rest = study.trials
    first = replace(first, hand_drift=HandDrift(0.1, 0.4, (1e-3, 1e-3)))
    sensed = replace(shown, study=replace(study, trials=(first, *rest)))
    parts = diagnosis_parts(Diagnosis(shown.noise_m, small, "complete"), [sensed], ())
    assert "The study states: gripper by accelerometer (1 of 3 trials)." in parts


@pytest.mark.parametrize(
    ("low", "high", "shown"),
    [
        (0.0, 0.0118, ("0", "0.0118")),
        (0.99993, 1.00008, ("0.99993", "1.00008")),  # was "1 … 1"
        (-1.68e-5, 8.36e-6, ("-1.68e-05", "8.36e-06")),
        (1.0, 1.0, ("1", "1")),
    ],
)
def test_the_ends_of_a_narrow_range_are_told_apart(low, high, shown):
    assert apart(low, high) == shown


@pytest.mark.parametrize(
    ("after_m", "complete", "left"),
    [
        (5.2e-5, True, "What is left is noise."),
        (9e-5, True, "What is left is 1.8 times the noise: small, but more than noise."),
        (9e-4, False, "What is left is 18.0 times the noise: another effect is missing too."),
    ],
)
def test_what_a_law_leaves_is_called_noise_only_if_it_is(
    after_m: float, complete: bool, left: str
) -> None:
    law = Discovery("hb", {}, (), 5e-5, 4.5e-3, after_m, True, complete, "")
    assert discovery_sentence(law).endswith(left)


def test_a_model_that_cannot_be_simulated_where_it_was_not_fitted_has_no_small_error():
    """It was given the error on the motions fitted to, as if there were no others."""
    study = SimpleNamespace(noise_std_m=1e-4)
    sound = Comparison(study, 1e-4, 3e-4, 5e-4, {}, {}, (), model="sound")
    lost = replace(sound, fit_rms_m=1e-4, heldout_rms_m=np.inf, model="lost")
    assert lost.error_m == np.inf
    assert lost.removed_share(sound) < 0.0 and sound.removed_share(lost) == 1.0
    assert "on motions not fitted to rises from 0.500 to inf mm" in comparison_sentence(
        [sound, lost]
    )
    assert "on motions not fitted to falls from inf to 0.500 mm" in comparison_sentence(
        [lost, sound]
    )
    best = replace(sound, heldout_rms_m=4.9e-5, model="best")
    said = comparison_sentence([sound, lost, best])
    assert "falls from 0.500 to 0.0490 mm (between them: “lost” inf mm); the" in said
    assert (mm(np.inf), mm(np.nan)) == ("inf", "–")
    none = replace(sound, heldout_rms_m=np.nan)
    assert none.error_m == 3e-4
    assert "the motions fitted to" in comparison_sentence([none, none])


def test_the_worst_place_is_found_where_a_marker_is_lost_in_one_trial():
    """What one trial did not see was the worst place of none; none at all ended the command."""
    study = SimpleNamespace(arc_length_m=np.array([0.1, 0.05]), cable=SimpleNamespace(length_m=0.1))

    def worst(*rms_mm):
        where = [
            SimpleNamespace(
                by_arc_length=SimpleNamespace(rms_m=1e-3 * np.array(values)),
                by_phase={"still": 1e-4, "moving": 2e-4},
            )
            for values in rms_mm
        ]
        return _worst_place(SimpleNamespace(study=study, where=where))

    assert worst((0.9, 0.1), (np.nan, 0.2)) == ", most of it at the tip while the gripper moves"
    assert worst((0.9, np.nan), (np.nan, 0.2)) == ", most of it at the tip while the gripper moves"
    assert worst((np.nan, np.nan)) == ""
