"""CPU time that a budget counts: compilation, which happens once on a computer, is none of it."""

from __future__ import annotations

import time

import numpy as np
import pytest
from numba import njit

from cell.computer.compiling import computing_s


def test_compiling_is_no_computing() -> None:
    @njit
    def least(values):  # type: ignore[no-untyped-def]
        return np.sort(values)[0]

    all_s, computed_s = time.process_time(), computing_s()
    least(np.arange(3.0))
    all_s, computed_s = time.process_time() - all_s, computing_s() - computed_s
    assert computed_s < 0.5 * all_s


def test_computing_is_counted() -> None:
    all_s, computed_s = time.process_time(), computing_s()
    while time.process_time() - all_s < 0.05:
        pass
    assert computing_s() - computed_s == pytest.approx(0.05, rel=0.5)
