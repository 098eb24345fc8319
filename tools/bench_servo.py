"""Servo loop of the arm's driver at 500 Hz with vision running: measured where commands arrive.

The shipped emulated cell: real RTDE client, rendered pictures of a swinging cable as a stream, and
the cable looked for in each of them by the process that also commands the arm.
"""

from __future__ import annotations

import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from calib.plane import PlaneView
from cell.build import real_devices
from cell.run.warm_up import warm_up_eyes
from cell.settings import load_settings
from cell.settings.translate import vision_of
from cell.simulated.emulated import EmulatedCell
from cell.vision.detect import detect
from cell.vision.sighting import Sighting
from drivers.interfaces import Trajectory

CONFIG = Path(__file__).parents[1] / "config" / "emulated.yaml"
HOST = "127.0.0.76"
PORTION = 300  # frames recorded at a time
STROKE_M, SWING_S = 0.03, 1.5


@dataclass(frozen=True)
class Servo:
    """Times between two commands as the controller got them, s, and frames seen meanwhile."""

    gaps_s: np.ndarray
    frames: int
    unseen: int
    seconds: float

    def percentile_ms(self, q: float) -> float:
        return 1e3 * float(np.percentile(self.gaps_s, q))


def up_and_down(seconds: float, rate_hz: float) -> Trajectory:
    """Down and up again and again, from rest to rest."""
    t_s = np.arange(0.0, seconds, 1.0 / rate_hz)
    fade = np.clip(np.minimum(t_s, t_s[-1] - t_s) / SWING_S, 0.0, 1.0)
    fade = fade**3 * (10.0 - 15.0 * fade + 6.0 * fade * fade)
    y_m = -0.5 * STROKE_M * (1.0 - np.cos(2.0 * np.pi * t_s / SWING_S)) * fade
    return Trajectory(t_s, 0.0 * t_s, y_m, 0.0 * t_s)


def servo(seconds: float) -> Servo:
    with tempfile.TemporaryDirectory() as name:
        content = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))
        content["arm"]["host"] = HOST
        content["camera"]["device"] = f"tcp://{HOST}:5600"
        content["gripper"]["port"] = str(Path(name) / "gripper")
        path = Path(name) / "servo.yaml"
        path.write_text(yaml.safe_dump(content), encoding="utf-8")
        settings = load_settings(path)
        view = settings.camera.view
        plane = PlaneView.from_scale(
            view.metres_per_pixel, view.origin_column_px, view.origin_row_px
        )
        options = vision_of(settings)
        warm_up_eyes(options)  # compiling on a new machine would hold everything up
        devices = real_devices(settings)
        with EmulatedCell(settings, seed=1) as emulated:
            devices.gripper.connect()
            devices.camera.connect()
            devices.arm.connect()
            devices.gripper.grip(settings.gripper.force_n)
            emulated.controller.ask("servo_gaps")
            devices.arm.follow(up_and_down(seconds, devices.arm.rate_hz))
            began_s = time.monotonic()
            frames = unseen = 0
            previous: Sighting | None = None
            while time.monotonic() < began_s + seconds:
                devices.camera.start(PORTION)
                while (frame := devices.camera.read()) is not None:
                    previous = detect(frame.image, frame.t_s, plane, options, None, previous)
                    frames += 1
                    unseen += not previous.seen
                    if time.monotonic() > began_s + seconds:
                        devices.camera.stop()
            gaps_s = np.array(emulated.controller.ask("servo_gaps")["gaps_s"])
            devices.arm.close()
            devices.camera.close()
            devices.gripper.close()
    return Servo(gaps_s, frames, unseen, seconds)


def summary(found: Servo) -> str:
    gaps_s = found.gaps_s
    return (
        f"  {len(gaps_s)} commands in {found.seconds:.0f} s, {found.frames} frames looked at "
        f"({found.unseen} without cable), load average {os.getloadavg()[0]:.1f}\n"
        f"  period median {found.percentile_ms(50.0):.2f} ms, p99 {found.percentile_ms(99.0):.2f}, "
        f"p99.9 {found.percentile_ms(99.9):.2f}, longest {found.percentile_ms(100.0):.2f}; "
        f"{np.mean(gaps_s > 0.0025):.3%} above 2.5 ms"
    )
