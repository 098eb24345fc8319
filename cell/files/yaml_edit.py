"""Changes single entries of a YAML text; every other character, comments too, stays as it is."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any, Final

import yaml
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode

from cell.files.input_error import InputError
from cell.files.yaml_document import document_of, dotted

Names = tuple[str, ...]


class Unset(Enum):
    """Value that stands for removing an entry."""

    UNSET = "unset"


UNSET: Final = Unset.UNSET


def edited(path: Path, text: str, changes: Mapping[Names, Any]) -> str:
    """The text with entries set or removed.

    path     of the file, for messages
    changes  keys from the outermost level on → plain value, or `UNSET`
    raises   InputError: the text is no YAML, or this entry cannot be changed alone, as with an
             alias
    """
    mark = "\ufeff" if text.startswith("\ufeff") else ""
    text = text.removeprefix("\ufeff")
    wanted = copy.deepcopy(document_of(text, path).data)
    for key, value in changes.items():
        text = _with(path, text, key, value)
        _set(wanted, key, value)
    if changes and not _has_value(path, text, wanted):
        raise _edit_by_hand(path, tuple(changes)[-1])
    return mark + text


def flow(value: Any) -> str:
    """Plain data in YAML's flow style, in one line."""
    text = yaml.safe_dump(
        [value], default_flow_style=True, width=10_000, sort_keys=False, allow_unicode=True
    )
    return text.strip()[1:-1]


def last_line(node: Node) -> int:
    """Line in which a node ends, without comments after it; lines count from 0."""
    if isinstance(node, ScalarNode) or getattr(node, "flow_style", False):
        end = node.end_mark
        return int(end.line if end.column > 0 or end.line == node.start_mark.line else end.line - 1)
    inside = [n for pair in node.value for n in (pair if isinstance(pair, tuple) else (pair,))]
    there = [n for n in inside if not _is_empty(n)]
    return max((last_line(n) for n in there), default=int(node.start_mark.line))


def _is_empty(node: Node) -> bool:
    """Whether a value has no text: its marks are at the beginning of the next token."""
    return isinstance(node, ScalarNode) and node.style is None and node.value == ""


def _has_value(path: Path, text: str, wanted: Any) -> bool:
    try:
        return bool(document_of(text, path).data == wanted)
    except InputError:
        return False


def _edit_by_hand(path: Path, key: Names) -> InputError:
    message = "cannot be changed by itself as it is written here; edit the file"
    return InputError.at(path, message, key=dotted(key))


def _set(data: Any, key: Names, value: Any) -> None:
    """Change plain data; the section of a removed entry stays, maybe empty."""
    for name in key[:-1]:
        if value is UNSET and not isinstance(data.get(name), dict):
            return
        if not isinstance(data.get(name), dict):
            data[name] = {}
        data = data[name]
    if value is UNSET:
        data.pop(key[-1], None)
    else:
        data[key[-1]] = value


def _with(path: Path, text: str, key: Names, value: Any) -> str:
    try:
        node: Node | None = YAML(typ="safe", pure=True).compose(text)
    except YAMLError as error:
        raise _edit_by_hand(path, key) from error
    for depth, name in enumerate(key):
        if not isinstance(node, MappingNode):
            raise _edit_by_hand(path, key)
        pair = next(((k, v) for k, v in node.value if str(k.value) == name), None)
        if pair is None:
            return text if value is UNSET else _add(text, node, key[depth:], value)
        if depth == len(key) - 1:
            if value is UNSET:
                return _remove(text, node, pair, root=depth == 0)
            return _replace(text, *pair, value)
        nothing = isinstance(pair[1], ScalarNode)  # null, to be a section from now on
        empty = isinstance(pair[1], MappingNode) and not pair[1].value
        if nothing or empty:
            return text if value is UNSET else _replace(text, *pair, _nest(key[depth + 1 :], value))
        node = pair[1]
    raise _edit_by_hand(path, key)


def _nest(key: Names, value: Any) -> Any:
    return _nest(key[:-1], {key[-1]: value}) if key else value


def _replace(text: str, key: Node, node: Node, value: Any) -> str:
    if _is_empty(node):
        colon = text.index(":", key.end_mark.index) + 1
        return f"{text[:colon]} {flow(value)}{text[colon:]}"
    start, end = node.start_mark.index, node.end_mark.index
    if isinstance(node, ScalarNode) and node.style in ("|", ">"):
        end = _end_of_line(text, last_line(node)) - 1
    elif not (isinstance(node, ScalarNode) or getattr(node, "flow_style", False)):  # in one line
        colon = text.index(":", key.end_mark.index) + 1
        first = text[colon : _end_of_line(text, key.start_mark.line)]
        comment = f"  {first.strip()}" if "#" in first else ""
        end = _end_of_line(text, last_line(node))
        return f"{text[:colon]} {flow(value)}{comment}{_line_end(text)}{text[end:]}"
    gap = "" if text[start - 1 : start].isspace() else " "
    return f"{text[:start]}{gap}{flow(value)}{text[end:]}"


def _add(text: str, section: MappingNode, key: Names, value: Any) -> str:
    if section.flow_style:
        entry = flow(_nest(key, value))[1:-1]  # without its braces
        if not section.value:
            at = section.end_mark.index - 1
            return text[:at] + entry + text[at:]
        at = section.value[-1][1].end_mark.index
        return f"{text[:at]}, {entry}{text[at:]}"
    ends, column = _line_end(text), section.start_mark.column
    lines = [f"{' ' * (column + 2 * depth)}{name}:" for depth, name in enumerate(key)]
    lines[-1] += f" {flow(value)}"
    at = _end_of_line(text, last_line(section))
    start = "" if text[:at].endswith(("\n", "\r")) else ends
    apart = ends if column == 0 and len(key) > 1 else ""
    return text[:at] + start + apart + "".join(line + ends for line in lines) + text[at:]


def _remove(text: str, section: MappingNode, pair: tuple[Node, Node], *, root: bool) -> str:
    key, node = pair
    others = [p for p in section.value if p[0] is not key]
    if not others and not root:
        return _empty(text, section)
    if section.flow_style:
        number = next(i for i, p in enumerate(section.value) if p[0] is key)
        if number + 1 < len(section.value):
            after = section.value[number + 1][0].start_mark.index
            return text[: key.start_mark.index] + text[after:]
        before = section.value[number - 1][1].end_mark.index
        return text[:before] + text[node.end_mark.index :]
    start = _start_of_line(text, key.start_mark.line)
    last = key if _is_empty(node) else node
    return text[:start] + text[_end_of_line(text, last_line(last)) :]


def _empty(text: str, section: MappingNode) -> str:
    """The text with a section whose only entry was removed."""
    if section.flow_style:
        return f"{text[: section.start_mark.index]}{{}}{text[section.end_mark.index :]}"
    line = section.start_mark.line
    start, end = _start_of_line(text, line), _end_of_line(text, last_line(section))
    indent = " " * section.start_mark.column
    return f"{text[:start]}{indent}{{}}{_line_end(text)}{text[end:]}"


def _line_end(text: str) -> str:
    return "\r\n" if "\r\n" in text else "\n"


def _start_of_line(text: str, line: int) -> int:
    return sum(map(len, text.splitlines(keepends=True)[:line]))


def _end_of_line(text: str, line: int) -> int:
    """Offset of the beginning of the next line."""
    return _start_of_line(text, line + 1)
