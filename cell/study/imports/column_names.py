"""Meaning of a column by its name: time, a coordinate of a point, an angle, or other."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache

from cell.study.imports.capture import CapturedColumn
from cell.study.imports.units import METRES, RADIANS, SECONDS, split_unit


class ColumnKind(Enum):
    """Kind of quantity in a column."""

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
    unit   stated unit; empty = none
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
#: In names of more words `t` is a transform, not a time.
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
#: Words of quantities that are not a position.
_OTHER = frozenset(
    ("velocity", "speed", "vel", "force", "torque", "moment", "residual",
     "residuals", "error", "likelihood", "confidence", "quality", "probability", "visible",
     "valid", "validity", "status", "std", "cov", "temperature", "current", "voltage", "cameras")
)  # fmt: skip
#: Of a force or moment.
_WRENCH = re.compile(r"force|torque|moment|[fmt][xyz]?|kraft")
_OF_WRENCH = frozenset(("n", "nm", "n·m", "n*m", "n m", "mn", "mnm"))
#: Words that describe a coordinate, but do not identify its point.
_FILLER = frozenset(
    ("pos", "position", "positions", "xy", "xyz", "tracks", "coord", "coordinate", "coordinates",
     "trans", "translation", "location", "values",
     "place", "value", "data", "in", "col", "koordinate", "pose", "point", "markers", "transform",
     "transforms", "xpos")
)  # fmt: skip
#: Words with their axis as a suffix.
_AXIS_SUFFIX = re.compile(r"(pos|p|t|coord|q|quat|rot|r)([xyzw])")
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
    """Meaning of a column by its name and its stated unit."""
    return _meaning(column.name, column.unit)


@lru_cache(maxsize=4096)
def _meaning(name: str, unit: str) -> Meaning:
    bare, within = split_unit(name)
    unit = unit or within
    if pose := _POSE.fullmatch(bare):  # of UR: metres, and a rotation vector
        group = " ".join(w for w in _words(pose[1]) if w not in _FILLER)
        part = int(pose[2])
        kind = ColumnKind.COORDINATE if part < 3 else ColumnKind.OTHER
        return Meaning(kind, group, "xyz"[part % 3], unit or "m")
    if bare.lower() == _X_VALUE:
        return Meaning(ColumnKind.TIME, "", "", unit or "s")
    words, unit = _without_unit(_words(bare), unit)
    unit = unit or next((_TIME_WITH_UNIT[w] for w in words if w in _TIME_WITH_UNIT), "")
    if (acceleration := _acceleration(words, unit)) is not None:
        return acceleration
    axis, rest = "", list[str]()
    rotation = False
    for word in words:
        suffixed = _AXIS_SUFFIX.fullmatch(word)
        if word in ("x", "y", "z", "w") and not axis:
            axis = word
        elif word == "q0" and not axis:  # with qx, qy and qz; else it has no effect
            axis, rest = "w", [*rest, "quat"]
        elif word == axis:  # several lines of names repeat it
            continue
        elif suffixed and not axis:
            axis = suffixed[2]
            rest += {"q": ["quat"], "quat": ["quat"]}.get(suffixed[1], [])
            rotation = rotation or suffixed[1] in ("r", "rot")
        else:
            rest.append(word)
    kind = _kind(rest, axis, unit, rotation)
    if kind is ColumnKind.ANGLE and not axis:
        axis = next((_ORDER_OF_ROTATION[w] for w in rest if w in _ORDER_OF_ROTATION), "")
    dropped = _FILLER | _ANGLE | {"quat", "quaternion"} | _OF_KIND.get(kind, frozenset())
    dropped = frozenset() if kind is ColumnKind.OTHER else dropped
    return Meaning(kind, " ".join(w for w in rest if w not in dropped), axis, unit)


def _without_unit(words: list[str], unit: str) -> tuple[list[str], str]:
    """Words of a name without its unit between them, and the unit; px is one beside an axis."""
    within = unit if unit in METRES or unit in RADIANS or unit == "px" else ""
    if "px" in words[1:] and set("xyz") & set(words):  # also where places are scaled since
        within, unit = "px", unit or "px"
    if within in words[1:]:
        place = words.index(within, 1)
        words = words[:place] + words[place + 1 :]
    return words, unit


#: A name that ends or begins with its axis, or ends with the number of an array's column, from 0 or
#: from 1.
_AXIS_AT_END = re.compile(r"(?P<stem>.{2,}?)(?P<end>[xyz])", re.IGNORECASE)
_AXIS_AT_BEGINNING = re.compile(r"(?P<end>[xyz])(?P<stem>.{2,})", re.IGNORECASE)
_NUMBER_AT_END = re.compile(r"(?P<stem>.*\w)[_:\[](?P<end>[0-3])\]?")
#: Three angles of one rotation; Mecademic's robots write them in degrees.
_EULER = re.compile(r"(?P<stem>.*?)(?P<end>alpha|beta|gamma)", re.IGNORECASE)
_EULER_AXES = {"alpha": "x", "beta": "y", "gamma": "z"}
_OF_MECADEMIC = re.compile(r"cart_?pos", re.IGNORECASE)
#: Of columns and rows of an image.
_OF_IMAGE = re.compile(r"(?P<stem>(?:.*[^_\s.:])?)[_\s.:]?(?P<end>[uv])", re.IGNORECASE)
#: Kinds of columns whose final number may be an axis, if nothing else names the axis.
_MAYBE_NUMBERED = (ColumnKind.OTHER, ColumnKind.ANGLE, ColumnKind.QUATERNION)
_QUATERNION = frozenset(("quat", "quaternion", "xquat", "quats"))
_NUMBERED_AXES = {
    frozenset(str(first + k) for k in range(count)): {
        str(first + k): "xyz"[k] for k in range(count)
    }
    for first in (0, 1)
    for count in (2, 3)
}
#: All quantities with an axis that are not a position.
_NO_PLACE = _OTHER | _ACCELERATION | _ANGLE
_NO_PLACE |= frozenset(("gyro", "mag", "imu", "omega", "err", "res", "ma", "quat"))


def with_axes_at_ends(meanings: list[tuple[str, Meaning]]) -> list[tuple[str, Meaning]]:
    """The columns, with coordinates whose axis is joined to their name: `gripx, gripy`, or `xtip,
    ytip`.

    That is an axis if the file has x and y, or x, y and z, with one stem.  If there are no
    other coordinates, `d1_u, d1_v` are those of an image, in pixels; else those of a point may be
    numbered: `m1_1, m1_2`, `m1[0], m1[1]`, `m1:0, m1:1`.  Alpha, beta and gamma after one stem are
    angles of one rotation.
    """
    result = dict(meanings)
    for stem, ends in _stems(meanings, _EULER).items():
        if set(ends) == set(_EULER_AXES):
            of = meaning(CapturedColumn(ends["alpha"]))
            unit = of.unit or ("deg" if _OF_MECADEMIC.search(stem) else "")
            for letter, name in ends.items():
                result[name] = Meaning(ColumnKind.ANGLE, of.group, _EULER_AXES[letter], unit)
    if not any(m.kind is ColumnKind.COORDINATE for m in result.values()):
        for stem, ends in _stems(meanings, _OF_IMAGE).items():
            if set(ends) == {"u", "v"}:
                group = " ".join(w for w in _words(stem) if w not in _FILLER)
                for axis, name in (("x", ends["u"]), ("y", ends["v"])):
                    unit = result[name].unit or "px"
                    result[name] = Meaning(ColumnKind.COORDINATE, group, axis, unit)
    meanings = [(name, result[name]) for name, _ in meanings]
    forms: list[tuple[re.Pattern[str], tuple[ColumnKind, ...]]]
    forms = [(form, (ColumnKind.OTHER,)) for form in (_AXIS_AT_END, _AXIS_AT_BEGINNING)]
    if not any(m.kind is ColumnKind.COORDINATE for _, m in meanings):
        forms.append((_NUMBER_AT_END, _MAYBE_NUMBERED))
    for form, kinds in forms:
        unnamed = [(name, m) for name, m in meanings if m.kind in kinds and not m.axis]
        stems = _stems(unnamed, form)
        for stem, names in stems.items():
            words = _words(stem)
            if set(names) == set("0123") and (_QUATERNION | {"orientation"}) & set(words):
                group = " ".join(w for w in words if w not in _FILLER | _ANGLE | _QUATERNION)
                for place, name in names.items():
                    axis = "xyzw"[int(place)]
                    result[name] = Meaning(ColumnKind.QUATERNION, group, axis, "")
                continue
            axes = _NUMBERED_AXES.get(frozenset(names), {})
            if axes and any(result[n].kind is not ColumnKind.OTHER for n in names.values()):
                continue
            names = {axes.get(end, end): name for end, name in names.items()}
            if set(names) not in ({"x", "y"}, {"x", "y", "z"}) or _NO_PLACE & set(words):
                continue
            if any(_WRENCH.fullmatch(w) or _VELOCITY.fullmatch(f"{w}x") for w in words):
                continue
            group = " ".join(w for w in words if w not in _FILLER)
            for axis, name in names.items():
                result[name] = Meaning(ColumnKind.COORDINATE, group, axis, result[name].unit)
    return [(name, result[name]) for name, _ in meanings]


def _stems(
    meanings: Sequence[tuple[str, Meaning]], form: re.Pattern[str]
) -> dict[str, dict[str, str]]:
    """Columns by the stem and the end of their names."""
    stems: dict[str, dict[str, str]] = {}
    for name, _ in meanings:
        if match := form.fullmatch(split_unit(name)[0]):
            stems.setdefault(match["stem"], {})[match["end"].lower()] = name
    return stems


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


#: Last words of columns of detection confidence, and of those that are 1 where a point is visible;
#: the thresholds below which it is not.
_CONFIDENCE = {"likelihood": 0.6, "confidence": 0.6, "probability": 0.6, "visible": 0.5,
               "valid": 0.5, "validity": 0.5, "cond": 0.0, "condition": 0.0,
               "sigma": 0.0}  # fmt: skip
_VISIBILITY = dict.fromkeys(("v", "vis", "visibility"), 0.5)


def visibility(column: CapturedColumn) -> tuple[str, float, bool] | None:
    """Point, threshold, and whether it is a flag, of a column of visibility; None = another one.

    source  DeepLabCut, `pcutoff` 0.6; PhaseSpace, a condition below 0; VIC-3D, a sigma below 0
    """
    *words, last = _words(column.name) or [""]
    if last not in _VISIBILITY and not (words and last in _CONFIDENCE):
        return None
    group = " ".join(w for w in words if w not in _FILLER)
    return group, (_CONFIDENCE | _VISIBILITY)[last], last in _VISIBILITY


#: Last words of a displacement from a point's initial position, such as dX, and its axes.
DISPLACEMENT = frozenset(("d", "delta", "displacement"))
_DISPLACED_ALONG = {"u": "x", "v": "y", "w": "z"}


def displacement(column: CapturedColumn) -> tuple[str, str] | None:
    """Point and axis of a column of displacements; None = another one."""
    found = meaning(column)
    *words, last = [w for w in _words(split_unit(column.name)[0]) if w not in _FILLER] or [""]
    if found.kind is ColumnKind.OTHER and last in _DISPLACED_ALONG:
        return " ".join(words), _DISPLACED_ALONG[last]
    point, _, last = found.group.rpartition(" ")
    is_displaced = found.kind is ColumnKind.COORDINATE and last in DISPLACEMENT
    return (point, found.axis) if is_displaced else None


def _acceleration(words: list[str], unit: str) -> Meaning | None:
    """Meaning of a column with the name or unit of an acceleration; only here g is a unit."""
    along = [_ACCELERATION_ALONG.fullmatch(w) for w in words]
    if not (_ACCELERATION & set(words) or any(along) or unit in _OF_ACCELERATION):
        return None
    if words[-1:] == ["g"]:
        words, along, unit = words[:-1], along[:-1], unit or "g"
    axis = next((match[1] for match in along if match), "")
    axis = axis or next((w for w in words if w in ("x", "y", "z")), "")
    rest = [
        w for w, match in zip(words, along, strict=True) if not match and w not in _ACCELERATION
    ]
    return Meaning(ColumnKind.ACCELERATION, " ".join(w for w in rest if w != axis), axis, unit)


def _words(name: str) -> list[str]:
    """Lower-case words of a name, split at blanks, signs, changes of case, and axis next to number.

    `tipX`, `tip_x`, `X tip`, `TIP:X` are tip and x; `x0`, `x₀` and `M1X` are x and 0, m1 and x.
    """
    words: list[str] = []
    for piece in re.split(r"[^\w]+|_", unicodedata.normalize("NFKC", name)):
        for word in re.sub(r"(?<=[a-zäöü0-9])(?=[A-Z])", " ", piece).split():
            small = word.lower()
            if small.endswith("winkel") and small != "winkel":  # German joins its words
                words += [small.removesuffix("winkel"), "winkel"]
                continue
            if (match := re.fullmatch(r"([xyz])(\d+)", small)) or (
                match := re.fullmatch(r"(.*\d)([xyz])", small)
            ):
                words += [match[1], match[2]]
            else:
                words.append(small)
    return words
