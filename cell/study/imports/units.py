"""Units as files write them: their size in SI units, and the unit at the end of a name."""

from __future__ import annotations

import re

#: Size of units in metres, seconds and radians.
METRES = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 1e-3, "µm": 1e-6, "in": 0.0254, "ft": 0.3048}
SECONDS = {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "ns": 1e-9, "min": 60.0}
RADIANS = {"rad": 1.0, "deg": 0.017453292519943295, "mrad": 1e-3}
#: Further units that a row of units may hold; they are not converted.
_OTHERS = ("px", "hz", "frames", "m/s", "mm/s", "m/s^2", "mm/s^2", "g", "rad/s", "deg/s", "n", "1")

_SPELLED = {
    "um": "µm", "μm": "µm", "us": "µs", "μs": "µs", "°": "deg", "inch": "in", "inches": "in",
    "meter": "m", "meters": "m", "metre": "m", "metres": "m", "centimeters": "cm",
    "centimetres": "cm", "millimeter": "mm", "millimeters": "mm", "millimetre": "mm",
    "millimetres": "mm", "sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms",
    "millisecond": "ms", "milliseconds": "ms", "usec": "µs", "microseconds": "µs",
    "nsec": "ns", "nanoseconds": "ns", "minutes": "min", "degree": "deg", "degrees": "deg",
    "grad": "deg", "radian": "rad", "radians": "rad", "pixel": "px", "pixels": "px",
    "m/s2": "m/s^2", "m/s²": "m/s^2", "mm/s2": "mm/s^2", "mm/s²": "mm/s^2",
}  # fmt: skip
_KNOWN = {*METRES, *SECONDS, *RADIANS, *_OTHERS}
#: In brackets at the end, or after a blank, a slash, "in" or an underscore.
_AT_END = re.compile(
    r"^(.*?)(?:\s*[\(\[{]\s*([^\(\)\[\]{}]+?)\s*[\)\]}]|(?:[\s_/]|\bin\s)([^\s_/]+))$"
)
#: In brackets before the number of a run: `Position (m) Run #1`.
_WITHIN = re.compile(r"^(.+?)\s*[\(\[]([^\(\)\[\]]+)[\)\]](\s+\S.*)$")


def unit_of(text: str) -> str:
    """The unit of a word, as a key of `METRES` and the like; empty if it is no unit."""
    word = text.strip().strip("()[]{}").strip()
    if word in _KNOWN:
        return word
    word = word.lower()
    word = _SPELLED.get(word, word)
    return word if word in _KNOWN else ""


def split_unit(name: str) -> tuple[str, str]:
    """A column's name without its unit, and the unit; empty = it has none.

    `tip_x_mm`, `tip x [mm]` and `tip x (Millimeters)` are all tip x in mm.
    """
    if (match := _WITHIN.match(name.strip())) and unit_of(match[2]):
        name = f"{match[1]}{match[3]} [{match[2]}]"
    match = _AT_END.match(name.strip())
    if match is None:
        return name.strip(), ""
    bare, bracketed, after = match.groups()
    unit = unit_of(bracketed or after or "")
    if not unit or not bare.strip(" _/") or unit in ("n", "g", "1"):
        return name.strip(), ""
    return bare.strip().rstrip("_/ ").removesuffix(" in"), unit
