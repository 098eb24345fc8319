"""Calibrations on disk: the same numbers back, and nothing that was changed or is missing."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from calib.store import CalibrationFileError, StoredCalibration, load, save

MADE = datetime(2026, 3, 14, 9, 26, 53, tzinfo=UTC)


def stored() -> StoredCalibration:
    return StoredCalibration(
        "cell",
        MADE,
        {"poses": 30},
        {"camera": "40312345", "width_px": 1280},
        {"map_95_m": np.float64(3.1e-5)},
        {
            "homography": np.array([[2e-4, 1e-9, -0.2], [0.0, -2e-4, 0.1], [0.0, 0.0, 1.0]]),
            "lag": 1,
        },
        1e-12 * np.eye(3),
    )


def test_the_same_numbers_come_back(tmp_path):
    path = tmp_path / "deep" / "cell.yaml"
    save(path, stored())
    back = load(path, "cell")
    assert np.array_equal(back.array("homography", (3, 3)), stored().result["homography"])
    assert np.array_equal(back.covariance, stored().covariance)
    assert back.number("lag") == 1.0
    assert back.devices["camera"] == "40312345"
    assert back.age_h(MADE + timedelta(days=2)) == pytest.approx(48.0)
    assert not list(path.parent.glob("*.part"))


def test_a_number_changed_by_hand_is_noticed(tmp_path):
    path = tmp_path / "cell.yaml"
    save(path, stored())
    text = path.read_text()
    path.write_text(text.replace("-0.2", "-0.21"))
    with pytest.raises(CalibrationFileError, match="hash: was changed since it was made"):
        load(path, "cell")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("cell-calibration/2", "other/1"), "format: 'other/1'"),
        (lambda text: text.replace("hash:", "hush:"), "hash: missing; run `cell calibrate cell`"),
        (lambda text: text.replace("kind: cell", "kind: camera"), "kind: 'camera'; must be 'cell'"),
        (lambda text: "[1, 2", "not YAML"),
        (lambda text: "- 1", "format: None"),
    ],
)
def test_files_that_cannot_be_used_are_named(tmp_path, change, message):
    path = tmp_path / "cell.yaml"
    save(path, stored())
    path.write_text(change(path.read_text()))
    with pytest.raises(CalibrationFileError, match=message) as error:
        load(path, "cell")
    assert str(path) in str(error.value)


def test_a_missing_file_says_what_makes_it(tmp_path):
    with pytest.raises(CalibrationFileError, match=r"No such file.*`cell calibrate time`"):
        load(tmp_path / "time.yaml", "time")


def test_results_of_another_shape_are_refused():
    with pytest.raises(CalibrationFileError, match="is no number"):
        stored().number("homography")
    with pytest.raises(CalibrationFileError, match=r"must be \(2, 2\)"):
        stored().array("homography", (2, 2))
    with pytest.raises(CalibrationFileError, match="must be"):
        stored().array("absent", (3,))
