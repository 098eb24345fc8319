"""The centreline of a strip in a photograph: painted ones, and the two real ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from cell.vision.photograph import PhotographOptions, StripNotFoundError, centreline

PHOTOGRAPHS = Path(__file__).parents[4] / "shared" / "data" / "real" / "cantilever_photos"
OPTIONS = PhotographOptions(metres_per_pixel=0.1101e-3)
AREAL_WEIGHT_N_PER_M2 = 13.6

real = pytest.mark.skipif(
    not PHOTOGRAPHS.is_dir(), reason="the photographs beside the project are not on this machine"
)


def grey(name):
    return cv2.imread(str(PHOTOGRAPHS / name), cv2.IMREAD_GRAYSCALE)


def peer(name):
    return np.loadtxt(PHOTOGRAPHS / name, delimiter=",", skiprows=1)


@real
def test_the_centreline_agrees_with_the_authors_own():
    line = centreline(grey("test_image.jpg"), OPTIONS)
    theirs = peer("test_image_peer_centreline.csv")
    ours = np.interp(theirs[:, 0], line.xy_m[:, 0], line.xy_m[:, 1])
    assert np.sqrt(np.mean((ours - theirs[:, 1]) ** 2)) < 0.5e-3


@real
def test_moment_and_curvature_agree_with_the_authors_own_where_it_bends():
    """Their rows carry no arc length; it is where their own centreline has that moment."""
    theirs = peer("test_image_peer_centreline.csv")
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(theirs, axis=0), axis=1))])
    mean = 0.5 * (theirs[1:, 0] + theirs[:-1, 0])
    beyond = np.append(np.cumsum((mean * np.diff(s))[::-1])[::-1], 0.0)
    moment = AREAL_WEIGHT_N_PER_M2 * (beyond - theirs[:, 0] * (s[-1] - s))
    bending = peer("test_image_peer_bending.csv")
    bending = bending[bending[:, 0] > 5.0]
    at = np.interp(-bending[:, 1], -moment, s)

    line = centreline(grey("test_image.jpg"), OPTIONS)
    ours = np.interp(at, line.arc_length_m, line.moment(AREAL_WEIGHT_N_PER_M2))
    assert ours == pytest.approx(bending[:, 1], rel=0.05)
    curvature = np.interp(at, line.arc_length_m, -line.curvature_1_per_m)
    assert curvature == pytest.approx(bending[:, 0], rel=0.25)


@real
def test_the_other_photograph_droops_as_a_clamped_strip_does():
    line = centreline(grey("example_image.jpg"), OPTIONS)
    assert line.length_m == pytest.approx(0.25, abs=0.003)
    assert line.xy_m[-1] == pytest.approx([0.227, -0.102], abs=0.002)
    bend = -line.curvature_1_per_m
    assert bend[0] > 10.0
    assert bend[:20].max() > 0.95 * bend.max()  # hardest at the clamp, where the moment is
    assert np.abs(bend[600:]).max() < 3.0


def painted(angle_rad, curvature, length_m=0.2, strip_is="light"):
    """A strip 1.2 mm thick that leaves the left edge and bends at a constant curvature."""
    s = np.linspace(0.0, length_m, 2000)
    theta = angle_rad + curvature * s
    x = (np.sin(theta) - np.sin(angle_rad)) / curvature
    y = (np.cos(theta) - np.cos(angle_rad)) / curvature
    pixels = np.stack([x, -y], axis=1) / OPTIONS.metres_per_pixel + [-0.5, 200.0]
    image = np.full((1400, 2100), 12, np.uint8)
    shifted = np.rint(16 * pixels).astype(np.int32)
    cv2.polylines(image, [shifted], False, 230, 11, cv2.LINE_AA, 4)
    noise = np.random.default_rng(0).normal(0.0, 3.0, image.shape)
    image = np.clip(image + noise, 0, 255).astype(np.uint8)
    return (255 - image if strip_is == "dark" else image), np.stack([x, y], axis=1)


@pytest.mark.parametrize("edge", ["left", "right"])
@pytest.mark.parametrize("strip_is", ["light", "dark"])
def test_a_painted_strip_is_found_with_its_curvature(edge, strip_is):
    image, truth = painted(0.1, 4.0, strip_is=strip_is)
    if edge == "right":
        image = image[:, ::-1].copy()
    line = centreline(image, replace(OPTIONS, edge=edge, strip_is=strip_is, clamp_angle_rad=0.1))
    off = np.interp(truth[:, 0], line.xy_m[:, 0], line.xy_m[:, 1]) - truth[:, 1]
    assert np.abs(off).max() < 0.1e-3
    assert line.length_m == pytest.approx(0.2, abs=1e-3)
    assert -line.curvature_1_per_m[50:-50] == pytest.approx(4.0, rel=0.1)


def test_an_unknown_clamp_angle_is_measured():
    image, _ = painted(0.25, 3.0)
    line = centreline(image, replace(OPTIONS, clamp_angle_rad=None))
    assert -line.angle_rad[0] == pytest.approx(0.25, abs=0.02)


def test_no_strip_is_named():
    rng = np.random.default_rng(0)
    empty = np.clip(rng.normal(12.0, 3.0, (600, 800)), 0, 255).astype(np.uint8)
    with pytest.raises(StripNotFoundError, match="check edge"):
        centreline(empty, OPTIONS)
    image, _ = painted(0.1, 4.0)
    with pytest.raises(StripNotFoundError):
        centreline(image, replace(OPTIONS, edge="right"))
    with pytest.raises(ValueError, match="needs \\(H, W\\) uint8"):
        centreline(image[..., None], OPTIONS)
    with pytest.raises(ValueError, match=r"metres_per_pixel = 0.0"):
        PhotographOptions(metres_per_pixel=0.0)
