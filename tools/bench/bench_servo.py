"""Servo loop of the arm's driver at 500 Hz with vision running: measured where commands arrive.

The shipped emulated cell: real RTDE client, rendered pictures of a swinging cable as a stream, and
the cable detected in each of them by the process that also commands the arm.

    python -m tools.bench.bench_servo --pairs 4 [--what plant] [--seconds 15] [--burn 1]

With --pairs it is measured without and with a recording, alternately.  With `--what plant` it is
without and with a plant: OPC UA with five clients that subscribe every 100 ms, MQTT with a broker,
and a link that sends them the notices of a cell; `--what pages` adds the pages, with five viewers.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.plane import PlaneView
from cell.computer.abilities import StallProbe, Stalls
from cell.records.recording import form
from cell.records.recording.devices import recorded_devices
from cell.records.recording.recorder import Recorder
from cell.run.warm_up import warm_up_vision
from cell.settings import load_settings
from cell.settings.translate import vision_of
from cell.vision.detect import VisionOptions, detect
from cell.vision.sighting import Sighting
from cell.wiring.build import real_devices
from cell.wiring.emulated import EmulatedCell
from drivers.interfaces import Camera, DeviceError, Trajectory
from tools.plant.around import Plant, published
from tools.processes import busy_cores
from tools.shipped_settings import EMULATED, with_entries

HOST = "127.0.0.76"
PORTION = 300  # frames recorded at a time
#: Adapters of a plant by `--what`, and number of viewers of the live page.
PLANTS = {"plant": (("opcua", "mqtt"), 0), "pages": (("opcua", "mqtt", "serve"), 5)}
STROKE_M, SWING_S = 0.03, 1.5


@dataclass(frozen=True)
class Servo:
    """Times between two commands at the controller, s, and frames processed in that time.

    cpu_s     of this process: arm, camera and vision
    troubles  messages of the camera when it fell behind and was connected again
    stalls    of this computer in the same time
    """

    gaps_s: np.ndarray
    frames: int
    unseen: int
    seconds: float
    cpu_s: float
    troubles: tuple[str, ...]
    stalls: Stalls

    def percentile_ms(self, q: float) -> float:
        return 1e3 * float(np.percentile(self.gaps_s, q))


def up_and_down(seconds: float, rate_hz: float) -> Trajectory:
    """Path down and up repeatedly, from rest to rest."""
    t_s = np.arange(0.0, seconds, 1.0 / rate_hz)
    fade = np.clip(np.minimum(t_s, t_s[-1] - t_s) / SWING_S, 0.0, 1.0)
    fade = fade**3 * (10.0 - 15.0 * fade + 6.0 * fade * fade)
    y_m = -0.5 * STROKE_M * (1.0 - np.cos(2.0 * np.pi * t_s / SWING_S)) * fade
    return Trajectory(t_s, 0.0 * t_s, y_m, 0.0 * t_s)


class _Watcher:
    """Detects the cable in the camera's frames; connects a camera again that falls behind."""

    def __init__(self, camera: Camera, plane: PlaneView, options: VisionOptions) -> None:
        self._camera, self._plane, self._options = camera, plane, options
        self._previous: Sighting | None = None
        self.frames = self.unseen = 0
        self.troubles: list[str] = []

    def watch(self, until_s: float) -> None:
        connected = False
        while time.monotonic() < until_s:
            try:
                if not connected:
                    self._camera.connect()
                    connected = True
                self._portion(until_s)
            except DeviceError as error:
                self.troubles.append(str(error))
                self._camera.close()
                connected = False

    def _portion(self, until_s: float) -> None:
        self._camera.start(PORTION)
        while (frame := self._camera.read()) is not None:
            self._previous = detect(
                frame.image, frame.t_s, self._plane, self._options, self._previous
            )
            self.frames += 1
            self.unseen += not self._previous.seen
            if time.monotonic() > until_s:
                self._camera.stop()


def servo(seconds: float, what: str = "") -> Servo:
    """Measure it; `what` is "" or as in the command line."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as around:
        around_it = None
        if what in PLANTS:
            runs, (adapters, viewers) = Path(name) / "runs", PLANTS[what]
            around.enter_context(published(runs))
            around_it = Plant(
                Path(name) / "plant", EMULATED, runs, adapters=adapters, clients=5, viewers=viewers
            )
            around.enter_context(around_it)
        changes = {"arm.host": HOST, "camera.device": f"tcp://{HOST}:5600"}
        changes["gripper.port"] = str(Path(name) / "gripper")
        config = Path(name) / "servo.yaml"
        config.write_text(with_entries(EMULATED, changes), encoding="utf-8")
        settings = load_settings(config)
        view = settings.camera.view
        plane = PlaneView.from_scale(
            view.metres_per_pixel, view.origin_column_px, view.origin_row_px
        )
        options = vision_of(settings)
        warm_up_vision(options)  # compiling on a new machine would hold everything up
        devices = real_devices(settings)
        with EmulatedCell(settings, seed=1) as emulated, StallProbe() as probe:
            recorder = Recorder(devices.arm, devices.clock, 512 * 10**6)
            if what == "recorded":
                devices = recorded_devices(devices, recorder)
                recorder.prepare()
            devices.gripper.connect()
            devices.arm.connect()
            devices.gripper.grip(settings.gripper.force_n)
            emulated.controller.request("servo_gaps")
            if what == "recorded":
                recorder.begin(Path(name) / form.FILE, {})
            watcher = _Watcher(devices.camera, plane, options)
            probe.take()
            cpu_s = time.process_time()
            others_s = {} if around_it is None else around_it.cpu_s()
            path, begin_s = up_and_down(seconds, devices.arm.rate_hz), time.monotonic() + 0.1
            devices.arm.follow(path, begin_s)
            watcher.watch(time.monotonic() + seconds)
            cpu_s = time.process_time() - cpu_s
            stalls = probe.take()
            if around_it is not None:
                spent = {k: (v - others_s[k]) / seconds for k, v in around_it.cpu_s().items()}
                print("  CPU:", ", ".join(f"{k} {v:.1%}" for k, v in spent.items()))
            gaps_s = np.array(emulated.controller.request("servo_gaps")["gaps_s"])
            recorder.close()
            devices.arm.close()
            devices.camera.close()
            devices.gripper.close()
    troubles = tuple(watcher.troubles)
    return Servo(gaps_s, watcher.frames, watcher.unseen, seconds, cpu_s, troubles, stalls)


def summary(times: Servo) -> str:
    gaps_s = times.gaps_s
    troubles = "".join(f"\n  the emulated camera fell behind: {text}" for text in times.troubles)
    return (
        f"  {len(gaps_s)} commands in {times.seconds:.0f} s, {times.frames} frames looked at "
        f"({times.unseen} without cable), load average {os.getloadavg()[0]:.1f}\n"
        f"  period median {times.percentile_ms(50.0):.2f} ms, p99 {times.percentile_ms(99.0):.2f}, "
        f"p99.9 {times.percentile_ms(99.9):.2f}, longest {times.percentile_ms(100.0):.2f}; "
        f"{np.mean(gaps_s > 0.0025):.3%} above 2.5 ms\n"
        f"  CPU time of arm, camera and vision: {times.cpu_s / times.seconds:.0%} of a core\n"
        f"  {times.stalls}{troubles}"
    )


def paired(pairs: int, seconds: float, option: str) -> None:
    """Print measurements with and without an option, in pairs of alternating order."""
    p99_ms: dict[bool, list[float]] = {False: [], True: []}
    late: dict[bool, list[float]] = {False: [], True: []}
    for pair in range(pairs):
        for done in (pair % 2 == 1, pair % 2 == 0):
            measured = servo(seconds, option if done else "")
            p99_ms[done].append(measured.percentile_ms(99.0))
            late[done].append(float(np.mean(measured.gaps_s > 0.0025)))
            print(option if done else f"not {option}", summary(measured), sep="\n", flush=True)
    ratios = np.array(p99_ms[True]) / np.array(p99_ms[False])
    print(
        f"p99 {np.median(p99_ms[True]):.2f} ms {option}, {np.median(p99_ms[False]):.2f} ms not: "
        f"ratio median {np.median(ratios):.3f}, {ratios.min():.3f} to {ratios.max():.3f}; above "
        f"2.5 ms {np.mean(late[True]):.3%} {option}, {np.mean(late[False]):.3%} not"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--pairs", type=int, default=4)
    parser.add_argument("--what", choices=("recorded", *PLANTS), default="recorded")
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--burn", type=int, default=0, help="processes that keep a core busy")
    arguments = parser.parse_args()
    with busy_cores(arguments.burn):
        paired(arguments.pairs, arguments.seconds, arguments.what)


if __name__ == "__main__":
    main()
