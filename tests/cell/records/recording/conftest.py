"""A small recording: a few frames, poses and events."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cell.records.recording import form
from cell.records.recording.writer import RecordingWriter

#: Times that no decimal fraction of few digits gives, on a clock that has run for an hour.
T_S = 3600.0 + np.sqrt(2.0) * np.arange(12) / 200.0
EPOCH_NS = 1_790_000_000 * 10**9


def picture(index: int) -> np.ndarray:
    """(48, 64) grey levels of a frame."""
    return np.random.default_rng(index).integers(0, 256, (48, 64), dtype=np.uint8)


def fill(writer: RecordingWriter) -> None:
    """Twelve frames, each with poses and now and then an event."""
    for index, t_s in enumerate(T_S.tolist()):
        writer.frame(index, t_s, 48, 64, picture(index).tobytes())
        poses = np.array([[t_s + 0.002 * k, 0.1 * k, -0.2, 0.3] for k in range(3)])
        writer.poses(form.MEASURED, poses)
        if index % 4 == 0:
            writer.event(form.STATE, t_s, {"state": "execute", "step": f"step {index}"})
        writer.flush()


@pytest.fixture
def make_recording(tmp_path: Path) -> Callable[..., Path]:
    def make(name: str = form.FILE, closed: bool = True) -> Path:
        path = tmp_path / name
        writer = RecordingWriter(path, {form.EPOCH: str(EPOCH_NS), "cycle": "7"})
        fill(writer)
        if closed:
            writer.close({"complete": "true"})
        else:
            writer.abandon()
        return path

    return make
