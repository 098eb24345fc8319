"""What explanations leave, and by how much one of them leaves less than another."""

import numpy as np
import pytest

from cell.lab.search import fitted_model
from cell.lab.search.fitted_model import vuong_z

RNG = np.random.default_rng(5)


@pytest.fixture
def compared(monkeypatch):
    """`vuong_z` of residuals given as they are, per trial (times, channels)."""

    def compare(better, worse):
        monkeypatch.setattr(fitted_model, "residuals_m", lambda _, errors: errors)
        return vuong_z(None, better, worse)

    return compare


def test_an_advantage_of_one_moment_is_worth_little_however_often_repeated(compared):
    """Released bars: 2 mm more for three frames, in each of four trials of the same motion."""
    frames = np.arange(500)
    swing = 0.3 * np.exp(-frames / 150.0) * np.sin(0.3 * frames)
    better = {f"t{i}": np.column_stack([swing, 0.2 * swing]) for i in range(4)}
    worse = {name: e + 2.0 * ((frames > 9) & (frames < 13))[:, None] for name, e in better.items()}
    assert 0.5 < compared(better, worse) < 2.0
    assert compared(worse, better) == -compared(better, worse)


def test_an_advantage_all_along_counts_as_beside_white_noise(compared):
    """Half the root of Δχ², the longer sums being a little short: 3 … 4 at Δχ² = 36."""
    frames, found = 4000, []
    for _ in range(40):
        better = {"a": RNG.standard_normal((frames, 1))}
        missed = RNG.standard_normal((frames, 1))
        missed *= 6.0 / np.sqrt(np.sum(missed**2))
        found.append(compared(better, {"a": better["a"] + missed}))
    assert 2.5 < np.median(found) < 4.5


def test_trials_of_other_lengths_and_markers_not_seen(compared):
    """What is missing in one is missing in both; nothing differs, no advantage."""
    better = {"a": np.ones((40, 2)), "b": np.ones((30, 2))}
    worse = {name: 1.1 * e for name, e in better.items()}
    worse["a"][5] = better["a"][5] = np.nan
    assert compared(better, worse) > 0.0
    assert compared(better, better) == 0.0
