"""Pictures for the record."""

from __future__ import annotations

import numpy as np

from cell.vision.detect import VisionOptions, detect
from cell.vision.overlay import overlay


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
