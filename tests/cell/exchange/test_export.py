"""Exported chains in MuJoCo beside the project's engine."""

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.effects.air import AIR_DENSITY_KG_PER_M3
from cell.cable.geometry import Connector
from cell.exchange.chain import chain_of, resting_bends
from cell.exchange.export import SHARE, export_to_mujoco
from cell.exchange.mjcf import HAND, mjcf
from cell.exchange.peer import BAR_M, Reference, compare, difference, engine_tip, stroke
from cell.exchange.report import export_parts

mujoco = pytest.importorskip("mujoco")


@pytest.mark.parametrize("seed", range(10))
def test_ten_cables_keep_the_bar(flat_model, seed):
    exponent = float(np.linspace(0.9, 1.15, 10)[seed])
    done = export_to_mujoco(flat_model(seed, exponent).model, "model.json")
    (found,) = done.differences
    assert 0.0 < found.rms_m <= SHARE * BAR_M
    assert found.most_m <= BAR_M
    assert done.within_bar
    assert done.missing == ()


EFFECTS = {
    "air_drag": {"drag_coefficient": 5.0},
    "stress_relaxation": {"fraction": 0.3, "time_s": 0.1},
    "tip_mass": {"mass_kg": 5e-5},
    "added_mass": {"kg_per_m": 5e-4},
    "natural_curvature": {"curvature_1_per_m": 2.0, "gradient_1_per_m2": 20.0},
    "grip_angle": {"angle_rad": 0.05},
    "grip_compliance": {"rad_per_n_m": 200.0},
    "grip_slip": {"length_m": 0.002},
}


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_an_effect_that_is_expressed_acts_as_in_the_engine(flat_model, name):
    model = flat_model(3, 0.93, **{name: EFFECTS[name]}).model
    reference = Reference.of(model, stroke())
    found = compare(model, chain_of(model, 28), 2.5e-4, reference)
    assert found.rms_m < 0.04e-3
    without = engine_tip(flat_model(3, 0.93).model, stroke(), reference.times_s)
    does = difference("what it does", without, reference.tip_m)
    assert does.rms_m > 5.0 * found.rms_m


def test_a_connector_moves_as_in_the_engine(flat_model):
    """Another engine, and another description of the same body: the mass matrix is checked too."""
    bare = flat_model(3, 0.93, tip_mass={"mass_kg": 5e-5}).model
    cable = replace(bare.cable, connector=Connector(4e-4, 0.015, 2e-8))
    model = replace(bare, cable=cable, rigidity_n_m2=3.0 * bare.rigidity_n_m2)
    reference = Reference.of(model, stroke())
    found = compare(model, chain_of(model, 40), 2.5e-4, reference)
    assert found.rms_m < 0.04e-3
    straight = np.linalg.norm(reference.tip_m[0])
    assert straight < 0.115  # the connector's end is what is compared
    rod = Connector.rod(4e-4, 0.015)
    other = replace(model, cable=replace(cable, connector=rod))
    moves = difference(
        "its inertia", engine_tip(other, stroke(), reference.times_s), reference.tip_m
    )
    assert moves.rms_m > 5.0 * found.rms_m


def test_all_of_them_at_once(flat_model):
    done = export_to_mujoco(flat_model(4, 1.1, **EFFECTS).model, "model.json")
    assert done.within_bar
    assert sorted(done.effects) == sorted(EFFECTS)


def test_what_cannot_be_expressed_is_told_in_file_and_result(flat_model):
    model = flat_model(
        5, bending_hysteresis={"moment_n_m": 4e-6}, camera_latency={"delay_s": 0.005}
    ).model
    done = export_to_mujoco(model, "model.json")
    names = ["bending_hysteresis", "camera_latency"]
    assert [one.name for one in done.left_out] == names
    comment = done.xml.split("-->")[0]
    assert all(f"Left out: {name}: " in comment for name in names)
    assert [one["name"] for one in done.to_json()["left_out"]] == names
    assert done.missing[0].rms_m > 10 * done.differences[0].rms_m  # hysteresis is seen


def test_stated_links_are_taken_and_too_few_are_out_of_the_bar(flat_model):
    done = export_to_mujoco(flat_model(6).model, "model.json", links=4)
    assert done.chain.links == 4
    assert not done.within_bar
    assert done.to_json()["within_bar"] is False


def test_a_chain_that_diverges_leaves_no_log_behind(flat_model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    identified = flat_model(7)
    q = identified.mean.copy()
    q[identified.space.knots + 1] -= 8.0  # hardly damped: 1 ms is too long a step
    model = identified.space.model(q)
    found = compare(model, chain_of(model, 40), 1e-3, Reference.of(model, stroke()))
    assert found.rms_m == np.inf
    assert list(tmp_path.iterdir()) == []


def test_a_model_that_diverges_in_mujoco_is_told_and_beyond_the_bar(flat_model, monkeypatch):
    monkeypatch.setattr("cell.exchange.export.STEPS_S", (1e-3,))
    identified = flat_model(7)
    q = identified.mean.copy()
    q[identified.space.knots + 1] -= 8.0
    done = export_to_mujoco(identified.space.model(q), "model.json", links=40)
    assert not done.within_bar
    assert done.to_json()["differences"][0]["rms_m"] is None
    assert "Tip in '50 mm stroke': it diverges" in done.xml
    table, last = list(export_parts(done))[-2:]
    assert table.rows == [["50 mm stroke", "diverges", "diverges"]]
    assert "more --links" in last


def test_the_file_rests_where_it_says_and_follows_the_hand(flat_model):
    """As a user runs it, with MuJoCo alone."""
    done = export_to_mujoco(flat_model(8, 0.95).model, "model.json")
    model = mujoco.MjModel.from_xml_string(done.xml)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("rest").id)
    mujoco.mj_kinematics(model, data)
    before = data.site("tip").xpos.copy()
    for _ in range(200):
        mujoco.mj_step(model, data)
    assert np.abs(data.site("tip").xpos - before).max() < 0.1e-3
    h = model.opt.timestep

    def hand(t):
        share = np.clip((t - 0.3) / 0.3, 0.0, 1.0)
        return np.array([0.0, -0.05, 0.2]) * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)

    while data.time < 0.8:
        t = data.time
        data.ctrl[:] = (hand(t + h) - 2.0 * hand(t) + hand(t - h)) / h**2
        mujoco.mj_step(model, data)
    placed = [data.joint(name).qpos[0] for name in HAND]
    assert np.allclose(placed, [0.0, -0.05, 0.2], atol=1e-8)


def test_masses_and_air_are_those_of_the_model(flat_model):
    model = flat_model(
        9, tip_mass={"mass_kg": 5e-5}, added_mass={"kg_per_m": 5e-4},
        air_drag={"drag_coefficient": 3.0},
    ).model  # fmt: skip
    chain = chain_of(model, 12)
    compiled = mujoco.MjModel.from_xml_string(mjcf(chain, 5e-4, resting_bends(model, 12, 0.0), ()))
    strip = (0.0074 + 5e-4) * 0.1
    assert compiled.body_mass.sum() == pytest.approx(strip + 5e-5 + 1e-6, rel=1e-9)
    weight = compiled.body_mass * (1.0 - compiled.body_gravcomp)
    assert weight.sum() == pytest.approx(0.0074 * 0.1 + 5e-5 + 1e-6, rel=1e-9)
    assert compiled.opt.density == pytest.approx(3.0 * AIR_DENSITY_KG_PER_M3)
