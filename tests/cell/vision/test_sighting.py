"""A recording's nodes do not scatter along the cable with the tip's detection."""

from __future__ import annotations

import numpy as np

from cell.vision.sighting import Sighting, Unseen, steady_nodes, why_unseen


def sighting(length_m: float, unseen: Unseen | None = None) -> Sighting:
    """Of an arc of radius 0.1 m from the origin to the left and down, ended at `length_m`."""
    angle = np.linspace(length_m, 0.0, 11) / 0.1
    nodes = 0.1 * np.column_stack([-np.sin(angle), np.cos(angle) - 1.0])
    nodes = nodes if unseen is None else np.full_like(nodes, np.nan)
    return Sighting(0.0, nodes, np.zeros(2), 0.0, 1.0, unseen, length_m)


def test_the_scatter_of_the_tip_is_taken_out_of_all_nodes() -> None:
    scatter_m = np.random.default_rng(1).normal(scale=4e-5, size=201)
    steady = steady_nodes([sighting(0.1 + d) for d in scatter_m])
    truth = sighting(0.1 + float(np.median(scatter_m))).nodes_m
    assert np.abs(steady - truth).max() < 0.1 * np.abs(scatter_m).max()


def test_unseen_frames_stay_unseen_and_other_lengths_as_they_are() -> None:
    longer = sighting(0.101)
    steady = steady_nodes([sighting(0.1), sighting(0.1), longer, sighting(0.1, Unseen.NO_CABLE)])
    np.testing.assert_array_equal(steady[2], longer.nodes_m)
    assert np.isnan(steady[3]).all() and np.isfinite(steady[:3]).all()
    assert np.isnan(steady_nodes([sighting(0.1, Unseen.NO_CABLE)])).all()


def test_why_a_cable_was_not_seen_is_said_with_numbers() -> None:
    seen, dark = sighting(0.1), sighting(float("nan"), Unseen.EMPTY)
    longer = sighting(0.11, Unseen.WRONG_LENGTH)
    assert why_unseen([seen, seen], 0.1) == ""
    assert why_unseen([seen, dark, longer, dark], 0.1) == "empty in 2, wrong length in 1"
    assert why_unseen([longer, longer, dark], 0.1) == (
        "wrong length in 2, empty in 1; the line seen is 110.0 mm long, the cable 100.0 mm"
    )
