"""Measurements of a calibration that were kept can be read again."""

from __future__ import annotations

import numpy as np
import pytest

from cell.calibration.raw import DetectedMove, read_move, save_move
from cell.files.input_error import InputError
from drivers.interfaces import Trajectory


def test_a_motion_whose_jaw_was_hidden_for_a_frame_can_be_read_again(tmp_path) -> None:
    path = Trajectory(*np.arange(12.0).reshape(4, 3))
    seen = np.array([[0.1, 0.2], [np.nan, np.nan], [0.3, 0.4]])
    move = DetectedMove(path, path, np.array([1.0, 2.0, 3.0]), seen)
    save_move(tmp_path, move)
    again = read_move(tmp_path)
    np.testing.assert_array_equal(again.detected_m, seen)
    np.testing.assert_array_equal(again.stamps_s, move.stamps_s)
    for line in ("nan,0.1,0.2", "1.0,nan,0.2", "1.0,0.1,inf"):
        (tmp_path / "seen.csv").write_text(f"stamp_s,x_m,y_m\n{line}\n")
        with pytest.raises(InputError, match=r"seen.csv:2: .*not finite"):
            read_move(tmp_path)
