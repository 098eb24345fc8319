"""YAML checked against a pydantic model, every complaint with file, line, column and remedy."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

Key = tuple[str | int, ...]
Model = TypeVar("Model", bound=BaseModel)

_UNITS = re.compile(r"_(?:m|mm|s|ms|hz|n|kg|rad|deg|px|[a-z]+_per_[a-z0-9_]+|fraction)$")


#: Ending of a key, how many of the smaller unit make one, what to say.
_SMALLER_UNITS = (
    ("_kg_per_m", 1e3, "give kg/m, not g/m"),
    ("_rad", 57.3, "give radians, not degrees"),
    ("_m", 1e3, "give metres, not millimetres"),
    ("_s", 1e3, "give seconds, not milliseconds"),
)


@dataclass(frozen=True)
class Problem:
    """One thing wrong with a file.  `line` and `column` count from 1; `key` is dotted or empty."""

    path: Path
    line: int
    column: int | None
    key: str
    message: str

    def __str__(self) -> str:
        place = f"{self.path}:{self.line}" + ("" if self.column is None else f":{self.column}")
        return f"{place}: " + (f"{self.key}: " if self.key else "") + self.message


class InputError(ValueError):
    """A file that a person wrote is wrong; `problems` says where, why and what to do."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        super().__init__("\n".join(str(p) for p in problems))
        self.problems = tuple(problems)


@dataclass(frozen=True)
class Document:
    """A YAML file as plain data, and where each of its keys and list items stands."""

    path: Path
    data: Any
    places: dict[Key, tuple[int, int]]

    def problem(self, key: Key, message: str) -> Problem:
        """The complaint `message` about `key`, placed at it or at its nearest present parent."""
        present = key
        while present not in self.places:
            present = present[:-1]
        return Problem(self.path, *self.places[present], dotted(key), message)


def dotted(key: Key) -> str:
    """('trials', 0, 'role') → 'trials[0].role'."""
    text = ""
    for part in key:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


class _Loader(yaml.SafeLoader):
    """SafeLoader that reads 1e-5 as a number, as YAML 1.2 and everybody else does."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(?:[0-9][0-9_]*)(?:\.[0-9_]*)?[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


def load(path: Path) -> Document:
    """Read a YAML file.

    raises  InputError: the file is missing, is not YAML, or gives a key twice
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "is not UTF-8 text"
        raise InputError([Problem(path, 1, 1, "", f"cannot be read: {reason}")]) from error
    loader = _Loader(text)
    places: dict[Key, tuple[int, int]] = {(): (1, 1)}
    problems: list[Problem] = []

    def data_of(node: yaml.Node, key: Key) -> Any:
        if isinstance(node, yaml.MappingNode):
            mapping: dict[Any, Any] = {}
            for key_node, value_node in node.value:
                name = str(key_node.value)
                place = (key_node.start_mark.line + 1, key_node.start_mark.column + 1)
                if name in mapping:
                    problems.append(
                        Problem(
                            path,
                            *place,
                            dotted((*key, name)),
                            f"given twice, first in line {places[(*key, name)][0]}; remove one",
                        )
                    )
                places[(*key, name)] = place
                mapping[name] = data_of(value_node, (*key, name))
            return mapping
        if isinstance(node, yaml.SequenceNode):
            for index, item in enumerate(node.value):
                mark = item.start_mark
                places[(*key, index)] = (mark.line + 1, mark.column + 1)
            return [data_of(item, (*key, i)) for i, item in enumerate(node.value)]
        return loader.construct_object(node, deep=True)

    try:
        root = loader.get_single_node()
        data = {} if root is None else data_of(root, ())
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line, column = (mark.line + 1, mark.column + 1) if mark else (1, 1)
        hint = "; indent with spaces, not tabs" if "\\t" in str(error.problem) else ""
        raise InputError(
            [Problem(path, line, column, "", f"is not YAML: {error.problem}{hint}")]
        ) from error
    finally:
        loader.dispose()
    if problems:
        raise InputError(problems)
    return Document(path, data, places)


def validate(document: Document, model: type[Model]) -> Model:
    """The document as `model`.

    raises  InputError: every complaint of the model, each at its place, unknown keys with the
            nearest known one
    """
    if not isinstance(document.data, dict):
        raise InputError([document.problem((), "must hold `key: value` lines")])
    try:
        return model.model_validate(document.data)
    except ValidationError as error:
        problems = [_problem(document, details, model) for details in error.errors()]
        # A mistyped key is one mistake, not an unknown key and a missing one.
        meant = {
            (p.key.rpartition(".")[0], p.message.rpartition("did you mean ")[2]) for p in problems
        }
        problems = [
            p
            for p in problems
            if p.message != "is missing"
            or (p.key.rpartition(".")[0], f"{p.key.rpartition('.')[2]!r}?") not in meant
        ]
        raise InputError(sorted(problems, key=lambda p: (p.line, p.column or 0))) from error


def _problem(document: Document, details: ErrorDetails, model: type[BaseModel]) -> Problem:
    # A tagged union puts its tag into the location; the file does not have it there.
    key: Key = ()
    for part in details["loc"]:
        if (*key, part) in document.places or part == details["loc"][-1]:
            key = (*key, part)
    kind, context = details["type"], details.get("ctx", {})
    match kind:
        case "extra_forbidden":
            known = _known_keys(document.data, details["loc"], model)
            name = str(details["loc"][-1])
            return document.problem(key, f"unknown key{did_you_mean(name, known)}")
        case "missing":
            return document.problem(key, "is missing")
        case "value_error" | "assertion_error":
            message = str(context.get("error", details["msg"]))
            return document.problem(key if key in document.places else key[:-1], message)
        case "union_tag_not_found":
            return document.problem((*key, "kind"), "is missing")
        case "union_tag_invalid":
            tag, tags = str(context["tag"]), str(context["expected_tags"])
            guess = did_you_mean(tag, [t.strip(" '") for t in tags.split(",")])
            return document.problem((*key, "kind"), f"{tag!r} is not one of {tags}{guess}")
    value = details["input"]
    shown = "" if isinstance(value, dict | list) else f" = {value!r}"
    hint = ""
    if isinstance(value, str) and re.match(r"^[-+0-9.]+\s*[a-zA-Z°]", value):
        hint = "; write the number alone, its unit is in the key's name"
    if kind in ("less_than", "less_than_equal") and isinstance(value, int | float):
        limit = float(context["le"] if "le" in context else context["lt"])
        hint = _mistaken_unit(str(key[-1]), value, limit)
    message = details["msg"][0].lower() + details["msg"][1:]
    return document.problem(key, f"{message}{shown and f' (got{shown[2:]})'}{hint}")


def _mistaken_unit(name: str, value: float, limit: float) -> str:
    """What to say of a value that would be possible in the smaller unit; '' if it would not."""
    for ending, factor, advice in _SMALLER_UNITS:
        if name.endswith(ending) and value / factor <= limit:
            return f"; {advice}"
    return ""


def _known_keys(data: Any, loc: tuple[int | str, ...], model: type[BaseModel]) -> list[str]:
    """Names allowed where `loc` is, read from the model's JSON schema."""
    schema = model.model_json_schema()
    node: dict[str, Any] = schema
    for part in loc[:-1]:
        node = _resolved(schema, node)
        if isinstance(part, int):
            node = node.get("items", {})
        elif part in node.get("properties", {}):
            node = node["properties"][part]
        elif part in node.get("discriminator", {}).get("mapping", {}):
            node = {"$ref": node["discriminator"]["mapping"][part]}
    return list(_resolved(schema, node).get("properties", {}))


def _resolved(schema: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    while "$ref" in node:
        node = schema["$defs"][node["$ref"].rsplit("/", 1)[-1]]
    return node


def did_you_mean(name: str, known: Sequence[str]) -> str:
    """'; did you mean …?', comparing names with and without their unit."""
    bare = {_UNITS.sub("", k): k for k in known}
    close = difflib.get_close_matches(name, known, 1, 0.6)
    if not close:
        close = [bare[b] for b in difflib.get_close_matches(_UNITS.sub("", name), bare, 1, 0.6)]
    return f"; did you mean {close[0]!r}?" if close else f"; known here: {', '.join(known)}"
