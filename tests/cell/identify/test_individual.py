import json
from dataclasses import replace

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.effects import library
from cell.cable.geometry import Cable, Motion, node_arc_lengths
from cell.cable.model import CableModel
from cell.identify.identified import Identified
from cell.identify.individual import (
    CableRejectedError,
    IdentifyOptions,
    Reason,
    hold_trial,
    identify,
)
from cell.study.data import Markers, Trial

NODES_M = node_arc_lengths(0.1)


@pytest.fixture(scope="module")
def world(measure, flat_cable: Cable):
    return measure(CableModel(flat_cable, np.array([3e-5]), 1.0, 1.3e-7), seed=1)


def with_markers(trial: Trial, xy_m: np.ndarray) -> Trial:
    return replace(trial, markers=Markers(trial.markers.t_s, xy_m))


@pytest.mark.parametrize("method", ["map", "paper"])
def test_a_cable_is_identified(world, flat_cable: Cable, method) -> None:
    found = identify(world.trial, NODES_M, flat_cable, options=IdentifyOptions(method=method))
    assert found.method == method
    assert found.model.rigidity_at(0.02) == pytest.approx(3e-5, rel=0.15)
    assert found.values[-1] == pytest.approx(1.3e-7, rel=0.15)


def test_the_node_in_the_jaw_and_places_along_the_cable_do_not_matter(
    world, flat_cable: Cable
) -> None:
    markers = world.trial.markers.xy_m.copy()
    markers[:, -1] += [3e-4, 1e-3]
    along = np.gradient(world.clean_m, axis=1)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    markers[:, :-1] += 2e-4 * along[:, :-1]
    found = identify(with_markers(world.trial, markers), NODES_M, flat_cable)
    assert found.residual_rms_m < 1.1 * found.noise.std_m
    assert found.model.rigidity_at(0.02) == pytest.approx(3e-5, rel=0.05)


def test_hold_trial_moves_the_log_to_where_the_jaw_was_seen() -> None:
    t = np.linspace(0.0, 1.0, 501)
    log = Motion(t, 0.3 * t, -0.2 * t, np.zeros_like(t))
    frames = np.linspace(0.0, 1.0, 101)
    seen = np.stack([0.3 * frames + 2e-3, -0.2 * frames - 1e-3], axis=-1)
    seen[5:20] = np.nan
    angle = np.where(np.isfinite(seen[:, 0]), 0.01, np.nan)
    trial = hold_trial(log, frames, np.zeros((101, 11, 2)), seen, angle)
    np.testing.assert_allclose(trial.grip.x_m, log.x_m + 2e-3)
    np.testing.assert_allclose(trial.grip.y_m, log.y_m - 1e-3)
    np.testing.assert_allclose(trial.grip.angle_rad, 0.01)
    never = hold_trial(log, frames, np.zeros((101, 11, 2)), seen * np.nan, angle * np.nan)
    assert never.grip is log


def rejected(trial: Trial, flat_cable: Cable, options: IdentifyOptions | None = None) -> Reason:
    with pytest.raises(CableRejectedError) as caught:
        identify(trial, NODES_M, flat_cable, options=options or IdentifyOptions())
    return caught.value.reason


def test_unseen_frames_reject(world, flat_cable: Cable) -> None:
    markers = world.trial.markers.xy_m.copy()
    markers[80:200] = np.nan
    assert rejected(with_markers(world.trial, markers), flat_cable) is Reason.UNSEEN_FRAMES


def test_too_little_swing_rejects(world, flat_cable: Cable) -> None:
    shift = np.column_stack(
        [
            np.interp(world.trial.markers.t_s, world.trial.grip.t_s, v)
            for v in (world.trial.grip.x_m, world.trial.grip.y_m)
        ]
    )
    stiff = world.clean_m[:1] + shift[:, None]
    assert rejected(with_markers(world.trial, stiff), flat_cable) is Reason.LITTLE_SWING


def test_missing_still_frames_reject(world, flat_cable: Cable) -> None:
    late = Markers(world.trial.markers.t_s[45:], world.trial.markers.xy_m[45:])
    assert rejected(replace(world.trial, markers=late), flat_cable) is Reason.NO_STILL_FRAMES


def test_a_motion_that_is_not_the_cables_is_known_by_its_error(world, flat_cable: Cable) -> None:
    """The gripper's log belongs to another time: no cable swings like this, and the model says
    so."""
    right = identify(world.trial, NODES_M, flat_cable)
    late = replace(world.trial.grip, t_s=world.trial.grip.t_s + 0.1)
    found = identify(replace(world.trial, grip=late), NODES_M, flat_cable)
    assert right.model_error_m < 3e-5
    assert found.model_error_m > 2e-3


def test_a_cable_that_the_model_cannot_follow_is_identified_with_its_error(
    flat_cable: Cable, world, measure
) -> None:
    """Hysteresis of three times the usual size: the nearest model, and by how much it misses."""
    friction = library()["bending_hysteresis"].active(moment_n_m=1.2e-5, curvature_1_per_m=0.4)
    other = measure(replace(world.model, effects=(friction,)), seed=5)
    found = identify(other.trial, NODES_M, flat_cable)
    times = other.trial.markers.t_s
    predicted = simulate(found.model, other.trial.grip, times, NODES_M)[0]
    missed_m = float(np.sqrt(np.mean((other.clean_m - predicted)[:, 0, 1] ** 2)))
    assert found.model_error_m == pytest.approx(missed_m, rel=0.3)
    assert found.model_error_m > 2e-4


def test_identified_survives_json(world, flat_cable: Cable) -> None:
    found = identify(world.trial, NODES_M, flat_cable)
    back = Identified.from_dict(json.loads(json.dumps(found.to_dict())))
    np.testing.assert_allclose(back.mean, found.mean, rtol=1e-12)
    np.testing.assert_array_equal(back.covariance, found.covariance)
    assert back.noise == found.noise
    assert back.space.names == found.space.names
    again = identify(world.trial, NODES_M, flat_cable, previous=back)
    assert again.iterations <= 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "other/1"}, "format"),
        ({"effects": ["ghosts"]}, "unknown effects"),
        ({"covariance": [[1.0]]}, "parameters"),
        ({"noise": {"std": 1.0}}, "missing or mistyped"),
        ({"knots": 5}, "parameters"),
    ],
)
def test_damaged_json_is_refused(world, flat_cable: Cable, change, message: str) -> None:
    data = identify(world.trial, NODES_M, flat_cable).to_dict() | change
    with pytest.raises(ValueError, match=message):
        Identified.from_dict(data)
