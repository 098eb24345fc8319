from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drivers.interfaces import LimitError, Trajectory
from drivers.plane_mount import PlaneMount
from drivers.ur_kinematics import MODELS, UR5E, OutOfReachError, _rotation_vector, check_reach
from drivers.ur_pose import matrices_of, matrix_of, pose_of

READY = np.array([0.3, -1.4, 1.6, -1.8, -1.5, 0.2])


def test_forward_matches_the_makers_poses() -> None:
    """Arm stretched out level: positions follow from adding up the lengths."""
    a, d = UR5E.a_m, UR5E.d_m
    tool = UR5E.forward(np.zeros(6))
    assert tool[:3, 3] == pytest.approx([a[1] + a[2], -(d[3] + d[5]), d[0] - d[4]])
    upright = UR5E.forward(np.array([0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0]))
    assert upright[:3, 3] == pytest.approx([0.0, -(d[3] + d[5]), d[0] - a[1] - a[2] + d[4]])


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda m: m.name)
def test_inverse_undoes_forward(model) -> None:
    rng = np.random.default_rng(0)
    X_FT = matrix_of(np.array([0.01, 0.0, 0.15, 0.0, 0.2, 0.0]))
    for _ in range(20):
        q = READY + rng.uniform(-0.5, 0.5, 6)
        near = q + rng.uniform(-0.1, 0.1, 6)
        assert model.inverse(model.forward(q, X_FT), near, X_FT) == pytest.approx(q, abs=1e-5)


def test_many_poses_at_once_are_those_of_each() -> None:
    X_FT = matrix_of(np.array([0.01, 0.0, 0.15, 0.0, 0.2, 0.0]))
    q = READY + np.random.default_rng(0).uniform(-0.5, 0.5, (7, 6))
    each = [UR5E.forward(joints, X_FT) for joints in q]
    assert UR5E.forward_each(q, X_FT) == pytest.approx(np.array(each), abs=1e-15)


def test_jacobian_is_the_derivative() -> None:
    step = 1e-6
    jacobian = UR5E.jacobian(READY)
    for i in range(6):
        dq = np.eye(6)[i] * step
        after, before = UR5E.forward(READY + dq), UR5E.forward(READY - dq)
        linear = (after[:3, 3] - before[:3, 3]) / (2 * step)
        turn = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec() / (2 * step)
        assert jacobian[:, i] == pytest.approx([*linear, *turn], abs=1e-8)


@given(
    axis=st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda n: np.linalg.norm(n) > 1e-3),
    angle_rad=st.one_of(st.floats(0.0, np.pi), st.sampled_from([0.0, 1e-12, np.pi - 1e-10, np.pi])),
)
def test_a_rotation_is_that_of_its_vector(axis: tuple[float, ...], angle_rad: float) -> None:
    """At half a turn too, where either direction of the axis will do."""
    R = Rotation.from_rotvec(angle_rad * np.array(axis) / np.linalg.norm(axis)).as_matrix()
    vector = _rotation_vector(R)
    assert Rotation.from_rotvec(vector).as_matrix() == pytest.approx(R, abs=1e-9)
    assert np.linalg.norm(vector) == pytest.approx(angle_rad, abs=1e-9)


def test_many_matrices_are_those_of_each() -> None:
    poses = np.random.default_rng(0).normal(size=(9, 6))
    poses[3, 3:] = 0.0
    poses[4, 3:] *= np.pi / np.linalg.norm(poses[4, 3:])
    each = [matrix_of(pose) for pose in poses]
    assert matrices_of(poses) == pytest.approx(np.array(each), abs=1e-14)


def test_out_of_reach_is_named() -> None:
    far = UR5E.forward(READY)
    far[:3, 3] = [1.5, 0.0, 0.2]
    with pytest.raises(OutOfReachError, match=r"UR5e does not reach x = 1.5000"):
        UR5E.inverse(far, READY)


def test_poses_and_matrices_agree_with_scipy() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        vector = rng.normal(size=3)
        vector *= rng.uniform(0.0, np.pi) / np.linalg.norm(vector)
        pose = np.concatenate([rng.normal(size=3), vector])
        X = matrix_of(pose)
        assert X[:3, :3] == pytest.approx(Rotation.from_rotvec(vector).as_matrix())
        assert pose_of(X) == pytest.approx(pose, abs=1e-7)


BENT = np.array([0.1, -1.2, 1.3, -0.4, 0.5, 0.6])


def to_and_fro(rest_s: float, lasts_s: float) -> tuple[Trajectory, PlaneMount]:
    """0.1 m up and back, after a rest; in a plane through the gripper at rest."""
    X = UR5E.forward(BENT)
    mount = PlaneMount(*(tuple(X[:3, k].tolist()) for k in (3, 0, 1)))
    t_s = np.arange(0.0, lasts_s, 0.002)
    y_m = 0.05 * (1.0 - np.cos(2.0 * np.pi * t_s / lasts_s))
    t_s, y_m = np.append(0.0, rest_s + t_s), np.append(0.0, y_m)
    return Trajectory(t_s, 0.0 * y_m, y_m, 0.0 * y_m), mount


@pytest.mark.parametrize("rest_s", [0.01, 10.0, 100.0])
def test_a_rest_in_a_path_hides_no_fast_joint(rest_s) -> None:
    path, mount = to_and_fro(rest_s, 2.0)
    check_reach(path, BENT, UR5E, np.eye(4), mount)
    path, mount = to_and_fro(rest_s, 0.1)
    with pytest.raises(LimitError, match=r"a joint turns at .* rad/s, allowed 3.14"):
        check_reach(path, BENT, UR5E, np.eye(4), mount)
