"""A study from which nothing can be learned is refused, with what to do."""

import numpy as np
import pytest

from cell.cable.geometry import Cable, Motion
from cell.files.input_error import InputError
from cell.lab.data.opened_study import open_study
from cell.study.data import Markers, Study, Trial
from cell.study.folder import write_study


def test_a_hand_that_never_moves_is_told_so_whatever_the_noise_looks_like(tmp_path):
    """It was said that the record ends 0.000 s after the motion begins, and of some trials none."""
    t_s = np.arange(0.0, 1.4, 0.01)
    still = Motion(t_s, *(np.zeros_like(t_s) for _ in range(3)))
    trials = []
    for seed in range(3):
        noise_m = np.random.default_rng(seed).normal(0.0, 1e-4, (len(t_s), 1, 2))
        seen = Markers(t_s, np.array([-0.09, -0.04]) + noise_m)
        trials.append(Trial(f"rest_{seed}", "fit", "equilibrium", still, seen))
    study = Study("rests", Cable(0.1, 0.0074, 0.016, 1e-4), np.array([0.1]), tuple(trials))
    write_study(study, tmp_path)
    with pytest.raises(InputError) as caught:
        open_study(tmp_path)
    assert len(caught.value.problems) == 3
    for problem in caught.value.problems:
        assert "140 rows in which the gripper moves by less than 0.1 mm" in str(problem)
        assert "give `start: held` with release_s" in str(problem)
