import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cell.plan.destination import Destination

HOLE = Destination(x_min_m=0.0, x_max_m=0.01, y_min_m=-0.003, y_max_m=0.003)


def path(*points_mm: tuple[float, float]) -> np.ndarray:
    return np.array(points_mm) * 1e-3


@pytest.mark.parametrize(
    ("points_mm", "margin_mm"),
    [
        (((20, 0), (-5, 0)), 3.0),  # straight through the middle
        (((20, 2), (-5, 2)), 1.0),
        (((20, -4), (-5, -4)), -1.0),  # below the floor
        (((15, 0), (5, 2), (-5, 0)), 1.0),  # closest to the ceiling inside
        (((15, 9), (5, -1), (-5, -1)), -1.0),  # enters above the ceiling: y = 4 at the opening
        (((15, 0), (0.1, 0), (-5, 50)), 2.0196),  # only the part before x_min counts
        (((15, 0), (5, 0), (12, 9), (8, 2), (-5, 2)), -3.429),  # leaves upwards through ceiling
        (((15, 1), (8, 1), (20, 1), (20, -1), (-5, -1)), 2.0),  # swings back out: no wall there
        (((15, 1), (4, 1), (15, 1)), -4.0),  # 4 mm short of the full depth
        (((15, 0), (12, 0)), -2.0),  # 2 mm in front of the opening
        (((15, 7), (13, 7)), -5.0),  # 3 right of and 4 above the opening's upper edge
        (((5, 0), (-5, 0)), -5.0),  # starts behind the opening: never goes through it
    ],
)
def test_margin_by_hand(points_mm, margin_mm: float) -> None:
    assert HOLE.margin_m(path(*points_mm)) * 1e3 == pytest.approx(margin_mm, abs=0.02)


def test_margins_of_several_paths_are_those_of_each() -> None:
    paths = np.stack([path((20, 1), (-5, 1)), path((20, 5), (-5, 5))])
    np.testing.assert_allclose(HOLE.margin_m(paths), [2e-3, -2e-3])


@given(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01), st.integers(2, 40))
def test_margin_does_not_depend_on_the_sampling(y0: float, y1: float, n: int) -> None:
    coarse = np.array([[0.02, y0], [-0.01, y1]])
    part = np.linspace(0.0, 1.0, n)[:, None]
    fine = coarse[0] + part * (coarse[1] - coarse[0])
    assert HOLE.margin_m(fine) == pytest.approx(HOLE.margin_m(coarse), abs=1e-12)


def test_batches_agree_with_single_paths() -> None:
    rng = np.random.default_rng(0)
    steps = rng.normal([-0.001, 0.0], 0.001, (5, 7, 60, 2))
    paths = np.cumsum(steps, axis=2) + np.array([0.02, 0.0])
    batch = HOLE.margin_m(paths)
    assert batch.shape == (5, 7)
    single = [[HOLE.margin_m(p) for p in row] for row in paths]
    np.testing.assert_array_equal(batch, single)


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="not finite"):
        HOLE.margin_m(np.array([[0.02, 0.0], [np.nan, 0.0]]))
    with pytest.raises(ValueError, match="shape"):
        HOLE.margin_m(np.zeros((1, 2)))
    with pytest.raises(ValueError, match="x_min < x_max"):
        Destination(0.0, 0.0, -1.0, 1.0)
