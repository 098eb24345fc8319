"""Nodes from rendered pictures: how exact, and what is said when there are none."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from calib.plane import PlaneView
from cell.vision.detect import VisionOptions, detect, detect_all
from cell.vision.sighting import Unseen
from drivers.sim.render import LIGHT_ON_DARK, RenderOptions

OPTIONS = VisionOptions(free_length_m=0.1)
SCENES = {
    "backlit": (RenderOptions(), OPTIONS, 0.0),
    "backlit, swinging": (RenderOptions(), OPTIONS, 0.6),
    "lit": (LIGHT_ON_DARK, replace(OPTIONS, cable_is="light"), 0.6),
    "out of focus": (RenderOptions(lens_blur_px=1.2), OPTIONS, 0.6),
    "noisy": (RenderOptions(read_noise=3.0), OPTIONS, 0.6),
}


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("scene", SCENES)
def test_nodes_are_within_a_twentieth_of_a_millimetre(
    scene, view, make_random_cable, photograph_of
):
    """Acceptance: rms error across the cable ≤ 0.05 mm at 5 px/mm with realistic noise."""
    render_options, options, swing = SCENES[scene]
    rng = np.random.default_rng(11)
    across, along, grips, angles, lengths = [], [], [], [], []
    for seed in range(20):
        held = make_random_cable(rng)
        image = photograph_of(held, render_options, seed, swing)
        sighting = detect(image, 0.1 * seed, view, options)
        assert sighting.seen, f"cable {seed}: {sighting.unseen}"
        assert sighting.t_s == 0.1 * seed
        assert sighting.quality > 0.7
        a, b = held.errors(sighting.nodes_m)
        across.append(a)
        along.append(b)
        grips.append(sighting.grip_m - held.grip[:2])
        angles.append(sighting.clamp_angle_rad - held.grip[2])
        lengths.append(sighting.length_m - held.length_m)
    assert rms(across) < 0.02e-3
    assert max(rms(a) for a in across) < 0.05e-3
    assert rms(along) < 0.12e-3
    assert rms(grips) < 0.005e-3
    assert rms(angles) < np.radians(0.01)
    assert abs(np.mean(lengths)) < 0.1e-3  # noise does not lengthen the cable


def test_a_tilted_camera_sees_the_same_nodes(make_random_cable, photograph_of):
    tilted = PlaneView(
        np.array([[2.0e-4, 1.0e-5, -0.13], [8.0e-6, -2.1e-4, 0.105], [3.0e-5, -4.0e-5, 1.0]])
    )
    rng = np.random.default_rng(2)
    for seed in range(6):
        held = make_random_cable(rng)
        image = photograph_of(held, seed=seed, sight=tilted.homography)
        sighting = detect(image, 0.0, tilted, OPTIONS)
        assert sighting.seen
        assert rms(held.errors(sighting.nodes_m)[0]) < 0.05e-3
        assert sighting.grip_m == pytest.approx(held.grip[:2], abs=0.03e-3)


FAULTS = {
    Unseen.NO_CABLE: ({"cable_m": None}, {}),
    Unseen.NO_JAW: ({"grip": None}, {}),
    Unseen.SATURATED: ({}, {"exposure": 4.0}),
    Unseen.EMPTY: ({}, {"exposure": 0.0}),
}


@pytest.mark.parametrize("reason", FAULTS)
def test_a_bad_picture_is_named_and_gives_no_nodes(reason, view, make_random_cable, photograph_of):
    faults, changes = FAULTS[reason]
    rng = np.random.default_rng(3)
    for seed in range(6):
        held = make_random_cable(rng)
        image = photograph_of(held, RenderOptions(**changes), seed, **faults)
        sighting = detect(image, 0.0, view, OPTIONS)
        assert sighting.unseen is reason
        assert np.all(np.isnan(sighting.nodes_m))
        assert sighting.nodes_m.shape == (11, 2)
        assert sighting.quality == 0.0
        assert np.isnan(sighting.clamp_angle_rad) == (reason is not Unseen.NO_CABLE)


def droop(u):
    return 10.0 * (1.0 - u) ** 2


def test_a_second_cable_in_the_jaw_or_beside_it_is_noticed(view, make_cable, photograph_of):
    grip = (0.05, 0.03, 0.1)
    held = make_cable(grip, droop)
    in_jaw = make_cable((0.05, 0.03, 0.5), droop).line_m
    beside = held.line_m + np.array([-0.01, 0.015])
    for second in (in_jaw, beside):
        image = photograph_of(held, second_cable_m=second)
        assert detect(image, 0.0, view, OPTIONS).unseen is Unseen.TWO_CABLES


def test_a_cable_that_reaches_the_edge_of_the_picture_is_not_measured(
    view, make_cable, photograph_of
):
    held = make_cable((-0.06, 0.0, 0.1), droop)
    assert detect(photograph_of(held), 0.0, view, OPTIONS).unseen is Unseen.LEAVES_PICTURE


def test_a_wrong_free_length_or_a_hidden_part_is_noticed(view, make_cable, photograph_of):
    short = make_cable((0.05, 0.03, 0.1), droop, 0.09)
    sighting = detect(photograph_of(short), 0.0, view, OPTIONS)
    assert sighting.unseen is Unseen.WRONG_LENGTH
    assert sighting.length_m == pytest.approx(0.09, abs=0.2e-3)
    held = make_cable((0.05, 0.03, 0.1), droop)
    x, y = held.line_m[160]
    hidden = RenderOptions(occluder_m=(x - 0.01, y - 0.01, x + 0.01, y + 0.01))
    assert detect(photograph_of(held, hidden), 0.0, view, OPTIONS).unseen is Unseen.WRONG_LENGTH


def test_an_earlier_sighting_changes_nothing_but_the_time_it_takes(
    view, make_random_cable, photograph_of
):
    rng = np.random.default_rng(8)
    frames = [(0.005 * k, photograph_of(make_random_cable(rng), seed=k)) for k in range(4)]
    tracked = list(detect_all(frames, view, OPTIONS))
    for (t_s, image), sighting in zip(frames, tracked, strict=True):
        alone = detect(image, t_s, view, OPTIONS)
        assert sighting.t_s == t_s
        assert sighting.nodes_m == pytest.approx(alone.nodes_m, abs=2e-6)


def test_a_picture_may_be_read_only_or_a_part_of_another(view, make_random_cable, photograph_of):
    image = photograph_of(make_random_cable(np.random.default_rng(9)))
    expected = detect(image, 0.0, view, OPTIONS)
    part = np.pad(image, 8)[8:-8, 8:-8]
    frozen = image.copy()
    frozen.setflags(write=False)
    for same in (part, frozen, np.asfortranarray(image)):
        assert detect(same, 0.0, view, OPTIONS).nodes_m.tolist() == expected.nodes_m.tolist()


def test_threads_do_not_disturb_each_other(view, make_random_cable, photograph_of):
    rng = np.random.default_rng(10)
    images = [photograph_of(make_random_cable(rng), seed=k) for k in range(6)]
    alone = [detect(image, 0.0, view, OPTIONS).nodes_m.tolist() for image in images]
    with ThreadPoolExecutor(3) as threads:
        for _ in range(5):
            found = threads.map(lambda image: detect(image, 0.0, view, OPTIONS), images)
            assert [sighting.nodes_m.tolist() for sighting in found] == alone


def test_bad_input_is_named(view):
    with pytest.raises(ValueError, match=r"image is \(4, 4, 3\) uint8"):
        detect(np.zeros((4, 4, 3), np.uint8), 0.0, view, OPTIONS)
    with pytest.raises(ValueError, match=r"image is \(0, 4\) uint8"):
        detect(np.zeros((0, 4), np.uint8), 0.0, view, OPTIONS)
    with pytest.raises(ValueError, match=r"free_length_m = 0.0"):
        VisionOptions(free_length_m=0.0)


def test_a_sighting_is_the_same_wherever_the_jaw_was_looked_for_first(
    view, make_random_cable, photograph_of
):
    """Which frame was the one before depends on the computer's load; a result must not."""
    rng = np.random.default_rng(5)
    for seed in range(8):
        image = photograph_of(make_random_cable(rng), RenderOptions(), seed, 0.6)
        alone = detect(image, 0.0, view, OPTIONS)
        for shift_m in (0.0, 0.0007, 0.003, 0.0059, 0.02):
            turn_rad = rng.normal(0.0, 0.02)
            near = replace(
                alone,
                grip_m=alone.grip_m + shift_m * rng.normal(size=2),
                clamp_angle_rad=alone.clamp_angle_rad + turn_rad,
            )
            again = detect(image, 0.0, view, OPTIONS, near)
            np.testing.assert_array_equal(again.nodes_m, alone.nodes_m)
            np.testing.assert_array_equal(again.grip_m, alone.grip_m)
            assert again.clamp_angle_rad == alone.clamp_angle_rad
