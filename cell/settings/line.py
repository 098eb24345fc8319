"""Whose line it is: what a model that was learned there holds for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from calib.store import CalibrationFileError, load
from cell.settings.calibrated import calibration_file, devices_of
from cell.settings.model import Settings

#: How fast a simulated world runs, and how finely, is not a property of its cables.
PACE = ("real_time_factor", "segments")
#: Calibrations of a line; those that were not made are left out.
CALIBRATIONS = ("camera", "cell", "time", "grip")
#: Differences that are told.
TOLD = 3
_MADE = "made"


def line_of(settings: Settings) -> dict[str, Any]:
    """Data sheet, camera, arm, calibration and simulated world of a line, as plain data.

    A calibration that was made is told by its dates: it is made anew, on the same line.  What is
    typed instead is told by its numbers.
    """
    plain = settings.model_dump(mode="json", include={"cable", "camera", "arm", "world"})
    world = {name: value for name, value in plain["world"].items() if name not in PACE}
    return {
        "cable": plain["cable"],
        "devices": dict(devices_of(settings)),
        "calibration": _calibration(settings, plain),
        "world": world,
    }


def _calibration(settings: Settings, plain: Mapping[str, Any]) -> dict[str, Any]:
    if settings.calibration is None:
        camera, arm = plain["camera"], plain["arm"]
        view, latency_s = camera.get("view"), camera.get("latency_s", 0.0)
        return {"typed": {"view": view, "latency_s": latency_s, "lag_s": arm.get("lag_s")}}
    made = {}
    for kind in CALIBRATIONS:
        try:
            made[kind] = load(calibration_file(settings, kind), kind).made.isoformat()
        except CalibrationFileError:  # whoever needs it says what is wrong
            continue
    return {_MADE: made}


def differences(theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> list[str]:
    """What two lines differ in, in words, the first few; none if they are one line."""
    were, are = dict(_leaves(theirs)), dict(_leaves(ours))
    keys = sorted(k for k in {*were, *are} if not k.startswith(f"calibration.{_MADE}"))
    apart = [key for key in keys if were.get(key) != are.get(key)]
    told = [f"{key} {were.get(key)}, here {are.get(key)}" for key in apart[:TOLD]]
    return told + ([f"{len(apart) - TOLD} more"] if len(apart) > TOLD else [])


def other_lines(lines: Sequence[Mapping[str, Any]], settings: Settings) -> list[str]:
    """Sentences of lines that are not that of the settings."""
    ours = line_of(settings)
    return [
        f"cycles of another line are among these: {'; '.join(apart)}"
        for line in lines
        if (apart := differences(line, ours))
    ]


def distinct(lines: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Lines, none of them twice."""
    return [line for i, line in enumerate(lines) if line not in lines[:i]]


def _leaves(data: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """All single values by their place."""
    if isinstance(data, Mapping):
        for name, value in data.items():
            yield from _leaves(value, f"{key}.{name}" if key else str(name))
    else:
        yield key, data
