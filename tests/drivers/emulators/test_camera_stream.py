from __future__ import annotations

import cv2
import numpy as np
import pytest

from drivers.emulators.camera_stream import picture_header, stream_header


@pytest.mark.parametrize(("width_px", "height_px"), [(160, 120), (37, 21)])
def test_what_is_written_is_read_back_bit_by_bit(tmp_path, width_px, height_px) -> None:
    rng = np.random.default_rng(1)
    images = rng.integers(0, 256, (6, height_px, width_px), dtype=np.uint8)
    stamps_s = np.array([0.0, 0.005, 0.010, 0.025, 1.0, 1.000123])
    file = tmp_path / "stream.mkv"
    with file.open("wb") as out:
        out.write(stream_header(width_px, height_px, 200.0))
        for image, stamp_s in zip(images, stamps_s, strict=True):
            out.write(picture_header(stamp_s, image.size) + image.tobytes())

    capture = cv2.VideoCapture(str(file), cv2.CAP_FFMPEG)
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(200.0)
    capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    for image, stamp_s in zip(images, stamps_s, strict=True):
        came, picture = capture.read()
        assert came
        assert np.array_equal(picture, image)
        assert 1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC) == pytest.approx(stamp_s, abs=1e-6)
    capture.release()
