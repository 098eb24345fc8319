"""Meaning of a column by its name: time, a coordinate of a point, an angle, or other."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from enum import Enum

from cell.study.imports.capture import CapturedColumn
from cell.study.imports.units import RADIANS, SECONDS, split_unit


class ColumnKind(Enum):
    """What a column holds."""

    TIME = "time"
    FRAME = "frame"
    COORDINATE = "coordinate"
    ANGLE = "angle"
    QUATERNION = "quaternion"
    ACCELERATION = "acceleration"
    ENCODER = "encoder"
    OTHER = "other"


@dataclass(frozen=True)
class Meaning:
    """Meaning of a column name.

    group  name of the point or body, in small letters; empty = none
    axis   x, y, z of a coordinate or of the axis of an angle, and w of a quaternion; empty = none
    unit   that is stated; empty = none
    """

    kind: ColumnKind
    group: str
    axis: str
    unit: str


#: Words that are a time with its unit: of Arduino's functions, and of KUKA's RSI.
_TIME_WITH_UNIT = {"millis": "ms", "micros": "µs", "ipoc": "ms"}
_TIME = frozenset(
    ("t", "time", "times", "zeit", "temps", "tiempo", "tempo", "timestamp", "stamp", "elapsed",
     "timestamps", "stamps", "ts", "tm", "epoch",
     *_TIME_WITH_UNIT)
)  # fmt: skip
#: In longer names `t` is no time, but a transform.
_NEAR_T = 2
#: LabVIEW's column of times, seconds.
_X_VALUE = "x_value"
_FRAME = frozenset(
    ("frame", "frames", "bild", "image", "slice", "sample", "field", "nr", "no", "row", "pic",
     "picture", "index", "idx", "counter", "step")
)  # fmt: skip
_ANGLE = frozenset(
    ("angle", "theta", "winkel", "angulo", "rotation", "rot", "roll", "pitch", "yaw", "orientation",
     "tilt", "heading", "alpha", "phi", "attitude", "neigung", "rpy", "rpys", "incl",
     "inclination", "inclinacion", "inclinaison", "inclinazione",
     "φ", "θ", "α")
)  # fmt: skip
#: Quantities that are no place.
_OTHER = frozenset(
    ("velocity", "speed", "vel", "force", "torque", "moment", "residual",
     "residuals", "error", "likelihood", "confidence", "quality", "probability", "visible",
     "valid", "status", "std", "cov", "temperature", "current", "voltage", "cameras")
)  # fmt: skip
#: Of a force or moment.
_WRENCH = re.compile(r"force|torque|moment|[fmt][xyz]?|kraft")
_OF_WRENCH = frozenset(("n", "nm", "n·m", "n*m", "n m", "mn", "mnm"))
#: Words that say what kind of number a coordinate is, not of which point.
_FILLER = frozenset(
    ("pos", "position", "positions", "xy", "xyz", "tracks", "coord", "coordinate", "coordinates",
     "trans", "translation", "location", "values",
     "place", "value", "data", "in", "col", "koordinate", "pose", "point", "markers", "transform",
     "transforms", "xpos")
)  # fmt: skip
#: Words with their axis grown onto them.
_GROWN = re.compile(r"(pos|p|t|coord|q|quat|rot|r)([xyzw])")
#: Of the six numbers of a robot's pose.
_POSE = re.compile(r"(.*pose)[\s_\[]*([0-5])\]?", re.IGNORECASE)
_VELOCITY = re.compile(r"(v|vel|f|w|omega)[xyz]")
_ACCELERATION = frozenset(
    ("acceleration", "accelerations", "acc", "accel", "accelerometer", "beschleunigung")
)
_ACCELERATION_ALONG = re.compile(r"(?:a|acc|accel)([xyz])")
_OF_ACCELERATION = ("m/s^2", "mm/s^2", "g")
_ENCODER = frozenset(("encoder", "enc", "counts", "ticks", "pulses", "geber", "inkremente"))
_OF_KIND = {ColumnKind.TIME: _TIME, ColumnKind.FRAME: _FRAME, ColumnKind.ENCODER: _ENCODER}
_ORDER_OF_ROTATION = {"roll": "x", "pitch": "y", "yaw": "z"}


def is_of_wrench(name: str) -> bool:
    """Whether a column seems to hold a force or a moment."""
    bare, unit = split_unit(name)
    words = _words(bare)
    of_unit = unit.lower() in _OF_WRENCH or (words and words[-1] in _OF_WRENCH)
    named = any(_WRENCH.fullmatch(word) for word in words)
    return named and bool(of_unit or {"force", "torque", "moment"} & set(words))


def meaning(column: CapturedColumn) -> Meaning:
    """What a column's name, and the unit stated beside it, say."""
    bare, within = split_unit(column.name)
    unit = column.unit or within
    if pose := _POSE.fullmatch(bare):  # of UR: metres, and a rotation vector
        group = " ".join(w for w in _words(pose[1]) if w not in _FILLER)
        part = int(pose[2])
        kind = ColumnKind.COORDINATE if part < 3 else ColumnKind.OTHER
        return Meaning(kind, group, "xyz"[part % 3], unit or "m")
    if bare.lower() == _X_VALUE:
        return Meaning(ColumnKind.TIME, "", "", unit or "s")
    words = _words(bare)
    unit = unit or next((_TIME_WITH_UNIT[w] for w in words if w in _TIME_WITH_UNIT), "")
    if (found := _acceleration(words, unit)) is not None:
        return found
    axis, rest = "", list[str]()
    rotation = False
    for word in words:
        grown = _GROWN.fullmatch(word)
        if word in ("x", "y", "z", "w") and not axis:
            axis = word
        elif word == "q0" and not axis:  # beside qx, qy and qz; else nothing comes of it
            axis, rest = "w", [*rest, "quat"]
        elif word == axis:  # several lines of names say it
            continue
        elif grown and not axis:
            axis = grown[2]
            rest += {"q": ["quat"], "quat": ["quat"]}.get(grown[1], [])
            rotation = rotation or grown[1] in ("r", "rot")
        else:
            rest.append(word)
    kind = _kind(rest, axis, unit, rotation)
    if kind is ColumnKind.ANGLE and not axis:
        axis = next((_ORDER_OF_ROTATION[w] for w in rest if w in _ORDER_OF_ROTATION), "")
    dropped = _FILLER | _ANGLE | {"quat", "quaternion"} | _OF_KIND.get(kind, frozenset())
    dropped = frozenset() if kind is ColumnKind.OTHER else dropped
    return Meaning(kind, " ".join(w for w in rest if w not in dropped), axis, unit)


#: A name that ends with its axis, or with the number of an array's column, from 0 or from 1.
_AXIS_AT_END = re.compile(r"(.{2,}?)([xyz])", re.IGNORECASE)
_NUMBER_AT_END = re.compile(r"(.*\w)(?:_|\[)([0-3])\]?")
#: Kinds of columns whose numbers may be those of an array, if nothing else names their axes.
_UNNUMBERED = (ColumnKind.OTHER, ColumnKind.ANGLE, ColumnKind.QUATERNION)
_QUATERNION = frozenset(("quat", "quaternion", "xquat", "quats"))
_NUMBERED_AXES = {
    frozenset(str(first + k) for k in range(count)): {
        str(first + k): "xyz"[k] for k in range(count)
    }
    for first in (0, 1)
    for count in (2, 3)
}
#: Quantities with an axis that are no place, beside those above.
_NO_PLACE = _OTHER | _ACCELERATION | frozenset(("gyro", "mag", "imu", "omega", "err", "res", "ma"))


def with_axes_at_ends(said: list[tuple[str, Meaning]]) -> list[tuple[str, Meaning]]:
    """The columns, with coordinates whose names have their axis grown on: `gripx, gripy`.

    It is an axis if the file has x and y, or x, y and z, behind one word.  If no column is a
    coordinate otherwise, those of a point may be numbered: `m1_1, m1_2, m1_3`, `m1[0], m1[1]`.
    """
    said = _with_pixels(said)
    forms = [_AXIS_AT_END]
    if not any(m.kind is ColumnKind.COORDINATE for _, m in said):
        forms.append(_NUMBER_AT_END)
    found = dict(said)
    for form in forms:
        stems: dict[str, dict[str, str]] = {}
        for name, m in said:
            match = form.fullmatch(split_unit(name)[0])
            kinds = (ColumnKind.OTHER,) if form is _AXIS_AT_END else _UNNUMBERED
            if match and m.kind in kinds and not m.axis:
                stems.setdefault(match[1], {})[match[2].lower()] = name
        for stem, names in stems.items():
            words = _words(stem)
            if frozenset(names) == frozenset("0123") and _is_quaternion(words):
                group = " ".join(w for w in words if w not in _FILLER | _ANGLE | _QUATERNION)
                for place, name in names.items():
                    axis = "xyzw"[int(place)]
                    found[name] = Meaning(ColumnKind.QUATERNION, group, axis, "")
                continue
            axes = _NUMBERED_AXES.get(frozenset(names), {})
            if axes and any(found[n].kind is not ColumnKind.OTHER for n in names.values()):
                continue
            names = {axes.get(end, end): name for end, name in names.items()}
            if set(names) not in ({"x", "y"}, {"x", "y", "z"}) or _NO_PLACE & set(words):
                continue
            if any(_WRENCH.fullmatch(w) or _VELOCITY.fullmatch(f"{w}x") for w in words):
                continue
            group = " ".join(w for w in words if w not in _FILLER)
            for axis, name in names.items():
                found[name] = Meaning(ColumnKind.COORDINATE, group, axis, found[name].unit)
    return [(name, found[name]) for name, _ in said]


#: Columns and rows of an image.
_OF_IMAGE = re.compile(r"(.*[^_\s.:])?[_\s.:]?([uv])", re.IGNORECASE)


def _with_pixels(said: list[tuple[str, Meaning]]) -> list[tuple[str, Meaning]]:
    """The columns, with `d1_u, d1_v` as coordinates in an image, where no others are there."""
    if any(m.kind is ColumnKind.COORDINATE for _, m in said):
        return said
    stems: dict[str, dict[str, str]] = {}
    for name, _ in said:
        if match := _OF_IMAGE.fullmatch(split_unit(name)[0]):
            stems.setdefault(match[1] or "", {})[match[2].lower()] = name
    found = dict(said)
    for stem, names in stems.items():
        if set(names) == {"u", "v"}:
            group = " ".join(w for w in _words(stem) if w not in _FILLER)
            for end, name in names.items():
                unit = found[name].unit or "px"
                found[name] = Meaning(ColumnKind.COORDINATE, group, "xy"["uv".index(end)], unit)
    return [(name, found[name]) for name, _ in said]


def _is_quaternion(words: list[str]) -> bool:
    return bool(_QUATERNION.intersection(words) or "orientation" in words)


def _kind(rest: list[str], axis: str, unit: str, rotation: bool) -> ColumnKind:
    words = set(rest)
    if words & _OTHER or any(_VELOCITY.fullmatch(w) for w in rest):
        return ColumnKind.OTHER
    if words & _ENCODER and not words & _FRAME:
        return ColumnKind.ENCODER
    if words & {"quat", "quaternion"}:
        return ColumnKind.QUATERNION
    if rotation or words & _ANGLE or unit in RADIANS:
        return ColumnKind.ANGLE
    if axis in ("x", "y", "z"):
        return ColumnKind.COORDINATE
    if (
        (words & _TIME and not (words & _TIME == {"t"} and len(rest) > _NEAR_T))
        or (unit in SECONDS)
        or rest in (["s"], ["ms"], ["sec"], ["seconds"])
    ):
        return ColumnKind.TIME
    return ColumnKind.FRAME if words & _FRAME else ColumnKind.OTHER


#: Last words of a column that says how sure a program is of a place, and from what value on it is.
_SURE_FROM = {"likelihood": 0.6, "confidence": 0.6, "probability": 0.6, "visible": 0.5,
              "valid": 0.5, "cond": 0.0, "condition": 0.0}  # fmt: skip


def confidence(column: CapturedColumn) -> tuple[str, float] | None:
    """The point and the threshold of a column of detection confidence; None for other columns.

    source  DeepLabCut, `pcutoff` 0.6; PhaseSpace, a condition below 0
    """
    words = _words(column.name)
    if len(words) < 2 or words[-1] not in _SURE_FROM:
        return None
    return " ".join(w for w in words[:-1] if w not in _FILLER), _SURE_FROM[words[-1]]


def _acceleration(words: list[str], unit: str) -> Meaning | None:
    """What is named after an acceleration, or has its unit; g is one of these only here."""
    along = [_ACCELERATION_ALONG.fullmatch(w) for w in words]
    if not (_ACCELERATION & set(words) or any(along) or unit in _OF_ACCELERATION):
        return None
    if words[-1:] == ["g"]:
        words, along, unit = words[:-1], along[:-1], unit or "g"
    axis = next((found[1] for found in along if found), "")
    axis = axis or next((w for w in words if w in ("x", "y", "z")), "")
    rest = [
        w for w, found in zip(words, along, strict=True) if not found and w not in _ACCELERATION
    ]
    return Meaning(ColumnKind.ACCELERATION, " ".join(w for w in rest if w != axis), axis, unit)


def _words(name: str) -> list[str]:
    """Words of a name in small letters: at blanks, signs, changes of case, and an axis at a number.

    `tipX`, `tip_x`, `X tip`, `TIP:X` are tip and x; `x0`, `x₀` and `M1X` are x and 0, m1 and x.
    """
    found: list[str] = []
    for piece in re.split(r"[^\w]+|_", unicodedata.normalize("NFKC", name)):
        for word in re.sub(r"(?<=[a-zäöü0-9])(?=[A-Z])", " ", piece).split():
            small = word.lower()
            if small.endswith("winkel") and small != "winkel":  # German grows its words together
                found += [small.removesuffix("winkel"), "winkel"]
                continue
            if (match := re.fullmatch(r"([xyz])(\d+)", small)) or (
                match := re.fullmatch(r"(.*\d)([xyz])", small)
            ):
                found += [match[1], match[2]]
            else:
                found.append(small)
    return found
