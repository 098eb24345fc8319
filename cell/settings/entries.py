"""All entries that settings may have, for a form: explanation, limits, default, present value.

They come from the models' JSON schema, so that nothing is stated twice.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from typing import Any

from cell.files.yaml_edit import UNSET, Names, Unset, flow
from cell.settings.model import Settings

Schema = Mapping[str, Any]

#: Suffix of a key → unit that a person reads.
_UNITS = {
    "_kg_per_m": "kg/m",
    "_m_per_s": "m/s",
    "_m_per_s2": "m/s²",
    "_m_per_s3": "m/s³",
    "_n_m2": "N·m²",
    "_rad": "rad",
    "_px": "px",
    "_hz": "Hz",
    "_days": "d",
    "_gb": "GB",
    "_mb": "MB",
    "_h": "h",
    "_n": "N",
    "_m": "m",
    "_s": "s",
}
_BOUNDS = (("exclusiveMinimum", ">"), ("minimum", "≥"), ("exclusiveMaximum", "<"), ("maximum", "≤"))
_USED, _NOT_USED = "used", "not used"


class SettingsForm(StrEnum):
    """How a person enters a value: as a choice, as plain text, or as YAML in one line."""

    CHOSEN = "chosen"
    TEXT = "text"
    YAML = "yaml"


@dataclass(frozen=True)
class SettingsEntry:
    """An entry of the settings.

    key      names from the outermost level on
    given    whether the file has it; if not, `value` is the default
    value    plain data; `UNSET` = there is neither a value nor a default
    default  `UNSET` = required
    choices  label → value, for a choice
    section  whether it is a section that may be left out as a whole
    """

    key: Names
    explained: str
    limits: str
    unit: str
    form: SettingsForm
    choices: Mapping[str, Any]
    given: bool
    value: Any
    default: Any | Unset
    section: bool = False

    @property
    def name(self) -> str:
        """The key, dotted."""
        return ".".join(self.key)

    def shown(self, value: Any) -> str:
        """A value as a person enters it."""
        if value is UNSET:
            return ""
        if self.form is SettingsForm.CHOSEN:
            return next((w for w, v in self.choices.items() if v == value), flow(value))
        if self.form is SettingsForm.TEXT and isinstance(value, str):
            return value
        return flow(value)


def entries(data: Mapping[str, Any]) -> tuple[SettingsEntry, ...]:
    """All entries that settings with this plain data may have, in the models' order."""
    return tuple(_of_section(_schema(), (), data, UNSET))


def change_for(data: Mapping[str, Any], key: Names, value: Any) -> dict[Names, Any]:
    """Edits of the file that set an entry to `value`.

    A section that the file does not have yet is filled with its own defaults.
    """
    for depth in range(1, len(key)):
        section = _at(data, key[:depth])
        if isinstance(section, Mapping):
            continue
        known = {e.key: e for e in entries(data)}
        inside = [e for k, e in known.items() if k[:depth] == key[:depth] and len(k) > depth]
        # defaults of the section that differ from the defaults of its entries
        own = {e.key: e.value for e in inside if e.key != key and e.value != _own_default(e.key)}
        return {**{k: v for k, v in own.items() if v is not UNSET}, key: value}
    return {key: value}


@cache
def _schema() -> Schema:
    return Settings.model_json_schema()


def _own_default(key: Names) -> Any:
    """Default of an entry in an empty section; `UNSET` = there is none, or no such entry."""
    node: Schema = _schema()
    for name in key[:-1]:
        node = _section_of(node.get("properties", {}).get(name, {}), {}) or {}
    return node.get("properties", {}).get(key[-1], {}).get("default", UNSET)


def _at(data: Any, key: Names) -> Any:
    for name in key:
        data = data.get(name) if isinstance(data, Mapping) else None
    return data


def _of_section(
    section: Schema, key: Names, data: Mapping[str, Any], default: Any
) -> Iterator[SettingsEntry]:
    """Entries of a section; `default`: of the section as a whole, where the file lacks it."""
    names = sorted(section["properties"], key=lambda n: n != "kind")
    for name in names:
        node = section["properties"][name]
        usual = node.get("default", UNSET)
        if isinstance(default, Mapping):
            usual = default.get(name, usual)
        present = name in data
        value = data[name] if present else usual
        inner = _section_of(node, value)
        optional = any(o.get("type") == "null" for o in node.get("anyOf", ()))
        if _section_of(node, {}) is not None and optional:
            yield _switch((*key, name), node, present, value, usual)
            if value is None:
                continue
        if inner is None:
            yield _leaf((*key, name), node, present, value, usual)
        else:
            inside = value if present and isinstance(value, Mapping) else {}
            tag = node.get("discriminator", {}).get("propertyName")
            if tag is not None:
                kinds = node["discriminator"]["mapping"]
                yield SettingsEntry(
                    (*key, name, tag), node.get("description", ""), "", "", SettingsForm.CHOSEN,
                    {k: k for k in kinds}, tag in inside, inside.get(tag, UNSET), UNSET,
                )  # fmt: skip
                rest = {k: v for k, v in inner["properties"].items() if k != tag}
                inner = {**inner, "properties": rest}
            yield from _of_section(inner, (*key, name), inside, UNSET if present else usual)


def _section_of(node: Schema, value: Any) -> Schema | None:
    """Schema of an entry that is a section; None = it is no section."""
    options = [node, *node.get("anyOf", ())]
    kinds = node.get("discriminator", {}).get("mapping")
    if kinds is not None:
        kind = (
            value.get(node["discriminator"]["propertyName"]) if isinstance(value, Mapping) else ""
        )
        options = [{"$ref": kinds.get(kind) or next(iter(kinds.values()))}]
    for option in options:
        if "$ref" in option:
            definition = _schema()["$defs"][option["$ref"].rsplit("/", 1)[-1]]
            if "properties" in definition:
                return definition  # type: ignore[no-any-return]
    return None


def _switch(key: Names, node: Schema, present: bool, value: Any, usual: Any) -> SettingsEntry:
    section = _section_of(node, {}) or {}
    words = (section.get("description", ""), node.get("description", ""))
    explained = "\n".join(_sentence(w) for w in words if w)
    used = {} if value is None or value is UNSET else value
    choices = {_USED: used, _NOT_USED: None}
    return SettingsEntry(
        key, explained, "", "", SettingsForm.CHOSEN, choices, present, value, usual, True
    )


def _leaf(key: Names, node: Schema, present: bool, value: Any, usual: Any) -> SettingsEntry:
    options = node.get("anyOf", [node])
    types = [o.get("type") for o in options]
    choices: dict[str, Any] = {}
    for option in options:
        words = option.get("enum", [option["const"]] if "const" in option else [])
        choices.update({str(w): w for w in words})
    if types == ["boolean"]:
        choices = {"true": True, "false": False}
    only = all(o.get("type") == "null" or "enum" in o or "const" in o for o in options)
    chosen = bool(choices) and (only or types == ["boolean"])
    if chosen and "null" in types:
        choices["null"] = None
    text = set(types) <= {"string", "null"} and not chosen
    form = SettingsForm.CHOSEN if chosen else SettingsForm.TEXT if text else SettingsForm.YAML
    limits = "; ".join(filter(None, (_limits(o) for o in options)))
    unit = next((u for ending, u in _UNITS.items() if key[-1].endswith(ending)), "")
    explained = _sentence(node.get("description", ""))
    return SettingsEntry(key, explained, limits, unit, form, choices, present, value, usual)


def _limits(node: Schema) -> str:
    words = [f"{sign} {node[k]:g}" for k, sign in _BOUNDS if k in node]
    for inner in (*node.get("prefixItems", ())[:1], node.get("items")):
        if isinstance(inner, Mapping):
            words += [_limits(inner), ", ".join(map(str, inner.get("enum", ())))]
    return ", ".join(filter(None, words))


def _sentence(text: str) -> str:
    return " ".join(text.split("\n\n")[0].split())
