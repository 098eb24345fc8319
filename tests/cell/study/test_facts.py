"""Facts of a trial against what was put into it: frequency, noise, stroke, rest."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from cell.cable.geometry import Motion
from cell.study.data import Markers, Trial, Wrench
from cell.study.facts import (
    noise_m,
    sensors_in_words,
    swing_spectrum,
    trial_facts,
)
from cell.study.hand_drift import HandDrift
from cell.study.record_checks import oddities, stated_oddly
from cell.study.wrench import wrench_facts
from tests.cell.study.imports.corpus.swing import ARCS_M, RATE_HZ
from tests.cell.study.imports.made import made


def a_trial(noise: float = 5e-5) -> Trial:
    m = made(noise_m=noise)
    grip = Motion(m.t_s, *(np.ascontiguousarray(v) for v in m.gripper_m.T), m.angle_rad)
    return Trial("swing", "fit", "equilibrium", grip, Markers(m.t_s, m.markers_m[:, ::-1]))


@pytest.mark.parametrize("frequency_hz", [1.7, 4.0, 23.0])
def test_the_frequency_of_a_damped_swing_is_found(frequency_hz: float) -> None:
    t_s = np.arange(0.0, 3.0, 0.005)
    swing = 0.01 * np.exp(-t_s) * np.sin(2 * np.pi * frequency_hz * t_s)
    found = swing_spectrum(t_s, np.column_stack([0.3 * swing, swing]), 0.0)
    assert found is not None
    assert found.resolution_hz == pytest.approx(1 / 3.0, rel=0.01)
    assert found.peaks_hz[0] == pytest.approx(frequency_hz, abs=0.1 * found.resolution_hz)


def test_two_frequencies_are_told_apart_and_side_lobes_are_none() -> None:
    t_s = np.arange(0.0, 2.0, 0.005)
    swing = np.sin(2 * np.pi * 3.0 * t_s) + 0.4 * np.sin(2 * np.pi * 19.0 * t_s)
    found = swing_spectrum(t_s, np.column_stack([swing, np.full_like(swing, np.nan)]), 0.0)
    assert found is not None
    np.testing.assert_allclose(found.peaks_hz, [3.0, 19.0], atol=0.1)


def test_what_is_too_short_tells_no_frequency() -> None:
    t_s = np.arange(0.0, 0.05, 0.005)
    assert swing_spectrum(t_s, np.zeros((10, 2)), 0.0) is None


def test_what_a_camera_s_noise_shows_is_no_swing() -> None:
    """A cable at rest was said to swing at 34 Hz, and at 20 Hz in the next trial."""
    t_s = np.arange(0.0, 1.4, 0.01)
    for seed in range(20):
        tip_m = np.random.default_rng(seed).normal(0.0, 1e-4, (len(t_s), 2))
        found = swing_spectrum(t_s, tip_m, 0.0, noise_m=1e-4)
        assert found is not None
        assert found.peaks_hz == ()
        swing = 4e-4 * np.exp(-2.0 * t_s) * np.sin(2.0 * np.pi * 4.0 * t_s)
        found = swing_spectrum(t_s, tip_m + swing[:, None], 0.0, noise_m=1e-4)
        assert found is not None
        assert found.peaks_hz[0] == pytest.approx(4.0, abs=0.3)


def test_a_remark_names_every_trial_of_a_usual_study() -> None:
    facts = trial_facts(a_trial(), np.array(ARCS_M[::-1]))
    names = [f"trial_{i}" for i in range(5)]
    still = [replace(facts, name=n, moves_s=None, spectrum=None) for n in names]
    assert oddities(still, None)[0].startswith(f"{', '.join(names)}: the gripper never moves")


def test_noise_is_that_of_the_frames_at_rest() -> None:
    values = np.random.default_rng(0).normal(0.0, 1e-4, (400, 5, 2))
    assert noise_m(values) == pytest.approx(1e-4, rel=0.05)
    assert np.isnan(noise_m(values[:2]))


def test_facts_are_those_that_the_trial_was_made_of() -> None:
    facts = trial_facts(a_trial(), ARCS_M[::-1])
    assert facts.rate_hz == pytest.approx(RATE_HZ)
    assert facts.hand_m == pytest.approx(np.hypot(0.01, 0.05), rel=1e-3)
    assert facts.hand_rad == pytest.approx(0.15)
    assert facts.moves_s is not None
    assert facts.moves_s == pytest.approx((0.4, 0.7), abs=0.05)
    assert 80 <= facts.rest_frames <= 90
    assert facts.noise_m == pytest.approx(5e-5, rel=0.2)
    assert (facts.tip, facts.seen, facts.irregular) == (0, 1.0, 0.0)
    assert facts.spectrum is not None
    assert facts.spectrum.peaks_hz[0] == pytest.approx(4.0, abs=0.15)


def test_what_is_not_known_of_a_trial_is_null_as_json() -> None:
    """A trial that moves from its first row on has no noise at rest: JSON knows no nan."""
    trial = replace(a_trial(), start="moving")
    pulled = replace(trial, wrench=Wrench(np.arange(3.0), np.ones((3, 3))))
    facts, wrench = trial_facts(trial, ARCS_M[::-1]), wrench_facts(pulled)
    assert wrench is not None
    assert json.loads(json.dumps(facts.to_json(), allow_nan=False))["noise_m"] is None
    assert '"noise": null' in json.dumps(wrench.to_json(), allow_nan=False)


def test_sensors_beside_markers_and_log_are_told() -> None:
    trial = a_trial()
    integrated = replace(trial, hand_drift=HandDrift(0.3, 0.8, (1e-3, 1e-3)))
    turned = replace(trial, hand_drift=HandDrift(0.3, 0.8, turn_std_rad=1e-5))
    pulled = replace(integrated, wrench=Wrench(np.zeros(2), np.zeros((2, 3))))
    assert trial_facts(turned, ARCS_M[::-1]).sensors == ("gripper by encoder",)
    assert sensors_in_words([trial, integrated, pulled]) == (
        "gripper by accelerometer (2 of 3 trials), wrench (1 of 3 trials)"
    )
    assert sensors_in_words([trial]) == ""


def test_a_good_trial_has_nothing_odd_and_each_lack_is_told() -> None:
    trial = a_trial()

    def told(changed: Trial) -> str:
        return " ".join(oddities([trial_facts(changed, ARCS_M[::-1])], noise_std_m=None))

    def rows(trial: Trial, chosen: slice) -> Trial:
        markers = trial.markers
        return replace(trial, markers=Markers(markers.t_s[chosen], markers.xy_m[chosen]))

    assert told(trial) == ""
    assert "show the cable at rest" in told(rows(trial, slice(80, None)))
    assert "in a swing of" in told(rows(trial, slice(None, None, 10)))
    assert "swings of" in told(rows(trial, slice(0, 240)))
    assert "the gripper still moves" in told(rows(trial, slice(0, 120)))
    half = trial.markers.xy_m.copy()
    half[::3] = np.nan
    assert "of the values were seen" in told(
        replace(trial, markers=Markers(trial.markers.t_s, half))
    )
    still = Motion(trial.grip.t_s, *(np.zeros_like(trial.grip.t_s) for _ in range(3)))
    assert "the gripper never moves" in told(replace(trial, grip=still))


def test_trials_of_two_cables_are_told_and_of_one_not() -> None:
    trial = a_trial()
    slow = trial.markers.t_s * 1.6
    grip = trial.grip
    other = replace(
        trial,
        name="slow",
        grip=Motion(grip.t_s * 1.6, grip.x_m, grip.y_m, grip.angle_rad),
        markers=Markers(slow, trial.markers.xy_m),
    )
    facts = [trial_facts(t, ARCS_M[::-1]) for t in (trial, other, replace(trial, name="again"))]
    assert "are they of one cable" in " ".join(oddities(facts[:2], noise_std_m=None))
    assert not oddities([facts[0], facts[2]], noise_std_m=None)


def test_a_noise_that_is_stated_beside_that_at_rest_is_told() -> None:
    """With 10 mm stated for 0.1 mm every model was called complete."""
    facts = [trial_facts(a_trial(noise=1e-4), ARCS_M[::-1])]
    for stated_m in (None, 1e-4, 1e-3):
        assert stated_oddly(facts, stated_m) is None, stated_m
    told = str(stated_oddly(facts, 0.01))
    assert told.startswith("noise_std_m states 10 mm, the frames at rest show 0.096 mm: hides")
    assert "no model can be as right" in str(stated_oddly(facts, 1e-9))
    assert told in oddities(facts, 0.01)
