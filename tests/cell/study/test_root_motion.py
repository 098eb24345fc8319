"""The cable's root moves as the gripper does; another scale, axis or rate is said with its size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cell.cable.geometry import Motion
from cell.study.data import HandDrift, Markers, Trial
from cell.study.facts import TrialFacts, trial_facts
from cell.study.imports.alignment import align
from cell.study.record_checks import oddities
from cell.study.rest_shape import ClampedEnd
from cell.study.root_motion import root_motion, root_places_m
from tests.cell.study.test_facts import ARCS_M, a_trial

ARC_M = ARCS_M[::-1]
NOISE_M = 5e-5


def moved(trial: Trial, change: Callable[[np.ndarray], np.ndarray]) -> Trial:
    """The trial with its gripper's positions (T, 2) changed."""
    grip = trial.grip
    xy_m = change(np.column_stack([grip.x_m, grip.y_m]))
    columns = (np.ascontiguousarray(v) for v in xy_m.T)
    return replace(trial, grip=Motion(grip.t_s, *columns, grip.angle_rad))


def turned(xy_m: np.ndarray) -> np.ndarray:
    cosine, sine = np.cos(0.1), np.sin(0.1)
    return xy_m @ np.array([[cosine, sine], [-sine, cosine]])


def stretched(trial: Trial) -> Trial:
    grip = trial.grip
    return replace(trial, grip=Motion(1.5 * grip.t_s, grip.x_m, grip.y_m, grip.angle_rad))


def told(*trials: Trial) -> str:
    return " ".join(oddities([trial_facts(t, ARC_M) for t in trials], noise_std_m=None))


def test_the_root_of_a_clamped_cable_moves_as_its_gripper() -> None:
    found = root_motion(a_trial(), ARC_M, NOISE_M)
    assert found is not None
    assert found.scale == pytest.approx(1.0, abs=0.01)
    assert found.turned_rad == pytest.approx(0.0, abs=0.01)
    assert found.excess < 0.015
    late = moved(a_trial(), lambda xy_m: np.concatenate([xy_m[:1].repeat(8, axis=0), xy_m[:-8]]))
    delayed = root_motion(late, ARC_M, NOISE_M)
    assert delayed is not None and delayed.excess < 0.015, "a delay is told by other checks"


def test_another_scale_another_axis_and_another_rate_are_told_with_their_size() -> None:
    assert "cable's root" not in told(a_trial())
    assert "it moves 0.9" in told(moved(a_trial(), lambda xy_m: 1.1 * xy_m))
    assert "in a direction" in told(moved(a_trial(), turned))
    assert "differs from the gripper's" in told(stretched(a_trial()))


def test_nothing_is_told_where_the_root_is_not_known() -> None:
    trial = moved(a_trial(), lambda xy_m: 1.1 * xy_m)
    drift = HandDrift(0.3, 0.8, (1e-3, 1e-3))
    assert root_motion(replace(trial, hand_drift=drift), ARC_M, NOISE_M) is None
    still = moved(trial, lambda xy_m: 0.0 * xy_m)
    assert root_motion(still, ARC_M, NOISE_M) is None
    one = replace(trial, markers=Markers(trial.markers.t_s, trial.markers.xy_m[:, :1]))
    assert root_motion(one, ARC_M[:1], NOISE_M) is None
    outer = np.isin(np.arange(len(ARC_M)), np.argsort(ARC_M)[-2:])
    far = replace(trial, markers=Markers(trial.markers.t_s, trial.markers.xy_m[:, outer]))
    found = root_motion(far, ARC_M[outer], NOISE_M)
    assert found is None or found.excess < 0.015, "what is extrapolated so far is unsure"


def test_a_trial_whose_clamp_angle_is_another_is_told() -> None:
    facts = trial_facts(a_trial(), ARC_M)

    def leaves(name: str, degrees: float) -> TrialFacts:
        end = ClampedEnd(0.0, 0.1, np.radians(degrees), 0.0, 0.1)
        return replace(facts, name=name, clamped_end=end)

    alike = [leaves("a", 3.0), leaves("b", 2.0), leaves("c", 8.0)]
    assert "leaves the clamp" not in " ".join(oddities(alike, noise_std_m=None))
    said = " ".join(oddities([*alike, leaves("d", 18.0)], noise_std_m=None))
    assert "leaves the clamp +18° from its angle in d, and +6° in the other trials" in said
    two = [leaves("a", 0.0), leaves("d", 15.0)]
    assert "leaves the clamp" not in " ".join(oddities(two, noise_std_m=None)), "which is wrong?"


def test_a_gripper_that_turns_by_more_than_half_a_turn_is_told() -> None:
    trial = a_trial()
    grip = trial.grip
    degrees = np.degrees(grip.angle_rad) + np.linspace(0.0, 5.0, len(grip.t_s))
    assert "the gripper turns by" in told(
        replace(trial, grip=Motion(grip.t_s, grip.x_m, grip.y_m, degrees))
    )
    assert "the gripper turns by" not in told(trial)


def test_the_root_shows_the_clock_and_a_marker_away_from_it_does_not() -> None:
    """A marker at a fifth of the length follows late: 6 ms were added to a clock that was right."""
    trial = a_trial()
    order = np.argsort(ARC_M)
    xy_m = trial.markers.xy_m[:, order]
    path_m = np.column_stack([trial.grip.x_m, trial.grip.y_m])
    root_m = root_places_m(xy_m, ARC_M[order])
    of_root, of_marker = (
        align(trial.grip.t_s, path_m, trial.markers.t_s, at_m) for at_m in (root_m, xy_m[:, 1])
    )
    assert of_root is not None and of_marker is not None
    of_root_s, of_marker_s = abs(of_root.shift_s), abs(of_marker.shift_s)
    assert of_root_s < 1e-3 < 2.0 * of_marker_s
