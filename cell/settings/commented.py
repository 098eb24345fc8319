"""Settings as YAML in which every entry is explained: what it is, its range, its default."""

from __future__ import annotations

import textwrap
from typing import Any

import yaml
from pydantic import BaseModel, TypeAdapter
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from cell.settings.model import Settings

_HEADING = """\
# Settings of a cell, made by `cell init`; check them with `cell check --config THIS_FILE`.
# x right, y up; metres, seconds, radians, newtons; the unit is in the key's name.
# The cell's plane is vertical; its origin is where the gripping point is when a cable is grasped;
# the cable leaves the jaw to the left (towards -x), and the destination lies to the left.
"""
_COLUMN, _WIDTH = 40, 100
_ABOVE: Any = {"initial_indent": "  # ", "subsequent_indent": "  #   "}


def commented(settings: Settings) -> str:
    """YAML text that loads as these settings, with a comment beside every entry."""
    lines = [_HEADING]
    for name, field in type(settings).model_fields.items():
        section = getattr(settings, name)
        if name == "world" and settings.arm.kind != "sim" and settings.emulated is None:
            continue
        if isinstance(section, BaseModel):
            lines += ["", f"# {_sentence(type(section).__doc__ or '')}", f"{name}:"]
            lines += _entries(section)
        elif section is not None:
            lines.append(f"{name}: {_plain(section)}  # {_explained(field)}")
    return "\n".join(lines) + "\n"


def _entries(section: BaseModel) -> list[str]:
    lines = []
    values = section.model_dump(mode="json")
    fields = sorted(type(section).model_fields.items(), key=lambda item: item[0] != "kind")
    for name, field in fields:
        entry, comment = f"  {name}: {_plain(values[name])}", _explained(field)
        beside = f"{entry:<{_COLUMN}}  # {comment}" if comment else entry
        if len(beside) <= _WIDTH:
            lines.append(beside)
        else:
            lines += [*textwrap.wrap(comment, _WIDTH, **_ABOVE), entry]
    return lines


def _explained(field: FieldInfo) -> str:
    """What it is, range and default of an entry."""
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
