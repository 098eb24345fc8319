"""The renderer against areas and centroids known in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.sim import render as render_module
from drivers.sim.render import LIGHT_ON_DARK, Rates, RenderOptions, render

MM_PER_PX = 0.2
HOMOGRAPHY = np.array([[2e-4, 0.0, -0.2], [0.0, -2e-4, 0.1], [0.0, 0.0, 1.0]])
PLAIN = RenderOptions(
    width_px=320,
    height_px=256,
    cable_level=0.0,
    cable_glints=0.0,
    background_level=200.0,
    illumination_drop=0.0,
    texture_level=0.0,
    bright_object=False,
    read_noise=0.0,
    shot_noise=0.0,
    lens_blur_px=0.0,
)
SMALL_VIEW = np.array([[2e-4, 0.0, -0.032], [0.0, -2e-4, 0.0256], [0.0, 0.0, 1.0]])


def darkness(image):
    """Missing light, in units of fully covered pixels."""
    return (200.0 - image.astype(float)) / 200.0


def pixels(points_m):
    return np.stack([points_m[:, 0] / 2e-4 + 160.0, 128.0 - points_m[:, 1] / 2e-4], axis=1)


@settings(max_examples=40, deadline=None)
@given(
    angle=st.floats(-3.1, 3.1),
    x=st.floats(-0.003, 0.003),
    y=st.floats(-0.003, 0.003),
    thickness=st.floats(0.5e-3, 2e-3),
)
def test_a_strip_darkens_exactly_its_area_about_its_centre(angle, x, y, thickness):
    direction = np.array([np.cos(angle), np.sin(angle)])
    line = np.array([x, y]) + np.linspace(-0.01, 0.01, 9)[:, None] * direction
    options = replace(PLAIN, thickness_m=thickness)
    image = render(line, None, SMALL_VIEW, options, np.random.default_rng(0))
    dark = darkness(image)
    area_px = (0.02 / 2e-4) * (thickness / 2e-4)
    assert dark.sum() == pytest.approx(area_px, rel=0.005)
    rows, columns = np.mgrid[:256, :320]
    centre = np.array([(dark * columns).sum(), (dark * rows).sum()]) / dark.sum()
    assert centre == pytest.approx(
        pixels(np.array([[x, y]]))[0], abs=0.13
    )  # whole pixels move it by < 1/8


def test_coverage_equals_a_finely_sampled_strip():
    half = 2.5e-4
    direction, normal = np.array([np.cos(0.3), np.sin(0.3)]), np.array([-np.sin(0.3), np.cos(0.3)])
    line = np.linspace(-0.01, 0.01, 21)[:, None] * direction
    options = replace(PLAIN, thickness_m=2 * half)
    image = render(line, None, SMALL_VIEW, options, np.random.default_rng(0))
    fine = 20
    sub = (np.arange(fine) + 0.5) / fine - 0.5
    v, u = np.mgrid[:256, :320].astype(float)
    share = np.zeros((256, 320))
    for du in sub:
        for dv in sub:
            p = np.stack([(u + du - 160.0) * 2e-4, (128.0 - v - dv) * 2e-4], axis=-1)
            share += (np.abs(p @ direction) < 0.01) & (np.abs(p @ normal) < half)
    assert np.abs(darkness(image) - share / fine**2).max() < 0.03


def test_motion_blur_spreads_the_light_and_keeps_its_amount_and_centre():
    line = np.stack([np.linspace(-0.01, 0.01, 9), np.zeros(9)], axis=1)
    speed = np.broadcast_to([0.0, 4.0], line.shape)  # 2 mm in 0.5 ms
    rng = np.random.default_rng(0)
    still = darkness(render(line, None, SMALL_VIEW, PLAIN, rng))
    swept = darkness(render(line, None, SMALL_VIEW, PLAIN, rng, rates=Rates(speed)))
    assert swept.sum() == pytest.approx(still.sum(), rel=0.03)
    rows = np.arange(256)
    profile = swept.sum(1) / swept.sum()
    assert (profile * rows).sum() == pytest.approx(128.0, abs=0.1)
    spread = np.sqrt((profile * (rows - 128.0) ** 2).sum())
    assert spread == pytest.approx(10.0 / np.sqrt(12.0), rel=0.1)  # 2 mm = 10 px, uniform


def test_what_nothing_is_drawn_over_is_not_touched(monkeypatch):
    """Only the part that cable and jaw cover is copied, and the noise is that of the whole."""
    options, drawn = replace(PLAIN, read_noise=2.0), []

    def drawn_over(self, *others):
        drawn.append(real(self, *others))
        return drawn[-1]

    real = render_module._Polygons.drawn_over
    monkeypatch.setattr(render_module._Polygons, "drawn_over", drawn_over)
    line = np.array([[-0.004, 0.0], [0.0, 0.0]])
    empty = render(None, None, SMALL_VIEW, options, np.random.default_rng(0))
    image = render(line, None, SMALL_VIEW, options, np.random.default_rng(0))
    assert drawn[0] is None
    assert drawn[1].light.size < 0.02 * image.size
    beside = np.ones(image.shape, dtype=bool)
    rows, columns = drawn[1].light.shape
    beside[drawn[1].row :, drawn[1].column :][:rows, :columns] = False
    assert np.array_equal(image[beside], empty[beside])
    assert not np.array_equal(image, empty)


def test_the_noise_has_the_stated_variance():
    options = replace(PLAIN, read_noise=1.5, shot_noise=0.02, background_level=150.0)
    rng = np.random.default_rng(3)
    one, two = (render(None, None, SMALL_VIEW, options, rng).astype(float) for _ in "ab")
    variance = np.var(one - two) / 2.0
    assert variance == pytest.approx(1.5**2 + 0.02 * 150.0 + 1.0 / 12.0, rel=0.03)


@pytest.mark.parametrize("options", [RenderOptions(), LIGHT_ON_DARK])
def test_faults_change_the_picture_as_they_say(options):
    rng = np.random.default_rng(0)
    line = np.stack([np.linspace(-0.1, 0.0, 50), np.zeros(50)], axis=1)
    grip = (0.0, 0.0, 0.0)
    quiet = replace(options, read_noise=0.0, shot_noise=0.0)

    def changed(other, grip_now=grip, **more):
        clean = render(line, grip, HOMOGRAPHY, quiet, rng)
        return np.abs(render(line, grip_now, HOMOGRAPHY, other, rng, **more).astype(float) - clean)

    row, column = 500, 1000  # the gripping point
    assert changed(quiet).max() == 0.0
    assert (
        changed(quiet, second_cable_m=line + np.array([0.0, 0.01]))[row - 50, column - 250] > 20.0
    )
    assert changed(quiet, None)[row, column + 30] > 5.0
    assert changed(replace(quiet, occluder_m=(-0.05, -0.01, -0.03, 0.01))).sum() > 1e4
    assert render(line, grip, HOMOGRAPHY, replace(options, exposure=0.0), rng).max() <= 8
    overexposed = render(line, grip, HOMOGRAPHY, replace(options, exposure=20.0), rng)
    assert (overexposed == 255).mean() > 0.5
    held, empty = (
        render(*shown, HOMOGRAPHY, quiet, rng).astype(int) for shown in ((line, grip), (None, None))
    )
    assert abs(held - empty)[row, column + 30] > 5, "jaw and cable are gone"
    assert abs(held - empty)[:100].max() <= 1, "the rest is as it was"


def test_bad_shapes_and_values_are_named():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"centreline has shape \(3,\)"):
        render(np.zeros(3), (0, 0, 0), HOMOGRAPHY, RenderOptions(), rng)
    with pytest.raises(ValueError, match="same shape"):
        line = np.zeros((4, 2))
        render(line, (0, 0, 0), HOMOGRAPHY, RenderOptions(), rng, rates=Rates(np.zeros((3, 2))))
    with pytest.raises(ValueError, match=r"render.exposure = -1.0"):
        RenderOptions(exposure=-1.0)
