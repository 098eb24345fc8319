"""The shipped emulated cell, at its own addresses, with the shortest possible cycles."""

from __future__ import annotations

from pathlib import Path

from cell.files.yaml_edit import UNSET
from tools.shipped_settings import EMULATED, with_entries


def short_cycles(
    folder: Path, host: str, reply_s: float, *, own_patience: bool, **motion_s: float
) -> Path:
    """Settings in `folder`.

    host              address of the emulated arm and camera
    reply_s           time limit for the gripper
    own_patience      use the emulated cell's time limit for the camera, not that of a real driver
    motion_s          entries of `motion`
    """
    changes = {f"motion.{name}": value for name, value in motion_s.items()} | {
        "motion.offsets.step_m": 0.002,
        "arm.host": host,
        "camera.device": f"tcp://{host}:5600",
        "camera.width_px": 640,
        "camera.height_px": 512,
        "camera.frame_rate_hz": 50.0,
        "camera.view": {"metres_per_pixel": 4e-4, "origin_column_px": 500, "origin_row_px": 75},
        "gripper.port": str(folder / "gripper"),
        "gripper.reply_s": reply_s,
    }
    if not own_patience:
        changes["camera.lost_after_s"] = UNSET
    path = folder / "short.yaml"
    path.write_text(with_entries(EMULATED, changes), encoding="utf-8")
    return path
