"""How old and how good each calibration is, as texts for a page."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime

from calib.store import KINDS, CalibrationFileError, StoredCalibration, load
from cell.settings.calibrated import bounds_of, calibration_file, complaint_of
from cell.settings.loading import products_of
from cell.settings.model import Settings
from cell.web.theme import N_

#: Words of what is calibrated.
WORDS = {
    "camera": N_("Camera: lens"),
    "cell": N_("Cell: map from pixels to the plane"),
    "time": N_("Time: latency and lag"),
    "grip": N_("Grip: gripping point, clamp angle, free length"),
}
#: Ending of an error's name → unit that people read, how many of it are one SI unit.
_UNITS = {"m": ("mm", 1e3), "s": ("ms", 1e3), "rad": ("°", 180.0 / math.pi), "px": ("px", 1.0)}
#: The error of a lens that is shown beside those that are bounded.
_ALSO = ("spread_95_px", "noise_px", "held_out_rms_m")


@dataclass(frozen=True)
class CalibrationPart:
    """One calibration.

    name   of its file, without the ending
    made   local time; None = there is none
    valid  whether `cell run` may use it
    why    why not, or ""
    errors heading → value with its bound
    """

    kind: str
    name: str
    made: datetime | None
    age_h: float
    most_h: float
    valid: bool
    why: str
    errors: tuple[tuple[str, str], ...]


def parts(settings: Settings, now: datetime | None = None) -> tuple[CalibrationPart, ...]:
    """All calibrations of a cell, in the order in which they are made; a grip for each product."""
    now = now or datetime.now(UTC)
    each = [(kind, settings) for kind in KINDS if kind != "grip"]
    each += [("grip", of) for of in products_of(settings).values() or [settings]]
    return tuple(_part(kind, of, now) for kind, of in each)


def _part(kind: str, settings: Settings, now: datetime) -> CalibrationPart:
    wanted = settings.calibration
    assert wanted is not None
    most_h = wanted.time_max_age_h if kind == "time" else 24.0 * wanted.max_age_days
    path = calibration_file(settings, kind)
    name = path.stem
    if not path.exists():
        return CalibrationPart(kind, name, None, math.nan, most_h, False, "", ())
    try:
        stored = load(path, kind)
        why = complaint_of(stored, wanted, settings, now) or ""
        errors = _errors(stored, settings)
    except (CalibrationFileError, ValueError) as error:
        return CalibrationPart(kind, name, None, math.nan, most_h, False, str(error), ())
    made = stored.made.astimezone()
    return CalibrationPart(kind, name, made, stored.age_h(now), most_h, not why, why, errors)


def _errors(stored: StoredCalibration, settings: Settings) -> tuple[tuple[str, str], ...]:
    assert settings.calibration is not None
    bounds = bounds_of(settings.calibration)
    found = []
    for name in (*bounds, *_ALSO):
        if name not in stored.error:
            continue
        unit, size = _UNITS[name.rpartition("_")[2]]
        text = f"{float(stored.error[name]) * size:.3g} {unit}"
        if name in bounds:
            text += f" ≤ {bounds[name] * size:.3g} {unit}"
        found.append((name.rpartition("_")[0].replace("_95", " 95 %").replace("_", " "), text))
    return tuple(found)
