"""What is written into pictures is where, and as large, as it says."""

import numpy as np
import pytest

from cell.vision.annotation import (
    DESTINATION,
    SEEN,
    WHITE,
    difference_inset,
    legend,
    line,
    overlay,
    scale_bar,
)
from cell.vision.detect import VisionOptions, detect

SCALE = 0.0002


def blank(width=1280, height=1024):
    return np.full((height, width, 3), 90, np.uint8)


@pytest.mark.parametrize(("width", "metres_per_pixel"), [(1280, SCALE), (640, 4e-4), (2048, 1e-5)])
def test_the_scale_bar_is_as_long_as_a_round_length(width, metres_per_pixel) -> None:
    picture = blank(width)
    scale_bar(picture, metres_per_pixel)
    row = picture.shape[0] - round(24 * width / 1280)
    white = np.flatnonzero((picture[row - 1 : row + 2] > 240).all(axis=2).any(axis=0))
    length_m = (white.max() - white.min()) * metres_per_pixel
    nearest = min((1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.05, 0.1), key=lambda b: abs(b - length_m))
    assert length_m == pytest.approx(nearest, abs=4 * metres_per_pixel)
    assert 0.1 < length_m / metres_per_pixel / width < 0.4


def test_the_legend_has_every_colour_at_the_bottom_left() -> None:
    picture = blank()
    legend(picture, [("seen", SEEN), ("destination", DESTINATION)])
    corner = picture[900:, :200].reshape(-1, 3)
    for colour in (SEEN, DESTINATION):
        assert (np.abs(corner.astype(int) - colour).max(axis=1) < 10).sum() > 50


def test_differences_are_magnified_by_what_the_words_say() -> None:
    """0.12 mm is 0.6 px, and with x100 lies 60 px from the middle of the inset."""
    picture = blank()
    predicted = np.zeros((3, 2))
    seen = np.array([[1.2e-4, 0.0], [0.0, 6e-5], [np.nan, np.nan]])
    assert difference_inset(picture, seen, predicted, SCALE) == pytest.approx(1.2e-4)
    centre = np.array([1280 - 16 - 90, 16 + 90])
    for step in ((60, 0), (0, -30)):  # y is up in the plane
        column, row = centre + step
        assert np.abs(picture[row, column].astype(int) - SEEN).max() < 30
    around = picture[centre[1] + 55 : centre[1] + 66, centre[0]]
    assert np.abs(around.astype(int) - WHITE).max(axis=1).min() < 60, "circle of the largest"


def test_without_a_known_difference_nothing_is_drawn() -> None:
    picture = blank()
    assert np.isnan(difference_inset(picture, np.full((2, 2), np.nan), np.zeros((2, 2)), SCALE))
    assert (picture == 90).all()


def test_points_that_are_not_known_are_left_out_of_a_line() -> None:
    picture = blank()
    line(picture, np.array([[10.0, 10.0], [np.nan, 5.0], [60.0, 10.0]]), SEEN)
    assert (np.abs(picture[10, 12:58].astype(int) - SEEN) < 20).all()


def test_nodes_and_prediction_are_drawn_where_they_are(view, make_cable, photograph_of):
    held = make_cable((0.05, 0.03, 0.1), lambda u: 10.0 * (1.0 - u))
    image = photograph_of(held)
    sighting = detect(image, 0.25, view, VisionOptions(free_length_m=0.1))
    before = image.copy()
    predicted = sighting.nodes_m + np.array([0.0, 0.01])
    picture = overlay(image, sighting, view, predicted)
    assert picture.shape == (*image.shape, 3)
    assert picture.dtype == np.uint8
    assert np.array_equal(image, before)
    for nodes, channel in ((sighting.nodes_m, 1), (predicted, 2)):
        column, row = np.rint(view.to_pixels(0.5 * (nodes[4] + nodes[5]))).astype(int)
        patch = picture[row - 2 : row + 3, column - 2 : column + 3].astype(int)
        assert (patch[..., channel] - patch[..., 0]).max() > 60


def test_a_reason_is_written_where_nothing_was_seen(view):
    image = np.zeros((1024, 1280), np.uint8)
    sighting = detect(image, 0.0, view, VisionOptions(free_length_m=0.1))
    picture = overlay(image, sighting, view)
    assert picture[:50].max() > 200
    assert picture[60:].max() == 0
