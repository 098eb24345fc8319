"""A motion to come is measured by the sensors that the study has."""

from __future__ import annotations

import numpy as np
import pytest

from cell.lab.data.prepared import PreparedStudy
from cell.lab.next.motion_file import Stroke
from cell.lab.next.simulated import planned_trials
from cell.lab.next.suggest import whitener_of_planned
from cell.study.data import Markers, Study, Trial, Wrench, WrenchSensor
from cell.study.hand_drift import HandDrift
from tools.worlds.made_studies import CABLE

DOWN = ("down", Stroke(0.0, 0.0, -0.1, 0.4).motion())
#: Two markers, a picture every 4 ms.
FRAMES_S = np.arange(0.004, 1.5, 0.004)


def prepared(seen=True, **of_trial):
    """A study of one motion; seen (…, markers, 2) which coordinates were."""
    xy_m = np.where(seen, 0.0, np.full((len(FRAMES_S), 2, 2), np.nan))
    hand = Stroke(0.0, 0.05, 0.0, 0.3).motion()
    trial = Trial("right", "fit", "equilibrium", hand, Markers(FRAMES_S, xy_m), **of_trial)
    sensor = WrenchSensor(force_std_n=0.01, moment_std_nm=1e-3)
    return PreparedStudy.of(
        Study("made", CABLE, np.array([0.1, 0.05]), (trial,), noise_std_m=1e-4, sensor=sensor)
    )


def test_the_coordinate_alone_that_a_laser_sees_counts():
    study = prepared([[False, True], [False, False]])
    known, (trial,) = planned_trials(study, [DOWN])
    np.testing.assert_array_equal(
        np.isfinite(trial.markers.xy_m).sum(axis=0), [[0, len(trial.markers.t_s)], [0, 0]]
    )
    white = whitener_of_planned(known, trial, np.zeros_like(trial.markers.xy_m))
    assert white.count == len(trial.markers.t_s)


def test_markers_of_two_cameras_are_seen_at_a_rate_of_their_own():
    number = np.arange(len(FRAMES_S))[:, None]
    seen = np.hstack([number % 3 == 0, number % 3 != 0])[..., None]
    _, (trial,) = planned_trials(prepared(seen), [DOWN])
    counts = np.isfinite(trial.markers.xy_m[..., 0]).sum(axis=0) / len(trial.markers.t_s)
    np.testing.assert_allclose(counts, [1.0 / 3.0, 1.0], atol=0.01)


def test_a_wrench_is_among_the_points_at_the_rate_of_its_rows():
    rows_s = np.arange(0.0, 1.5, 0.01)
    values = np.column_stack([0.0 * rows_s, 0.0 * rows_s, np.full_like(rows_s, np.nan)])
    study = prepared(wrench=Wrench(rows_s, values))
    known, (trial,) = planned_trials(study, [DOWN])
    assert trial.markers.xy_m.shape[1] == 2 + 2
    shown = np.isfinite(trial.markers.xy_m[:, 2:])
    assert shown.any(axis=0).tolist() == [[True, True], [False, False]]
    assert known.gauges.joined["down"].rows.sum() == pytest.approx(
        np.ptp(DOWN[1].t_s) / 0.01, abs=2
    )
    assert "down" not in study.gauges.joined


def test_the_hand_is_as_uncertain_as_its_sensor_lets_it_be():
    drift = HandDrift(0.2, 0.5, (1e-3, 1e-3), gain_std=0.01)
    _, (trial,) = planned_trials(prepared(hand_drift=drift), [DOWN])
    assert trial.hand_drift.gain_std == 0.01
    assert trial.hand_drift.from_s == pytest.approx(0.2, abs=0.003)
    assert trial.hand_drift.to_s == pytest.approx(0.6, abs=0.003)
