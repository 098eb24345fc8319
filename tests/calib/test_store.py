"""Calibration files: what is written is read, and every mistake is named."""

from __future__ import annotations

from datetime import date

import numpy as np
import pytest

from calib.plane import PlaneView
from calib.store import Calibration, CalibrationError, load_calibration, save_calibration

GOOD = """\
format: cell-calibration/1
date: 2025-03-14
camera:
  metres_per_pixel: 2.0e-4
  origin_column_px: 640
  origin_row_px: 512
  latency_s: 0.004
  rms_error_m: 3.0e-5
"""


def written(tmp_path, text):
    path = tmp_path / "camera.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_what_is_saved_is_loaded(tmp_path):
    h = np.array([[2.0e-4, 1.0e-5, -0.13], [8.0e-6, -2.1e-4, 0.105], [3.0e-5, -4.0e-5, 1.0]])
    saved = Calibration(PlaneView(h), 0.0123, date(2025, 3, 14), 2.5e-5)
    save_calibration(tmp_path / "c.yaml", saved)
    loaded = load_calibration(tmp_path / "c.yaml")
    assert np.array_equal(loaded.view.homography, h)
    assert (loaded.latency_s, loaded.date, loaded.rms_error_m) == (0.0123, saved.date, 2.5e-5)


def test_a_scale_and_an_origin_are_enough(tmp_path):
    view = load_calibration(written(tmp_path, GOOD)).view
    assert view.to_plane(np.array([645.0, 502.0])) == pytest.approx([1e-3, 2e-3])


def test_an_error_never_measured_is_nan_and_survives(tmp_path):
    path = written(tmp_path, GOOD.replace("  rms_error_m: 3.0e-5\n", ""))
    calibration = load_calibration(path)
    assert np.isnan(calibration.rms_error_m)
    save_calibration(path, calibration)
    assert np.isnan(load_calibration(path).rms_error_m)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("cell-calibration/1", "other/2", "format: 'other/2'; must be 'cell-calibration/1'"),
        ("2025-03-14", "last week", "date: 'last week'; must be like 2025-03-14"),
        ("2.0e-4", "2e-4", "camera.metres_per_pixel: '2e-4' is not a number; write 1.0e-4"),
        ("2.0e-4", "-2.0e-4", "camera.metres_per_pixel: -0.0002; must be > 0"),
        ("latency_s", "latency_ms", "camera: unknown key 'latency_ms'; known are homography"),
        ("0.004", ".inf", "camera.latency_s: inf is not finite"),
        ("3.0e-5", "-1.0", "camera.rms_error_m: -1.0; must be ≥ 0"),
        ("  origin_row_px: 512\n", "", "needs homography, or origin_row_px as well"),
        ("camera:", "camera: [1]\nx:", "unknown key 'x'"),
        (
            "metres_per_pixel: 2.0e-4",
            "homography: [[1,0,0],[0,1,0],[0,0,1]]",
            "both homography and origin_column_px; keep one",
        ),
        (GOOD, "a: [", "not YAML"),
        (GOOD, "- 1", "must be a mapping with camera, date, format"),
    ],
)
def test_every_mistake_is_named(tmp_path, old, new, message):
    with pytest.raises(CalibrationError) as caught:
        load_calibration(written(tmp_path, GOOD.replace(old, new)))
    assert "camera.yaml" in str(caught.value)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("[[1,0,0],[0,1,0]]", "must be 3 rows of 3"),
        ("[[1,0,0],[2,0,0],[0,0,1]]", "cannot be inverted"),
        ("[[1,0,0],[0,x,0],[0,0,1]]", "camera.homography[1][1]: 'x' is not a number"),
    ],
)
def test_a_useless_homography_is_named(tmp_path, rows, message):
    head = "format: cell-calibration/1\ndate: 2025-03-14\ncamera:\n"
    with pytest.raises(CalibrationError) as caught:
        load_calibration(written(tmp_path, f"{head}  homography: {rows}\n"))
    assert message in str(caught.value)


def test_a_missing_file_says_what_to_do(tmp_path):
    with pytest.raises(CalibrationError, match="calibrate the camera first"):
        load_calibration(tmp_path / "none.yaml")
