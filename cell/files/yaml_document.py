"""YAML checked against a pydantic model, every complaint with file, line, column and remedy."""

from __future__ import annotations

import io
import json
import math
import re
import reprlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.representer import SafeRepresenter
from ruamel.yaml.scanner import Scanner

from cell.files.input_error import InputError, Problem, did_you_mean
from cell.files.text_file import read_text
from cell.files.words import counted

Key = tuple[str | int, ...]
#: Key and message of a complaint.
Complaint = tuple[Key, str]
Model = TypeVar("Model", bound=BaseModel)

#: Size limit of a file, bytes: settings and studies have some kilobytes.
MAX_BYTES = 200_000
#: Limit of keys and items of a file, counting an alias each time it is used.
MAX_ENTRIES = 100_000
MAX_DEPTH = 20
#: Limit of reported complaints about one file.
MAX_PROBLEMS = 20
#: Characters of a key that are shown.
MAX_KEY = 120

MISSING = "is missing; add it"

#: Messages for kinds of mistakes, in place of terms of JSON.
_IN_YAML = {
    "model_type": "must hold entries, `key: value`",
    "model_attributes_type": "must hold entries, `key: value`",
    "dict_type": "must hold entries, `key: value`",
    "list_type": "must be a list, [a, b, …]",
    "tuple_type": "must be a list, [a, b, …]",
    "string_type": "must be a text; write it in quotes",
    "bool_type": "must be true or false",
}

#: Texts that are right without quotes, by the kind of mistake.
_UNQUOTED = {
    "float_type": re.compile(r"[-+]?\d+(\.\d*)?"),
    "int_type": re.compile(r"[-+]?\d+"),
    "bool_type": re.compile("true|false"),
}

#: Suffix of a key, factor to the smaller unit, message.
_SMALLER_UNITS = (
    ("_kg_per_m", 1e3, "give kg/m, not g/m"),
    ("_m_per_s", 1e3, "give m/s, not mm/s"),
    ("_m_per_s2", 1e3, "give m/s², not mm/s²"),
    ("_m_per_s3", 1e3, "give m/s³, not mm/s³"),
    ("_rad", 57.3, "give radians, not degrees"),
    ("_m", 1e3, "give metres, not millimetres"),
    ("_s", 1e3, "give seconds, not milliseconds"),
)


@dataclass(frozen=True)
class Document:
    """A YAML file as plain data, with the line and column of each key and list item."""

    path: Path
    data: Any
    places: dict[Key, tuple[int, int]]

    def problem(self, key: Key, message: str) -> Problem:
        """The complaint `message` about `key`, placed at it or at its nearest present parent."""
        present = key
        while present not in self.places:
            present = present[:-1]
        return Problem(self.path, *self.places[present], dotted(key), message)

    def problems(self, complaints: Iterable[Complaint]) -> list[Problem]:
        """Several complaints, each at its place."""
        return [self.problem(key, message) for key, message in complaints]


def dotted(key: Key) -> str:
    """('trials', 0, 'role') → 'trials[0].role'."""
    text = ""
    for part in key:
        shown = part if isinstance(part, int) or part.isprintable() else repr(part)
        text += f"[{part}]" if isinstance(part, int) else f".{shown}" if text else f"{shown}"
    return text if len(text) <= MAX_KEY else f"{text[:MAX_KEY]}…"


class _FlatScanner(Scanner):
    """Limits the depth of brackets: the scanner checks all open ones for every character ahead,
    which takes seconds for a thousand of them.
    """

    def fetch_flow_collection_start(self, TokenClass: Any, to_push: str) -> None:
        if len(self.flow_context) > MAX_DEPTH:
            raise RecursionError
        super().fetch_flow_collection_start(TokenClass, to_push)


def _marked(error: YAMLError) -> TypeGuard[MarkedYAMLError]:
    return isinstance(error, MarkedYAMLError)


def read_yaml(path: Path) -> Document:
    """Read a YAML file.

    raises  InputError: the file is missing, is not YAML, has a key twice, or is too large or too
            deeply nested
    """
    return document_of(read_text(path, MAX_BYTES), path)


def document_of(text: str, path: Path) -> Document:
    """Parse the text of a YAML file; errors name `path`.  Raises InputError as `read_yaml`."""
    reader = YAML(typ="safe", pure=True)  # in C it would crash on deep nesting
    reader.Scanner = _FlatScanner
    places: dict[Key, tuple[int, int]] = {(): (1, 1)}
    problems: list[Problem] = []

    def data_of(node: Node, key: Key) -> Any:
        line, column = node.start_mark.line + 1, node.start_mark.column + 1
        if len(key) > MAX_DEPTH:
            message = f"is nested deeper than {MAX_DEPTH} levels, or within itself by an anchor"
            raise InputError.at(path, message, line=line, column=column)
        if len(places) > MAX_ENTRIES:
            message = f"makes more than {MAX_ENTRIES} entries, aliases counted; write fewer"
            raise InputError.at(path, message, line=line, column=column)
        if isinstance(node, MappingNode):
            mapping: dict[str, Any] = {}
            for key_node, value_node in node.value:
                if not isinstance(key_node, ScalarNode):
                    message = "a list or a mapping is no name of an entry; write a word before `:`"
                    raise InputError.at(path, message, line=line, column=column, key=dotted(key))
                name = str(key_node.value)
                place = (key_node.start_mark.line + 1, key_node.start_mark.column + 1)
                if name in mapping:
                    message = f"given twice, first in line {places[(*key, name)][0]}; remove one"
                    problems.append(Problem(path, *place, dotted((*key, name)), message))
                places[(*key, name)] = place
                mapping[name] = data_of(value_node, (*key, name))
            return mapping
        if isinstance(node, SequenceNode):
            for index, item in enumerate(node.value):
                mark = item.start_mark
                places[(*key, index)] = (mark.line + 1, mark.column + 1)
            return [data_of(item, (*key, i)) for i, item in enumerate(node.value)]
        try:
            return reader.constructor.construct_object(node, deep=True)
        except (ValueError, ArithmeticError) as error:
            message = f"cannot be read as a value: {error}; write it otherwise"
            raise InputError.at(path, message, line=line, column=column, key=dotted(key)) from error

    try:
        root = reader.compose(text)
        data = {} if root is None else data_of(root, ())
    except RecursionError as error:
        message = (
            f"is not YAML for this program: nested deeper than {MAX_DEPTH} levels; make it flatter"
        )
        raise InputError.at(path, message, column=1) from error
    except YAMLError as error:
        mark = error.problem_mark or error.context_mark if _marked(error) else None
        line, column = (mark.line + 1, mark.column + 1) if mark else (1, 1)
        cause = str(error.problem if _marked(error) else error).splitlines()[0]
        tabs = "\\t" in cause
        hint = "indent with spaces, not tabs" if tabs else "check indentation, quotes, brackets"
        message = f"is not YAML: {cause}; {hint}"
        raise InputError.at(path, message, line=line, column=column) from error
    if problems:
        raise InputError(problems[:MAX_PROBLEMS])
    return Document(path, data, places)


class _Representer(SafeRepresenter):
    """Writes 1e-05 as 1.0e-05: without a point, YAML 1.1 takes it for a text."""

    def represent_float(self, data: float) -> ScalarNode:
        node: ScalarNode = super().represent_float(data)
        if "." not in node.value:
            node.value = node.value.replace("e", ".0e")
        return node


_Representer.add_representer(float, _Representer.represent_float)


def yaml_text(data: Mapping[str, Any], *, inline: bool = False) -> str:
    """Plain data as YAML, in their order.

    inline  lists and sections that hold no others are written in one line
    """
    writer: Any = YAML(typ="safe", pure=True)
    writer.Representer = _Representer
    writer.default_flow_style = None if inline else False
    writer.width = 98
    writer.sort_base_mapping_type_on_output = False
    writer.allow_unicode = True
    stream = io.StringIO()
    writer.dump(dict(data), stream)
    return stream.getvalue()


def validate(document: Document, model: type[Model]) -> Model:
    """The document as `model`.

    raises  InputError: every complaint of the model, each at its place, unknown keys with the
            nearest known one; numbers must be numbers, not `true` or a quoted text
    """
    if not isinstance(document.data, dict):
        raise InputError([document.problem((), "must hold `key: value` lines")])
    try:
        # JSON's strict mode: that of Python types would refuse lists for tuples.
        return model.model_validate_json(json.dumps(document.data, default=str), strict=True)
    except ValidationError as error:
        errors = error.errors()[: 5 * MAX_PROBLEMS]
        schema = model.model_json_schema()
        if (wrong_format := _of_another_kind(document, schema)) is not None:
            raise InputError([wrong_format]) from error
        problems = [_problem(document, details, schema) for details in errors]
        # A mistyped key is one mistake, not an unknown key and a missing one.
        meant = {
            (p.key.rpartition(".")[0], p.message.rpartition("did you mean ")[2]) for p in problems
        }
        problems = [
            p
            for p in problems
            if p.message != MISSING
            or (p.key.rpartition(".")[0], f"{p.key.rpartition('.')[2]!r}?") not in meant
        ]
        # An entry of a union type has a complaint of each alternative.
        entries: dict[tuple[int, str], Problem] = {}
        for p in problems:
            first = entries.get((p.line, p.key))
            message = p.message if first is None else f"{first.message}; or {p.message}"
            entries[p.line, p.key] = replace(p, message=message)
        problems = [*entries.values()]
        problems.sort(key=lambda p: (p.line, p.column or 0))
        if len(problems) > MAX_PROBLEMS:
            more = error.error_count() - MAX_PROBLEMS
            problems[MAX_PROBLEMS:] = [document.problem((), f"and {more} more; mend these first")]
        raise InputError(problems) from error


def _of_another_kind(document: Document, schema: dict[str, Any]) -> Problem | None:
    """Problem of a file of a different format; its keys are then no mistakes."""
    wanted = schema.get("properties", {}).get("format", {}).get("const")
    stated = document.data.get("format")
    unknown = [k for k in document.data if k not in schema.get("properties", {})]
    if stated is not None and stated != wanted:
        expected = "settings of a cell" if wanted is None else f"a file of `format: {wanted}`"
        return document.problem(("format",), f"is {reprlib.repr(stated)}; give {expected}")
    if wanted is not None and stated is None and len(unknown) > 1:
        named = ", ".join(str(k)[:MAX_KEY] for k in unknown[:3])
        message = f"is no file of `format: {wanted}`, and has {named}, which that does not know"
        return document.problem((), f"{message}; give such a file")
    return None


def _problem(document: Document, details: ErrorDetails, schema: dict[str, Any]) -> Problem:
    kind, context = details["type"], details.get("ctx", {})
    # A union puts a tag or a type into the location; the file does not have it there.
    key: Key = ()
    for part in details["loc"]:
        if (*key, part) in document.places or (part == details["loc"][-1] and kind == "missing"):
            key = (*key, part)
    match kind:
        case "extra_forbidden" | "unexpected_keyword_argument":
            known = _known_keys(schema, details["loc"])
            name = str(details["loc"][-1])
            sections = _sections_with(schema, name)
            advice = did_you_mean(name, known)
            if sections and "did you mean" not in advice:
                advice = f"; write it under {' or '.join(sections)}"
            return document.problem(key, f"unknown key{advice}")
        case "missing":
            return document.problem(key, MISSING)
        case "value_error" | "assertion_error":
            message = str(context.get("error", details["msg"]))
            return document.problem(key if key in document.places else key[:-1], message)
        case "union_tag_not_found":
            return document.problem((*key, "kind"), MISSING)
        case "union_tag_invalid":
            tag, tags = str(context["tag"]), str(context["expected_tags"])
            guess = did_you_mean(tag, [t.strip(" '") for t in tags.split(",")])
            return document.problem((*key, "kind"), f"{tag!r} is not one of {tags}{guess}")
    value = details["input"]
    shown = "" if isinstance(value, dict | list) else f" = {reprlib.repr(value)}"
    hint = ""
    if isinstance(value, str) and re.match(r"^[-+0-9.]+\s*[a-zA-Z°]", value):
        hint = "; write the number alone, its unit is in the key's name"
    if isinstance(value, str) and re.fullmatch(r"[-+]?\d+,\d+", value):
        hint = f"; write a decimal point, {value.replace(',', '.')}"
    if isinstance(value, str) and kind in _UNQUOTED and _UNQUOTED[kind].fullmatch(value):
        hint = "; write it without quotes"
    bound = next((context[name] for name in ("le", "lt", "ge", "gt") if name in context), None)
    if bound is not None and isinstance(value, int | float) and abs(value) > abs(float(bound)):
        limit = abs(float(bound))
        name = next((part for part in reversed(key) if isinstance(part, str)), "")
        hint = _mistaken_unit(name, abs(value), limit)
    message = _IN_YAML.get(kind, details["msg"][0].lower() + details["msg"][1:])
    if kind in ("too_short", "too_long"):
        least, most = (context.get(f"{end}_length") for end in ("min", "max"))
        needed = f"at least {least}" if kind == "too_short" else f"at most {most}"
        message = f"has {counted(len(value), 'item')}, needs {needed}"
    if value is None:
        return document.problem(key, "is empty; give a value")
    if isinstance(value, float) and not math.isfinite(value):
        message, hint = "must be a finite number", "; give one"
    return document.problem(key, f"{message}{shown and f' (got{shown[2:]})'}{hint}")


def _mistaken_unit(name: str, value: float, limit: float) -> str:
    """Message about a value that would be valid in the smaller unit; '' if it would not."""
    for ending, factor, advice in _SMALLER_UNITS:
        if name.endswith(ending) and value <= limit * factor:
            return f"; {advice}"
    return ""


def _known_keys(schema: dict[str, Any], loc: tuple[int | str, ...]) -> list[str]:
    """Names allowed at `loc`, from the model's JSON schema."""
    node: dict[str, Any] = schema
    for part in loc[:-1]:
        node = _resolved(schema, node)
        if isinstance(part, int):
            node = node.get("items", {})
        elif part in node.get("properties", {}):
            node = node["properties"][part]
        elif part in node.get("discriminator", {}).get("mapping", {}):
            node = {"$ref": node["discriminator"]["mapping"][part]}
        elif isinstance(node.get("additionalProperties"), dict):
            node = node["additionalProperties"]
    return list(_resolved(schema, node).get("properties", {}))


def _sections_with(schema: dict[str, Any], name: str) -> list[str]:
    """Sections of the first level that have a key of this name."""
    sections = schema.get("properties", {}).items()
    return [s for s, node in sections if name in _resolved(schema, node).get("properties", {})]


def _resolved(schema: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    """The schema of an entry itself; of an optional section that of the section."""
    while "$ref" in node or "anyOf" in node:
        if "$ref" in node:
            node = schema["$defs"][node["$ref"].rsplit("/", 1)[-1]]
        else:
            node = next((one for one in node["anyOf"] if one.get("type") != "null"), {})
    return node
