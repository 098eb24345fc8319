from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cell.identify.golden_section import where_least


@given(place=st.floats(-1.0, 3.0), power=st.sampled_from([1.0, 2.0, 4.0]))
def test_the_minimum_is_found_within_what_is_asked_for(place: float, power: float) -> None:
    within = {1.0: 1e-9, 2.0: 1e-6, 4.0: 1e-3}[power]  # flatter: rounding hides where it is
    found = where_least(lambda x: abs(x - place) ** power, -1.0, 3.0, within)
    assert found == pytest.approx(place, abs=1.01 * within)


def test_each_step_costs_one_evaluation() -> None:
    asked: list[float] = []

    def cost(x: float) -> float:
        asked.append(x)
        return (x - 0.3) ** 2

    where_least(cost, 0.0, 1.0, 1e-5)
    assert len(asked) == 2 + 23  # 0.618²³ < 2e-5
    assert len(set(asked)) == len(asked)
