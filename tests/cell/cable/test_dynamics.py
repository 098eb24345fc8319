"""The batch interface: lanes, starts, input that is refused, divergence, start-up."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from cell.cable import swing
from cell.cable.assembly import assemble
from cell.cable.branches import simulate_branches
from cell.cable.dynamics import simulate, simulate_each
from cell.cable.effects import library
from cell.cable.effects.hand import _stops
from cell.cable.geometry import Cable, Motion
from cell.cable.layout import LANES
from cell.cable.model import CableModel
from cell.cable.solver import DivergedError, Solver
from cell.cable.stepping import sample_times

TIMES = np.arange(0.0, 1.0, 0.02)


def models(cable, count):
    return [
        CableModel.uniform(cable, 3e-5 * (1 + 0.01 * k), viscosity_n_m2_s=1e-7)
        for k in range(count)
    ]


@pytest.mark.parametrize("lanes", [1, 3, 8, 9, 17, 37])
def test_a_lane_does_not_depend_on_its_neighbours(cable, arc, jerk, lanes):
    batch = models(cable, lanes)
    together = simulate(batch, jerk, TIMES, arc)
    assert together.shape == (lanes, TIMES.size, arc.size, 2)
    last = simulate(batch[-1], jerk, TIMES, arc)
    assert together[-1] == pytest.approx(last[0], abs=1e-13)


@pytest.mark.parametrize("lanes", [9, 40])
def test_threads_do_not_change_what_comes_out(cable, arc, jerk, lanes):
    batch = models(cable, lanes)
    one, three = (simulate(batch, jerk, TIMES, arc, solver=Solver(threads=n)) for n in (1, 3))
    assert one == pytest.approx(three, abs=1e-13)


def test_lanes_with_different_effects_keep_their_order(cable, arc, jerk):
    drag, mass = library()["air_drag"].active(drag_coefficient=2.0), library()["tip_mass"]
    kinds = [(), (drag,), (mass.active(mass_kg=2e-5),), (), (drag,)]
    batch = [CableModel.uniform(cable, 3e-5, viscosity_n_m2_s=1e-7, effects=k) for k in kinds]
    together = simulate(batch, jerk, TIMES, arc)
    for lane, model in enumerate(batch):
        alone = simulate(model, jerk, TIMES, arc)[0]
        assert together[lane] == pytest.approx(alone, abs=1e-13)
    assert np.abs(together[0] - together[1]).max() > 1e-4


def test_lanes_whose_hands_ring_share_what_their_log_says(cable, arc, jerk):
    """Each is as it is alone, to the last bit; the log's stops are looked for once."""
    ringing = library()["robot_ringing"]
    batch = [
        replace(m, effects=(ringing.active(amplitude_m=1e-4 * (1 + k)),))
        for k, m in enumerate(models(cable, 3))
    ]
    before = _stops.cache_info().misses
    together = simulate(batch, jerk, TIMES, arc)
    assert _stops.cache_info().misses == before + 1
    for lane, model in enumerate(batch):
        again = Motion(jerk.t_s, jerk.x_m, jerk.y_m, jerk.angle_rad)
        assert np.array_equal(together[lane], simulate(model, again, TIMES, arc)[0])


def test_one_model_many_motions(cable, arc, jerk):
    half = Motion(jerk.t_s, jerk.x_m, 0.5 * jerk.y_m, jerk.angle_rad)
    both = simulate(models(cable, 1)[0], [jerk, half], TIMES, arc)
    assert both[1] == pytest.approx(simulate(models(cable, 1)[0], half, TIMES, arc)[0], abs=1e-13)


PART_S = 0.5


def parting(jerk: Motion) -> list[Motion]:
    """The gripper's motion, then up or down or neither."""
    later = np.clip((jerk.t_s - PART_S) / 0.2, 0.0, 1.0)
    by_m = later**3 * (10 - 15 * later + 6 * later**2)
    motions = [Motion(jerk.t_s, jerk.x_m, jerk.y_m + k * by_m, jerk.angle_rad) for k in (0, 0.01)]
    return [*motions, Motion(jerk.t_s, -0.02 * by_m, jerk.y_m, 0.1 * by_m)]


@pytest.mark.parametrize(
    ("effect", "start"),
    [
        (None, 0),
        ("air_drag", 0),
        ("stress_relaxation", 0),
        ("bending_hysteresis", 0),
        ("camera_latency", 0),
        ("rolling_shutter", 0),
        ("robot_lag", 0),
        ("robot_lag", 1),  # the gripper is ahead: its motions part before those of the log
    ],
)
def test_what_motions_share_may_be_simulated_once(cable, arc, jerk, effect, start):
    kinds = ()
    if effect is not None:
        kind = library()[effect]
        starts = {p.name: p.starts[min(start, len(p.starts) - 1)] for p in kind.parameters}
        kinds = (kind.active(**starts),)
    batch = [
        CableModel.uniform(cable, rigidity, viscosity_n_m2_s=1e-7, effects=kinds)
        for rigidity in (3e-5, 4e-5)
    ]
    motions, times = parting(jerk), np.arange(PART_S, 1.0, 0.01)
    branched = simulate_branches(batch, motions, PART_S, times, arc)
    for motion, found in zip(motions, branched, strict=True):
        assert found == pytest.approx(simulate(batch, motion, times, arc), abs=1e-8)


def test_what_motions_share_is_simulated_once(cable, arc, jerk, monkeypatch):
    swung = []

    def counted(integrate, own, state, width, n, base, *others):
        swung.append(width * base.size)
        return run_engine(integrate, own, state, width, n, base, *others)

    run_engine = swing.run_engine
    monkeypatch.setattr(swing, "run_engine", counted)
    times, motions = np.arange(PART_S, 0.8, 0.01), parting(jerk) * 8
    simulate(models(cable, 1) * len(motions), motions, times, arc)
    every = sum(swung)
    swung.clear()
    simulate_branches(models(cable, 1), motions, PART_S, times, arc)
    assert sum(swung) < 0.6 * every  # 0.3 of 0.8 s by each, and 0.5 s by one vector of eight


def test_no_marker_can_be_asked_for_before_the_motions_part(cable, arc, jerk):
    with pytest.raises(ValueError, match=r"asked for at 0\.0 s: the motions part later"):
        simulate_branches(models(cable, 1), parting(jerk), PART_S, TIMES, arc)


@pytest.mark.parametrize("effect", [None, "camera_latency"])
def test_each_lane_has_its_own_motion_and_times(cable, arc, jerk, effect):
    """Among lanes that end elsewhere, and see other instants, each is as it is alone.

    Differences between lanes are the slopes of a fit: 0.1 µm between blocks stalled it.
    """
    slow = Motion(1.5 * jerk.t_s, jerk.x_m, jerk.y_m, jerk.angle_rad)
    late = () if effect is None else (library()[effect].active(delay_s=0.004),)
    batch = [replace(m, effects=late) for m in models(cable, 20)]
    motions = [jerk if k % 3 else slow for k in range(20)]
    times = [TIMES[: 20 + k] if k % 2 else TIMES[20:] + 0.003 * k for k in range(20)]
    together = simulate_each(batch, motions, times, arc)
    for k in (0, 1, 13, 19):
        alone = simulate(batch[k], motions[k], times[k], arc)[0]
        assert together[k].shape == alone.shape
        assert together[k] == pytest.approx(alone, abs=1e-12)


def test_times_are_given_for_each_lane(cable, arc, jerk):
    with pytest.raises(ValueError, match="times of 1 lanes for 2"):
        simulate_each(models(cable, 2), jerk, [TIMES], arc)


def test_starts_at_rest_and_ends_at_rest(cable, arc, jerk, at_rest):
    (model,) = models(cable, 1)
    path = simulate(model, jerk, np.array([0.0, 0.05, 30.0]), arc)[0]
    still = at_rest(model, arc)
    assert path[:2] == pytest.approx(np.stack([still, still]), abs=1e-9)
    assert path[2] == pytest.approx(still + np.array([0.0, -0.05]), abs=1e-6)


def test_straight_until_released(cable, arc):
    still = Motion(np.array([0.0, 1.0]), np.zeros(2), np.zeros(2), np.full(2, 0.1))
    xy = simulate(models(cable, 1)[0], still, TIMES, arc, start="straight", release_s=0.1)[0]
    held = -arc[:, None] * np.array([np.cos(0.1), np.sin(0.1)])
    assert xy[TIMES <= 0.1] == pytest.approx(np.broadcast_to(held, xy[TIMES <= 0.1].shape))
    assert xy[-1, -1, 1] < held[-1, 1] - 5e-3


def test_noise_of_a_robots_log_hardly_moves_the_tip(cable, arc, jerk):
    rng = np.random.default_rng(3)
    logs = [
        Motion(*(v + rng.normal(0.0, s, v.size) for v, s in zip(
            (jerk.t_s, jerk.x_m, jerk.y_m, jerk.angle_rad), (0.0, 1e-5, 1e-5, 0.0), strict=True
        )))
        for _ in range(12)
    ]  # fmt: skip
    (model,) = models(cable, 1)
    tips = simulate(model, logs, TIMES, arc)[:, :, -1]
    error = np.linalg.norm(tips - simulate(model, jerk, TIMES, arc)[0, :, -1], axis=-1)
    assert np.sqrt(np.mean(error**2)) < 1e-5
    assert error.max() < 3e-5


def test_a_bar_of_silicone(arc):
    bar = Cable(0.3, 0.963, 0.03, 0.03)
    drag = library()["air_drag"].active(drag_coefficient=2.0)
    model = CableModel.uniform(bar, 0.05, viscosity_n_m2_s=1e-4, effects=(drag,))
    still = Motion(np.array([0.0, 1.0]), np.zeros(2), np.zeros(2), np.zeros(2))
    xy = simulate(model, still, TIMES, np.array([0.3]), start="straight", release_s=0.0)
    assert np.all(np.isfinite(xy)) and xy[0, -1, 0, 1] < -0.05


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"rigidity_n_m2": np.array([3e-5, np.nan])}, r"rigidity_n_m2\[1\] = nan"),
        ({"rigidity_n_m2": np.array([0.0])}, r"rigidity_n_m2\[0\] = 0"),
        ({"rigidity_n_m2": np.array([-1e-5])}, r"rigidity_n_m2\[0\] = -1e-05"),
        ({"rigidity_n_m2": 3e-5}, r"rigidity_n_m2 has shape \(\)"),
        ({"exponent": np.nan}, "exponent = nan"),
        ({"viscosity_n_m2_s": -1.0}, "viscosity_n_m2_s = -1"),
        ({"gravity_m_per_s2": (0.0, np.inf)}, "gravity_m_per_s2"),
    ],
)
def test_bad_models_are_named(cable, change, named):
    with pytest.raises(ValueError, match=named):
        CableModel(**({"cable": cable, "rigidity_n_m2": np.array([3e-5])} | change))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"arc_length_m": np.array([0.05, 0.12])}, r"arc_length_m\[1\] = 0.12"),
        ({"arc_length_m": np.array([0.05, np.nan])}, r"arc_length_m\[1\] = nan"),
        ({"arc_length_m": np.array([0.0, 0.05, 0.04])}, r"arc_length_m\[2\] = 0.04"),
        ({"times_s": np.array([0.0, 0.0])}, "times_s"),
        ({"times_s": np.array([0.0, np.nan])}, "times_s"),
        ({"release_s": 0.1}, "release_s"),
        ({"models": []}, "0 models"),
        ({"times_s": np.array([0.0, 1e6])}, "steps"),
    ],
)
def test_bad_requests_are_named(cable, arc, jerk, change, named):
    good = {"models": models(cable, 1), "motions": jerk, "times_s": TIMES, "arc_length_m": arc}
    with pytest.raises(ValueError, match=named):
        simulate(**(good | change))


@pytest.mark.parametrize(
    "bad",
    [
        {"step_s": 0.0},
        {"step_s": 1.0},
        {"step_s": np.nan},
        {"segments": 2},
        {"damping": 2.0},
        {"threads": 0},
    ],
)
def test_absurd_solvers_are_refused(bad):
    with pytest.raises(ValueError, match=f"solver.{next(iter(bad))}"):
        Solver(**bad)


def test_divergence_is_named_and_gives_no_numbers(cable, arc, jerk):
    far_too_fast = Motion(jerk.t_s, jerk.x_m, 400.0 * jerk.y_m, jerk.angle_rad)
    batch = [CableModel.uniform(cable, ei, viscosity_n_m2_s=1e-7) for ei in (3e-5, 1e-9)]
    with pytest.raises(DivergedError, match=r"lane 1 diverged at t = .* shorter step") as caught:
        simulate(batch, [jerk, far_too_fast], TIMES, arc, solver=Solver(20, 5e-3))
    assert caught.value.lanes == (1,)


def test_lanes_that_cannot_be_simulated_cost_the_others_of_their_block_one_more_run(
    cable, arc, jerk, monkeypatch
):
    far_too_fast = Motion(jerk.t_s, jerk.x_m, 400.0 * jerk.y_m, jerk.angle_rad)
    stiff, soft = (CableModel.uniform(cable, ei, viscosity_n_m2_s=1e-7) for ei in (3e-5, 1e-9))
    batch = [stiff] * 40
    batch[3] = batch[5] = batch[30] = soft
    motions = [far_too_fast if model is soft else jerk for model in batch]
    blocks = []
    run = swing._run
    monkeypatch.setattr(
        swing, "_run", lambda block, *rest: blocks.append(block) or run(block, *rest)
    )
    solver = Solver(20, 5e-3, threads=1)
    found = simulate_each(batch, motions, [TIMES] * 40, arc, solver=solver)
    assert all(
        np.isnan(points).all() == (m is soft) for points, m in zip(found, batch, strict=True)
    )
    right = simulate(stiff, jerk, TIMES, arc, solver=solver)[0]
    np.testing.assert_array_equal(
        [p for p, m in zip(found, batch, strict=True) if m is stiff], 37 * [right]
    )
    again = sum(len(block.lanes) for block in blocks) - 40
    assert 0 < again <= 2 * LANES


def test_a_second_process_starts_in_under_three_seconds(cable, arc, jerk, tmp_path):
    simulate(models(cable, 1), jerk, TIMES, arc)
    program = (
        "import time; t = time.perf_counter()\n"
        "import numpy as np\n"
        "from cell.cable.dynamics import simulate\n"
        "from cell.cable.geometry import Cable, Motion\n"
        "from cell.cable.model import CableModel\n"
        "z = np.zeros(3)\n"
        "m = CableModel.uniform(Cable(0.1, 0.0074, 0.016, 1e-4), 3e-5)\n"
        "simulate(m, Motion(np.arange(3.0), z, z, z), np.array([0.0, 0.1]), np.array([0.1]))\n"
        "from cell.cable.stepping import integrate\n"
        "print(time.process_time(), sum(integrate.stats.cache_misses.values()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    seconds, compiled = done.stdout.split()
    assert compiled == "0"
    assert float(seconds) < 3.0


def test_every_lane_is_recorded_at_its_own_times_only():
    """All lanes of a block were recorded at the times of each: nine trials cost nine times that."""
    early, late = np.array([-0.5, 0.0, 0.5, 2.0]), np.array([1.0, 2.0])
    table = sample_times([early, early, late])
    assert table[:, 0].tolist() == [0.5, 1.0, 2.0, 2.0]
    assert table[:, 1:3].tolist() == [[0, 2], [2, 3], [0, 2], [2, 3]]
    assert table[:, 3].tolist() == [2, 0, 3, 1]


def test_models_that_differ_in_what_no_step_calls_share_a_block(cable, arc, jerk):
    """Each effect had a block of its own, of a vector that was mostly empty."""
    kinds = library()
    names = ("tip_mass", "grip_angle", "natural_curvature", "camera_scale", "grip_compliance")
    batch = []
    for name in names:
        values = {p.name: p.starts[0] for p in kinds[name].parameters}
        batch.append(
            CableModel.uniform(cable, 3e-5, 1.1, 1e-7, effects=(kinds[name].active(**values),))
        )
    drag = kinds["air_drag"].active(drag_coefficient=2.0)
    batch.append(CableModel.uniform(cable, 3e-5, 1.1, 1e-7, effects=(drag, *batch[0].effects)))
    batch.append(CableModel.uniform(cable, 3e-5, 1.1, 1e-7, effects=(*batch[1].effects, drag)))
    assert [len(b.lanes) for b in assemble(batch, 8, 0.0)] == [5, 2]
    together = simulate(batch, jerk, TIMES, arc)
    for model, found in zip(batch, together, strict=True):
        np.testing.assert_allclose(found, simulate(model, jerk, TIMES, arc)[0], atol=1e-12)


def test_a_lane_whose_cable_slipped_out_of_the_jaws_does_not_spoil_the_others(arc, jerk):
    """A fit may look as far as the bounds of a slip, which are as long as a short cable."""
    short, slip = Cable(0.05, 0.0074, 0.016, 1e-4), library()["grip_slip"]
    models = [
        CableModel.uniform(short, 1e-5, 1.0, 1e-7, effects=(slip.active(length_m=slipped_m),))
        for slipped_m in (0.001, -0.05, 0.0)
    ]
    times = [np.linspace(0.0, 0.2, 11)] * 3
    nodes = arc / 0.1 * 0.05
    held, out, also = simulate_each(models, jerk, times, nodes)
    assert np.isnan(out).all()
    alone = simulate_each(models[::2], jerk, times[:2], nodes)
    np.testing.assert_array_equal([held, also], alone)
    with pytest.raises(ValueError, match="less than a tenth of the cable"):
        simulate(models, jerk, times[0], nodes)
