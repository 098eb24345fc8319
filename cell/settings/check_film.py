"""Whether a cycle is filmed as its cables can be identified: frames at rest, in all, exposure."""

from __future__ import annotations

import math

from cell.files.input_error import Problem
from cell.files.words import counted
from cell.files.yaml_document import Document, Key
from cell.identify.noise import FEWEST_STILL_FRAMES
from cell.settings.model import Settings

#: Frames of a swing; one is identified from some hundred.
MAX_FRAMES = 5_000


def film_problems(document: Document, settings: Settings) -> list[Problem]:
    """What of times and frame rate lets no cable be identified, or too slowly."""
    camera, motion = settings.camera, settings.motion
    rate_hz = camera.frame_rate_hz
    problems = []
    at_rest = int(motion.still_s * rate_hz + 1e-9)
    if at_rest < FEWEST_STILL_FRAMES:
        least_s = math.ceil(100.0 * FEWEST_STILL_FRAMES / rate_hz) / 100.0
        message = (
            f"{motion.still_s:g} s at {rate_hz:g} Hz makes {counted(at_rest, 'frame')} of "
            "the cable at rest; "
            f"its noise is known from {FEWEST_STILL_FRAMES} or more, and without them every cable "
            f"is rejected: give {least_s:g} s or more"
        )
        problems.append(document.problem(("motion", "still_s"), message))
    longest_s = motion.longest_hold_s
    frames = (motion.still_s + motion.lower_s + longest_s) * rate_hz
    if frames > MAX_FRAMES:
        message = (
            f"{longest_s:g} s at {rate_hz:g} Hz makes {frames:.0f} frames of a swing, limit "
            f"{MAX_FRAMES}; hold for a shorter time or film at a lower rate"
        )
        key: Key = ("hold_s",) if motion.hold is None else ("hold", "most_s")
        problems.append(document.problem(("motion", *key), message))
    exposure_s = getattr(camera, "exposure_s", None) or 0.0
    if exposure_s > 1.0 / rate_hz:
        message = f"{exposure_s:g} s is longer than a frame at {rate_hz:g} Hz"
        problems.append(document.problem(("camera", "exposure_s"), message))
    return problems
