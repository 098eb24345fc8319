"""Exported chains in MuJoCo beside the project's engine."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cell.cable.effects import Effect, Parameter, library, unscreened
from cell.cable.effects.air import AIR_DENSITY_KG_PER_M3
from cell.cable.geometry import Connector
from cell.exchange.chain import (
    TIP_ERROR_M,
    chain_of,
    expressible,
    law,
    physical,
    resting_bends,
    springs_for,
)
from cell.exchange.description import description
from cell.exchange.export import SHARE, export_parts, export_to_mujoco
from cell.exchange.mjcf import HAND, mjcf
from cell.exchange.peer import BAR_M, Reference, compare, difference, engine_tip, stroke

mujoco = pytest.importorskip("mujoco")


@pytest.mark.parametrize(("seed", "exponent"), [*enumerate(np.linspace(0.9, 1.15, 10))])
def test_cables_of_every_exponent_keep_the_bar(flat_model, seed, exponent):
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


EXPRESSED = {
    *("air_drag", "stress_relaxation", "natural_curvature", "rest_shape"),
    *("tip_mass", "grip_angle", "grip_compliance", "grip_slip", "added_mass"),
}
ALL = library() | unscreened()


@pytest.mark.parametrize("name", sorted(ALL))
def test_every_effect_is_expressed_or_left_out_with_a_reason(flat_model, name):
    model = replace(flat_model().model, effects=(ALL[name].active(),))
    kept, left = expressible(model)
    assert [a.effect.name for a in kept.effects] == [name] * (name in EXPRESSED)
    assert [one.name for one in left] == [name] * (name not in EXPRESSED)
    assert all(one.reason for one in left)


def test_inertia_across_alone_is_left_out(flat_model):
    across = ALL["added_mass"].active(kg_per_m=1e-4, along=0.0)
    _, left = expressible(replace(flat_model().model, effects=(across,)))
    assert "across" in left[0].reason


def test_a_users_own_inertia_that_differs_across_is_left_out(flat_model):
    class Fins(Effect):
        name = "fins"
        parameters = (Parameter("kg_per_m", "kg/m", 0.0, 1.0, 0.0, (1e-4,)),)

        @staticmethod
        def inertia(cable, arc_length, p):
            return 0.0, p.kg_per_m * (arc_length > 0.05)

    _, left = expressible(replace(flat_model().model, effects=(Fins.active(kg_per_m=1e-4),)))
    assert "across" in left[0].reason


def test_a_users_own_effect_counts_by_its_hooks(flat_model):
    class Sticker(Effect):
        name = "sticker"
        parameters = (Parameter("mass_kg", "kg", 0.0, 1.0, 0.0, (1e-5,)),)

        @staticmethod
        def tip_mass(cable, p):
            return p.mass_kg

    model = replace(flat_model().model, effects=(Sticker.active(mass_kg=2e-5),))
    kept, left = expressible(model)
    assert kept.effects == model.effects
    assert left == ()


def test_only_the_cameras_effects_are_unseen(flat_model):
    effects = tuple(ALL[n].active() for n in ("camera_latency", "bending_hysteresis"))
    seen = physical(replace(flat_model().model, effects=effects))
    assert [a.effect.name for a in seen.effects] == ["bending_hysteresis"]


LENGTH_M = 0.1


def test_linear_law_is_one_linear_spring():
    springs = springs_for(1.0, LENGTH_M)
    assert springs.linear.tolist() == [1.0]
    assert springs.cubic_m2.tolist() == [0.0]


@pytest.mark.parametrize("exponent", [0.8, 0.9, 0.97, 1.05, 1.15, 1.3])
def test_springs_follow_the_law(exponent):
    springs = springs_for(exponent, LENGTH_M)
    k = np.linspace(-np.pi / LENGTH_M, np.pi / LENGTH_M, 4001)
    secant = law(k, exponent) / np.where(k == 0.0, 1.0, k)
    error = (springs(k) - law(k, exponent)) / np.where(k == 0.0, 1.0, secant)
    # uniform bending by the error moves a tip by error · L²/2
    assert np.sqrt(np.mean(error**2)) * LENGTH_M**2 / 2 < TIP_ERROR_M
    assert np.allclose(springs(-k), -springs(k), atol=1e-12)


@pytest.mark.parametrize("exponent", [0.8, 1.3])
def test_springs_are_linear_and_stiff_beyond_their_range(exponent):
    springs = springs_for(exponent, LENGTH_M)
    far = springs(springs.range_1_per_m * np.array([2.0, 3.0, 4.0, 10.0]))
    slopes = np.diff(far) / (springs.range_1_per_m * np.array([1.0, 1.0, 6.0]))
    assert np.allclose(slopes, slopes[0], rtol=1e-6)
    assert slopes[0] > 0.2


def test_a_reader_can_compute_the_moment_from_it_alone(flat_model):
    model = flat_model(2, 0.93, air_drag={"drag_coefficient": 2.0})
    data = json.loads(json.dumps(description(model), allow_nan=False))
    assert data["format"] == "cable-model/1"
    bending = data["bending"]
    assert bending["rigidity_n_m2"] == pytest.approx(model.values[:6].tolist())
    assert bending["arc_length_m"] == pytest.approx(np.linspace(0.0, 0.1, 6).tolist())
    k, ke, ref = 4.0, bending["k_e_1_per_m"], bending["k_ref_1_per_m"]
    power = (bending["exponent"] - 1.0) / 2.0
    moment = bending["rigidity_n_m2"][0] * k * ((k**2 + ke**2) / ref**2) ** power
    assert moment == pytest.approx(model.values[0] * 4.0 * (16.01 / 100.0) ** -0.035, rel=1e-9)


def test_effects_and_covariance_have_names_units_and_laws(flat_model):
    model = flat_model(2, air_drag={"drag_coefficient": 2.0}, tip_mass={"mass_kg": 1e-5})
    data = description(model)
    drag, tip = data["effects"]
    assert drag["parameters"][0]["value"] == pytest.approx(2.0)
    assert "v_n" in drag["law"]
    assert tip["parameters"][0]["unit"] == "kg"
    covariance = data["covariance"]
    assert covariance["names"] == list(model.space.names)
    assert covariance["coordinates"][0] == "natural logarithm"
    assert covariance["coordinates"][-1] == "as it is, kg"
    assert np.shape(covariance["matrix"]) == (len(model.mean),) * 2
    low, high = model.interval()
    assert data["bending"]["exponent_interval"] == [low[6], high[6]]
