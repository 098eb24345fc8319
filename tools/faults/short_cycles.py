"""The shipped emulated cell, at its own addresses, with the shortest possible cycles."""

from __future__ import annotations

from pathlib import Path

import yaml

CONFIG = Path(__file__).parents[2] / "config" / "emulated.yaml"


def short_cycles(
    folder: Path, host: str, reply_s: float, *, own_patience: bool, **motion_s: float
) -> Path:
    """Settings in `folder`.

    host              address of the emulated arm and camera
    reply_s           time limit for the gripper
    own_patience      use the emulated cell's time limit for the camera, not that of a real driver
    motion_s          entries of `motion`
    """
    content = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))
    content["arm"]["host"] = host
    camera = content["camera"]
    camera.update(device=f"tcp://{host}:5600", width_px=640, height_px=512, frame_rate_hz=50.0)
    camera["view"] = {"metres_per_pixel": 0.0004, "origin_column_px": 500, "origin_row_px": 75}
    if not own_patience:
        camera.pop("lost_after_s")
    content["gripper"].update(port=str(folder / "gripper"), reply_s=reply_s)
    content["motion"].update(motion_s)
    content["motion"]["offsets"]["step_m"] = 0.002
    path = folder / "short.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path
