"""How long after a film its recording is on the disk, and what handing a frame over costs.

200 frames of 1280 × 1024 with a camera's noise come at 200 a second, poses at 500 Hz, as in a hold.

    python -m tools.bench.bench_recording --films 5 --burn
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cell.records.recording import form
from cell.records.recording.reading import read_recording
from cell.records.recording.recorder import Recorder
from drivers.clock import RealClock, sleep_until
from drivers.interfaces import Frame, Trajectory

FRAMES, RATE_HZ, SHAPE = 200, 200.0, (1024, 1280)


class StillArm:
    """Measured poses of an arm at rest, 500 in a second."""

    name = "arm"

    def log(self, start_s: float, end_s: float) -> Trajectory:
        t_s = np.arange(np.ceil(start_s * 500), np.floor(end_s * 500) + 1) / 500
        return Trajectory(t_s, np.zeros(len(t_s)), np.ones(len(t_s)), np.zeros(len(t_s)))


@dataclass(frozen=True)
class Film:
    """One film.

    on_disk_s   from the last frame until every byte was in the file
    closed_s    from the last frame until the file was closed, read back and verified
    hand_over_ms   time that handing over a frame took: median and 99 % quantile
    cpu_share   of a core that the cell's process needed for it
    """

    on_disk_s: float
    closed_s: float
    hand_over_ms: tuple[float, float]
    cpu_share: float
    megabytes: float


def pictures() -> list[np.ndarray]:
    """Ten frames: a bright screen with a camera's noise."""
    rng = np.random.default_rng(1)
    return [np.clip(rng.normal(180.0, 3.7, SHAPE), 0, 255).astype(np.uint8) for _ in range(10)]


def film(recorder: Recorder, folder: Path, images: list[np.ndarray]) -> Film:
    recorder.begin(folder / form.FILE, {})
    costs_s, begun_s, cpu_s = [], time.monotonic(), time.process_time()
    for index in range(FRAMES):
        sleep_until(begun_s + index / RATE_HZ)
        before_s = time.perf_counter()
        recorder.frame(Frame(index, time.monotonic(), images[index % len(images)]))
        costs_s.append(time.perf_counter() - before_s)
    last_s, cpu_s = time.monotonic(), time.process_time() - cpu_s
    while recorder.waiting_bytes:
        time.sleep(0.001)
    on_disk_s = time.monotonic() - last_s
    recorder.end()
    assert recorder.wait()
    closed_s = time.monotonic() - last_s
    recording = read_recording(folder)
    assert recording.count(form.IMAGE) == FRAMES, recorder.notes
    size = (folder / form.FILE).stat().st_size / 1e6
    median, most = np.quantile(costs_s, [0.5, 0.99]) * 1e3
    return Film(on_disk_s, closed_s, (float(median), float(most)), cpu_s * RATE_HZ / FRAMES, size)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--films", type=int, default=5)
    parser.add_argument("--burn", action="store_true", help="a third process burns a core")
    given = parser.parse_args(arguments)
    burner = None
    if given.burn:
        burner = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    images, films = pictures(), []
    try:
        for _ in range(given.films):
            recorder = Recorder(StillArm(), RealClock(), 512 * 10**6)  # type: ignore[arg-type]
            with tempfile.TemporaryDirectory(dir=os.environ.get("BENCH_DIR")) as folder:
                recorder.prepare()
                time.sleep(1.0)  # it has started long before a hold
                films.append(film(recorder, Path(folder), images))
                recorder.close()
            print(films[-1], flush=True)
    finally:
        if burner is not None:
            burner.kill()
            burner.wait()
    print(f"on the disk {max(f.on_disk_s for f in films):.2f} s after the last frame at most")


if __name__ == "__main__":
    main()
