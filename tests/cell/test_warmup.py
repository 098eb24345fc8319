"""Warming up works for any cable that the settings allow, and is done once."""

from __future__ import annotations

import time

import pytest

from cell.cable.geometry import Cable
from cell.warmup import warm_up


@pytest.mark.parametrize(
    "cable", [Cable(0.1, 0.0074, 0.016, 1e-4), Cable(0.3, 0.02, 0.01, 5e-4)], ids=["paper", "long"]
)
def test_it_works_for_any_cable_and_is_done_once(cable: Cable) -> None:
    warm_up(cable)
    begun_s = time.perf_counter()
    for _ in range(100):
        warm_up(cable)
    assert time.perf_counter() - begun_s < 0.1
