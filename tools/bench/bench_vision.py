"""Frames per second of vision on one core, 1280 × 1024, over a rendered swing.

    python -m tools.bench.bench_vision [--frames 200]

Frames per second of CPU time, which other programs on this computer hardly change.  Also prints
the rms error across the cable, so that speed is not bought with it.
"""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np

from calib.plane import PlaneView
from cell.vision.detect import VisionOptions, detect, detect_all
from drivers.sim.render import Rates, RenderOptions, render


def swing(frames: int):
    """(frames, 401, 2) centrelines and (frames,) hand heights of a cable that swings."""
    s = np.linspace(0.0, 0.1, 401)
    lines, heights = [], []
    for k in range(frames):
        t = 0.005 * k
        phase = 2.0 * np.pi * 4.0 * t
        curvature = 9.0 * (1 - s / 0.1) + 5.0 * np.sin(np.pi * s / 0.1) * np.cos(phase)
        theta = np.concatenate([[0.0], np.cumsum(curvature[1:] * np.diff(s))])
        height = 0.03 - 0.05 * min(1.0, t / 0.3)
        x = 0.05 - np.concatenate([[0.0], np.cumsum(np.cos(theta[1:]) * np.diff(s))])
        y = height - np.concatenate([[0.0], np.cumsum(np.sin(theta[1:]) * np.diff(s))])
        lines.append(np.stack([x, y], axis=1)[::-1])
        heights.append(height)
    return np.array(lines), np.array(heights)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=200)
    count = parser.parse_args().frames
    cv2.setNumThreads(1)
    view = PlaneView.from_scale(2e-4, 640.0, 512.0)
    scene = RenderOptions()
    options = VisionOptions(free_length_m=0.1)
    lines, heights = swing(count)
    speeds = np.gradient(lines, 0.005, axis=0)
    rng = np.random.default_rng(0)
    images = []
    start = time.process_time()
    for line, height, speed in zip(lines, heights, speeds, strict=True):
        grip = (0.05, float(height), 0.0)
        still = (float(speed[-1, 0]), float(speed[-1, 1]), 0.0)
        images.append(render(line, grip, view.homography, scene, rng, rates=Rates(speed, still)))
    print(f"rendered     {count / (time.process_time() - start):7.0f} frames/s (first compiles)")
    times = 0.005 * np.arange(count)
    detect(images[0], 0.0, view, options)  # compile
    start = time.process_time()
    sightings = list(detect_all(zip(times, images, strict=True), view, options))
    took = time.process_time() - start
    error = [
        across(sighting.nodes_m, line)
        for sighting, line in zip(sightings, lines, strict=True)
        if sighting.seen
    ]
    rms_mm = 1e3 * float(np.sqrt(np.mean(np.square(error))))
    print(
        f"tracked      {count / took:7.0f} frames/s, {len(error)} of {count} seen, "
        f"rms across {rms_mm:.4f} mm"
    )
    start = time.process_time()
    for t_s, image in zip(times, images, strict=True):
        detect(image, t_s, view, options)
    print(f"from cold    {count / (time.process_time() - start):7.0f} frames/s")


def across(nodes: np.ndarray, line: np.ndarray) -> np.ndarray:
    tangent = np.gradient(line, axis=0)[::40]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    off = nodes - line[::40]
    return off[:, 1] * tangent[:, 0] - off[:, 0] * tangent[:, 1]


if __name__ == "__main__":
    main()
