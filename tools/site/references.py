"""References of the manual in Markdown, generated from the code."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import Enum
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import typer.core
import yaml
from typer.main import get_command
from typing_extensions import is_protocol

import cell
from cell.cli import PANELS, app
from cell.files.yaml_edit import UNSET, flow
from cell.identify.identified import Identified
from cell.lab.data import results
from cell.lab.data.check import Check
from cell.lab.data.rules import DEFAULT_RULES
from cell.lab.line.learning_checks import GATES, LEARNING, LineRules
from cell.lab.search.fitted_model import FittedModel
from cell.lab.verdict.checks import CHECKS
from cell.lab.verdict.doubts import MEANINGS
from cell.settings.entries import SettingsEntry, entries
from cell.settings.model import Settings
from cell.settings.plugged import PluggedArm, PluggedCamera, PluggedGripper
from cell.settings.section import Section
from cell.study.import_checks import IMPORT_NOTES, IMPORT_REFUSALS, IMPORT_SHAPE
from cell.study.record_checks import RECORD_NOTES, STUDY_NOTES
from cell.study.trial_checks import TRIAL_NOTES, TRIAL_REFUSALS
from cell.study.wrench import FORCE_NOTES
from drivers import interfaces
from tools.shipped_settings import FAKE

#: Packages whose classes and functions are described.
OURS = ("cell", "drivers")
_GROUPS = (
    *(IMPORT_REFUSALS, IMPORT_SHAPE, TRIAL_REFUSALS, TRIAL_NOTES, IMPORT_NOTES),
    *(FORCE_NOTES, RECORD_NOTES, STUDY_NOTES),
)
#: All checks of a study's data, without duplicates.
DATA_CHECKS = tuple({check.name: check for group in _GROUPS for check in group}.values())
#: Codes of warnings in files of versions before.
_OLD_CODES = {
    "heldout_insensitive": "unconfirmed",
    "weakly_identified": "barely_seen",
    "possibly_omitted": "suspected",
    "prior_driven": "prior_only",
    "wider_law": "other_law",
}


# --- commands ------------------------------------------------------------------------------------


def commands() -> str:
    """Every command with its options, in the order of `cell --help`."""
    root = get_command(app)
    assert isinstance(root, typer.core.TyperGroup)
    parts = []
    for panel, names in PANELS.items():
        parts.append(f"## {panel}")
        for name in names:
            command = root.commands[name]
            parts += _command(f"cell {name}", command)
            for sub, inner in getattr(command, "commands", {}).items():
                parts += _command(f"cell {name} {sub}", inner)
    return "\n\n".join(parts)


def _command(name: str, command: Any) -> Iterator[str]:
    yield f"### {name}"
    yield from inspect.cleandoc(command.help).split("\n\n")
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    shown = [a.metavar or a.name.upper() for a in arguments]
    wanted = [s if a.required else f"[{s}]" for s, a in zip(shown, arguments, strict=True)]
    yield f"```text\n{' '.join([name, *wanted, '[OPTIONS]'])}\n```"
    lines = [f"- `{s}`: {a.help or ''}" for s, a in zip(shown, arguments, strict=True)]
    for option in command.params:
        if option.param_type_name == "option" and not option.hidden and option.name != "help":
            names = ", ".join(f"`{o}`" for o in (*option.opts, *option.secondary_opts))
            default = option.default
            plain = isinstance(default, (str, int, float, Path)) and not isinstance(default, bool)
            shown = plain and str(default) and option.show_default is True
            usual = f" Default: `{default}`." if shown else ""
            lines.append(f"- {names}: {option.help or ''}{usual}")
    yield "\n".join(lines)


# --- settings ------------------------------------------------------------------------------------


def settings() -> str:
    """Every entry of the settings: unit, limits, default, meaning, an example."""
    examples = [yaml.safe_load(p.read_text("utf-8")) for p in sorted(FAKE.parent.glob("*.yaml"))]
    parts, section = [], ""
    for title, entry in all_settings():
        if title != section:
            parts.append(f"\n## {title}\n")
            section = title
            parts.append(_section_text(entry.key[:1]))
        kind = title.partition("kind: ")[2]
        alike = [e for e in examples if not kind or _at(e, (entry.key[0], "kind")) == kind]
        parts.append(_setting(entry, alike))
    return "\n".join(parts)


def all_settings() -> Iterator[tuple[str, SettingsEntry]]:
    """Heading and entry, with every optional section and every kind of device."""
    data: dict[str, Any] = {}
    while unused := [e.key for e in entries(data) if e.section and e.value is None]:
        _set(data, unused[0], {})
    kinds = {e.key[:-1]: e.choices for e in entries(data) if e.key[-1] == "kind"}
    for entry in entries(data):
        device = entry.key[:1]
        if device not in kinds:
            yield entry.key[0], entry
        elif entry.key[1:] == ("kind",):
            for kind in kinds[device]:
                variant = {**data, device[0]: {"kind": kind}}
                used = [e for e in entries(variant) if e.key[:1] == device and e.section]
                for section in used:
                    _set(variant, section.key, {})
                inside = (e for e in entries(variant) if e.key[:1] == device)
                yield from ((f"{device[0]}, kind: {kind}", e) for e in inside)


def _set(data: dict[str, Any], key: Sequence[str], value: Any) -> None:
    for name in key[:-1]:
        data = data.setdefault(name, {})
    data[key[-1]] = value


def _section_text(key: Sequence[str]) -> str:
    """Descriptions of a section and its required subsections, as paragraphs."""
    schema = Settings.model_json_schema()
    node = schema["properties"][key[0]]
    inner = schema["$defs"].get(node.get("$ref", "").rpartition("/")[2], {})
    lines = [inner.get("description", "").partition("\n\n")[0]]
    for name, part in inner.get("properties", {}).items():
        if "$ref" in part and part.get("description"):
            lines.append(f"`{key[0]}.{name}`: {part['description']}")
    return "\n\n".join(" ".join(line.split()) for line in lines if line) + "\n"


def _setting(entry: SettingsEntry, examples: Sequence[Any]) -> str:
    """One entry as a line of a list."""
    facts = [entry.unit, entry.limits]
    if entry.choices and not entry.section:
        facts.append(" or ".join(f"`{word}`" for word in entry.choices))
    facts.append("required" if entry.default is UNSET else "")
    if entry.default is not UNSET and not entry.section:
        facts.append(f"default `{flow(entry.default)}`")
    example = next((v for v in (_at(e, entry.key) for e in examples) if v is not None), None)
    if not (example is None or isinstance(example, dict) or example == entry.default):
        facts.append(f"e.g. `{flow(example)}`")
    stated = "; ".join(fact for fact in facts if fact)
    return f"- `{entry.name}`" + (f" ({stated})" if stated else "") + f": {entry.explained}"


def _at(node: Any, keys: Sequence[str]) -> Any:
    for key in keys:
        node = node.get(key) if isinstance(node, dict) else None
    return node


# --- checks --------------------------------------------------------------------------------------


def checks() -> str:
    """The checks of a diagnosis, of learning from many cables, and of a study's data."""
    of_line = "\n".join(_table((*LEARNING, *GATES), LineRules()))
    parts = ("## Of a diagnosis", diagnosis_checks(), "## Of learning from many cables", of_line)
    return "\n\n".join((*parts, "## Of a study's data", data_checks()))


def _table(table: Sequence[Check[Any]], rules: object) -> list[str]:
    """Checks: their limits, messages of a failure, and reasons of the limits."""
    lines = ["| check | question | passes if | if not |", "|---|---|---|---|"]
    for c in table:
        limit = f"{c.unit} {c.passes} {getattr(rules, c.limit):g}"
        lines.append(f"| `{c.name}` | {c.question} | {limit} | `{c.failing}` |")
    lines += ["", "What a check that fails says, and why its limit is what it is:", ""]
    for c in table:
        code = _OLD_CODES.get(c.name)
        old = f" In files of earlier versions: `{code}`." if code else ""
        place = f'<span id="{c.name}"></span>'
        lines.append(f"- {place}`{c.name}`: {c.failed} Judged by {c.reason}.{old}")
    return lines


def diagnosis_checks() -> str:
    """The checks of a diagnosis, and its other warnings."""
    lines = _table(CHECKS, DEFAULT_RULES)
    lines += ["", "Warnings that come of no check:", ""]
    lines += ["| code | what was observed | verdict |", "|---|---|---|"]
    for code, (meaning, verdict) in MEANINGS.items():
        lines.append(f"| `{code}` | {meaning} | {f'`{verdict}`' if verdict else '–'} |")
    return "\n".join(lines)


def data_checks() -> str:
    """The checks of a study's data: question, statistic, limit, message of a failure."""
    lines = ["| check | question | if not |", "|---|---|---|"]
    lines += [f"| `{c.name}` | {c.question} | {c.outcome} |" for c in DATA_CHECKS]
    lines += ["", "The statistic and its limit, and what a check that fails says:", ""]
    for c in DATA_CHECKS:
        sentence = re.sub(r"\{[^}]*\}", "…", f"{c.says} {c.remedy}".strip())
        lines.append(f"- `{c.name}`: {c.statistic}; limit {c.limit}. It says: {sentence}.")
    return "\n".join(lines)


# --- from Python ---------------------------------------------------------------------------------


def api() -> str:
    """Functions of `import cell`, its results, and the interfaces of devices."""
    chapters = {
        "Functions and data": [getattr(cell, name) for name in cell.__all__],
        "Parts of results": [FittedModel, Identified, *_classes(results)],
        "Interfaces of devices": _classes(interfaces),
        "Settings of a device of another package": [PluggedArm, PluggedCamera, PluggedGripper],
    }
    parts = []
    for title, things in chapters.items():
        parts += [f"## {title}", *(_description(thing) for thing in things)]
    return "\n\n".join(parts)


def _classes(module: ModuleType) -> list[type]:
    """Public classes of a module, in its order."""
    own = (v for k, v in vars(module).items() if inspect.isclass(v) and not k.startswith("_"))
    return [thing for thing in own if thing.__module__ == module.__name__]


def _description(thing: Any) -> str:
    """Signature and docstring of a function, or of a class with its members of this project."""
    name = thing.__name__
    parts = [f"### {name}", _signature(name, thing), _docstring(thing)]
    if inspect.isclass(thing) and issubclass(thing, Section):
        rows = (
            f"- `{key}`{'' if field.is_required() else f' (default `{field.default}`)'}: "
            + " ".join((field.description or "").split())
            for key, field in thing.model_fields.items()
        )
        parts.append("\n".join(rows))
    elif inspect.isclass(thing):
        for key, member in inspect.getmembers_static(thing):
            read = {property: "fget", cached_property: "func"}.get(type(member), "")
            function = getattr(member, read) if read else member
            ours = inspect.isfunction(function) and function.__module__.startswith(OURS)
            if ours and not key.startswith("_"):
                sign = "" if read else _signature(key, function)
                parts += [f"#### {name}.{key}", sign, _docstring(function)]
    return "\n\n".join(part for part in parts if part)


def _signature(name: str, thing: Any) -> str:
    if inspect.isclass(thing) and (issubclass(thing, (Enum, Section)) or is_protocol(thing)):
        return ""
    text = str(inspect.signature(thing)).replace("'", "")
    text = re.sub(r"<function (\w+) at \w+>", r"\1", text)
    text = re.sub(r"\b(?:[A-Za-z_]\w*\.)+(\w+)", r"\1", text)
    if len(name) + len(text) > 80:
        text = re.sub(r"\((.*)\)( ->.*)?$", lambda m: _break_lines(m[1]) + (m[2] or ""), text)
    return f"```python\n{name}{text}\n```"


def _break_lines(parameters: str) -> str:
    """Parameters of a signature, one a line."""
    depth, lines = 0, [""]
    for sign in parameters:
        depth += (sign in "[(") - (sign in "])")
        if sign == "," and not depth:
            lines.append("")
        else:
            lines[-1] += sign
    return "(\n" + "".join(f"    {line.strip()},\n" for line in lines) + ")"


def _docstring(thing: Any) -> str:
    """The sentences as text; the table of parameters verbatim."""
    paragraphs = (inspect.getdoc(thing) or "").split("\n\n")
    parts = []
    for paragraph in paragraphs:
        table = any(
            re.match(r"\S+( \S+)?(?<!\.)  +\S| {3,}\S", line) for line in paragraph.splitlines()
        )
        parts.append(f"```text\n{paragraph}\n```" if table else paragraph)
    return "\n\n".join(parts)


REFERENCES: Mapping[str, Callable[[], str]] = {
    "commands": commands,
    "settings": settings,
    "checks": checks,
    "api": api,
}
