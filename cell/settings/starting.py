"""Settings to start from: a simulated cell, an emulated one, and a real one to be measured."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any, Literal, get_args

import yaml
from pydantic import BaseModel, TypeAdapter
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from cell.files.input_error import InputError
from cell.files.yaml_document import Document, Key, dotted, read_yaml, validate
from cell.settings.model import Settings

CellKind = Literal["simulated", "emulated", "real"]

_STARTING = """
common: &common
  cable: {free_length_m: 0.100, line_density_kg_per_m: 0.0074, width_m: 0.016, thickness_m: 0.0001}
  destination: {x_m: [-0.135, -0.130], y_m: [-0.111, -0.101]}
  limits: &limits
    x_m: [-0.06, 0.02]
    y_m: [-0.10, 0.02]
    angle_rad: [-0.1, 0.1]
    velocity_m_per_s: 0.6
    acceleration_m_per_s2: 6.0
    jerk_m_per_s3: 250.0
simulated:
  <<: *common
  limits: {<<: *limits, angle_rad: [-0.6, 1.1]}  # tilted to measure
  arm: {kind: sim}
  camera:
    kind: sim
    view: &view {metres_per_pixel: 0.0002, origin_column_px: 1000.0, origin_row_px: 150.0}
  gripper: {kind: sim, force_n: 20.0}
  world: {}
emulated:
  <<: *common
  motion: {still_s: 0.4, decide_s: 0.7}  # frames at rest; a computer shared with emulators
  arm:
    kind: ur
    host: 127.0.0.2
    model: UR5e
    tcp: [0.0, 0.0, 0.160, 0.0, 2.221441, -2.221441]
    lag_s: 0.0305
    plane_origin_m: [-0.490, -0.133, 0.330]
    plane_x_axis: [0.0, -1.0, 0.0]
  camera:
    kind: opencv
    device: tcp://127.0.0.2:5600
    width_px: 800
    height_px: 640
    frame_rate_hz: 60.0
    exposure_s: null
    latency_s: 0.012
    lost_after_s: 0.3
    view: {metres_per_pixel: 0.00032, origin_column_px: 625.0, origin_row_px: 93.75}
  gripper: {kind: serial, port: /tmp/cable-cell-gripper, force_n: 20.0, reply_s: 0.5}
  world: {segments: 60}
  emulated: {}
real:
  <<: *common
  arm:
    kind: ur
    host: 192.168.3.10
    model: UR5e
    tcp: [0.0, 0.0, 0.160, 0.0, 0.0, 0.0]
    plane_origin_m: [0.450, -0.120, 0.380]
    plane_x_axis: [0.0, -1.0, 0.0]
  camera: {kind: genicam, producer: /opt/camera/lib/producer.cti, latency_s: 0.012, view: *view}
  gripper: {kind: serial, port: /dev/ttyUSB0, force_n: 20.0, force_limits_n: [20.0, 40.0]}
"""
#: Settings of each kind of cell, as plain data.
STARTING: Mapping[CellKind, Mapping[str, Any]] = {
    kind: yaml.safe_load(_STARTING)[kind] for kind in get_args(CellKind)
}


#: Questions for every cell, by the path of the entry; the rest of the file has defaults and
#: comments.
QUESTIONS: Mapping[tuple[str, ...], str] = {
    ("cable", "free_length_m"): "Length of the cable from the jaw to the tip, m",
    ("cable", "line_density_kg_per_m"): "Its mass per metre, kg/m",
    ("cable", "width_m"): "Its width, m",
    ("cable", "thickness_m"): "Its thickness, m",
    ("destination", "x_m"): "Opening, far and near edge: x, x, m",
    ("destination", "y_m"): "Opening, lower and upper edge: y, y, m",
    ("limits", "x_m"): "Where the gripper may be: least and greatest x, m",
    ("limits", "y_m"): "Where the gripper may be: least and greatest y, m",
}

#: Questions for a real cell only.
DEVICE_QUESTIONS: Mapping[tuple[str, ...], str] = {
    ("arm", "host"): "Address of the arm's controller",
    ("arm", "model"): "Model of the arm: UR3e, UR5e or UR10e",
    ("camera", "producer"): "GenTL producer of the camera, a .cti file",
    ("gripper", "port"): "Serial port of the gripper",
}

#: Entries that differ between any two real cells.
MEASURED: tuple[Key, ...] = (
    ("cable", "free_length_m"),
    ("cable", "line_density_kg_per_m"),
    ("destination", "x_m"),
    ("destination", "y_m"),
    ("arm", "host"),
    ("arm", "tcp"),
    ("arm", "plane_origin_m"),
    ("camera", "view"),
)


def unmeasured(settings: Settings) -> tuple[str, ...]:
    """Entries of a real cell that have the value of the example of `cell init --real`, dotted."""
    if settings.arm.kind == "sim" or settings.emulated is not None:
        return ()
    example = Settings.model_validate(answered("real", {}))
    same = (k for k in MEASURED if _entry(settings, k) == _entry(example, k) is not None)
    return tuple(dotted(key) for key in same)


def unmeasured_notes(settings: Settings, config: Path) -> list[str]:
    """A note that names the entries of `unmeasured`; none if there are none."""
    examples = ", ".join(unmeasured(settings))
    note = f"{config}: as in the example of `cell init --real`, so not yet of your cell: {examples}"
    return [f"{note}; measure them (`cell help commission`)"] if examples else []


def refuse_examples(settings: Settings, config: Path, inserts: bool) -> None:
    """Refuse to move a real arm whose place, or camera's view, is still that of the example.

    Both are measured at the cell, to parts of a millimetre: two cells never have the same.

    inserts  whether a cable is moved, so that the view decides where its tip is
    raises   InputError
    """
    wanted = ("arm.plane_origin_m", *(("camera.view",) if inserts else ()))
    if same := [key for key in unmeasured(settings) if key in wanted]:
        message = "has the value of the example of `cell init --real`; measure that of this cell"
        file = read_yaml(config)
        raise InputError(
            [
                file.problem(tuple(key.split(".")), f"{message} (`cell help commission`)")
                for key in same
            ]
        )


def _entry(settings: Settings, key: Key) -> Any:
    """Value of an entry; None where this kind of device has no such entry."""
    value: Any = settings
    for name in key:
        value = getattr(value, str(name), None)
    return value


def questions(kind: CellKind) -> dict[tuple[str, ...], str]:
    """Questions for a cell of this kind, by the path of the entry."""
    return {**QUESTIONS, **(DEVICE_QUESTIONS if kind == "real" else {})}


def default(kind: CellKind, key: tuple[str, ...]) -> Any:
    """Default of an entry in the starting settings."""
    value: Any = STARTING[kind]
    for part in key:
        value = value[part]
    return value


def answered(kind: CellKind, answers: Mapping[tuple[str, ...], Any]) -> dict[str, Any]:
    """The starting settings with answers in place of the defaults."""
    settings = deepcopy(dict(STARTING[kind]))
    for key, value in answers.items():
        section = settings
        for part in key[:-1]:
            section = section[part]
        section[key[-1]] = value
    return settings


def answer_of(text: str, usual: Any) -> Any:
    """A typed answer as text, or parsed as YAML if the entry's usual value is no text."""
    if isinstance(usual, str):
        return text
    try:
        return yaml.safe_load(f"[{text}]" if isinstance(usual, list) else text)
    except yaml.YAMLError:
        return text


def answer_problem(
    kind: CellKind, answers: Mapping[tuple[str, ...], Any], key: tuple[str, ...]
) -> str | None:
    """Problem of the answer for an entry, with limit and remedy; None if it is valid."""
    settings = answered(kind, answers)
    document = Document(Path("answers"), settings, dict.fromkeys(_keys(settings), (1, 1)))
    try:
        validate(document, Settings)
    except InputError as error:
        for problem in error.problems:
            if problem.key.startswith(dotted(key)):
                return f"{problem.key}: {problem.message}"
    return None


def _keys(value: Any, key: Key = ()) -> Iterator[Key]:
    """Keys of all nodes of plain data, including the root."""
    yield key
    if isinstance(value, dict | list):
        for part, inside in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _keys(inside, (*key, part))


_HEADING = """\
# Settings of a cell, made by `cell init`; check them with `cell check --config THIS_FILE`.
# x right, y up; metres, seconds, radians, newtons; the unit is in the key's name.
# The cell's plane is vertical; its origin is where the gripping point is when a cable is grasped;
# the cable leaves the jaw to the left (towards -x), and the destination lies to the left.
"""
_COLUMN, _WIDTH = 40, 100
_ABOVE: Any = {"initial_indent": "  # ", "subsequent_indent": "  #   "}


def commented(settings: Settings) -> str:
    """YAML text that loads as these settings, with a comment after every entry."""
    lines = [_HEADING]
    for name, field in type(settings).model_fields.items():
        section = getattr(settings, name)
        if name == "world" and settings.arm.kind != "sim" and settings.emulated is None:
            continue
        if isinstance(section, BaseModel):
            lines += ["", f"# {_sentence(type(section).__doc__ or '')}", f"{name}:"]
            lines += _entries(section)
        elif section is not None:
            lines.append(f"{name}: {_plain(section)}  # {_comment(field)}")
    return "\n".join(lines) + "\n"


def _entries(section: BaseModel) -> list[str]:
    lines = []
    values = section.model_dump(mode="json")
    fields = sorted(type(section).model_fields.items(), key=lambda item: item[0] != "kind")
    for name, field in fields:
        entry, comment = f"  {name}: {_plain(values[name])}", _comment(field)
        commented_entry = f"{entry:<{_COLUMN}}  # {comment}" if comment else entry
        if len(commented_entry) <= _WIDTH:
            lines.append(commented_entry)
        else:
            lines += [*textwrap.wrap(comment, _WIDTH, **_ABOVE), entry]
    return lines


def _comment(field: FieldInfo) -> str:
    """Description, range and default of an entry."""
    words = [_sentence(field.description or "")] if field.description else []
    bounds = [
        f"{sign} {bound:g}"
        for constraint in field.metadata
        for sign, attribute in ((">", "gt"), ("≥", "ge"), ("<", "lt"), ("≤", "le"))
        if isinstance(bound := getattr(constraint, attribute, None), int | float)
    ]
    if bounds:
        words.append(", ".join(bounds))
    default = field.get_default(call_default_factory=False)
    if default is not PydanticUndefined and not isinstance(default, BaseModel):
        words.append(f"default {_plain(_json(default))}")
    return "; ".join(w.rstrip(".") for w in words)


def _sentence(text: str) -> str:
    """The first paragraph, in one line."""
    return " ".join(text.split("\n\n")[0].split()).rstrip(".")


def _json(value: Any) -> Any:
    return TypeAdapter(Any).dump_python(value, mode="json")


def _plain(value: Any) -> str:
    """A value in YAML's flow style, in one line."""
    text = yaml.safe_dump([value], default_flow_style=True, width=10_000, sort_keys=False)
    return text.strip()[1:-1]
