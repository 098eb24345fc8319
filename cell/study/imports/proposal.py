"""A proposed mapping as text for a person: every section with what was understood above it."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

from cell.files.yaml_document import yaml_text
from cell.study.imports.finding import Finding, Sure
from cell.study.imports.mapping import Mapping

_WIDTH = 98
#: What is left out where it is not given; of the cable all is shown, to be filled in.
_MARK = {Sure.SAID: "stated", Sure.SEEN: "seen", Sure.GUESSED: "GUESS", Sure.WANTED: "GIVE"}


def mapping_text(mapping: Mapping, findings: Sequence[Finding], command: str) -> str:
    """The mapping file.

    command  that makes the study of it
    """
    lines = [
        "# What `cell import` understood.  Check what says GUESS, fill in what says GIVE.",
        "# Then:",
        f"#     {command}",
    ]
    for key, value in _plain(mapping).items():
        about = [f for f in findings if f.entry.split(".")[0] == key]
        if about or isinstance(value, dict | list):
            lines.append("")
        for finding in about:
            lines += _comment(f"{_MARK[finding.sure]}: {finding.sentence}")
        lines.append(yaml_text({key: value}, inline=isinstance(value, dict | list)).rstrip())
    return "\n".join(lines) + "\n"


def _plain(mapping: Mapping) -> dict[str, Any]:
    """Entries that are given, and those that must be filled in."""
    data = mapping.model_dump(mode="json", exclude_defaults=True)
    cable = mapping.cable.model_dump(mode="json")
    if mapping.cable.connector is None:
        del cable["connector"]
    if mapping.cable.diameter_m is None:
        del cable["diameter_m"]
    else:
        cable = {k: v for k, v in cable.items() if k not in ("width_m", "thickness_m")}
    data["cable"] = cable
    data["gravity_m_per_s2"] = list(mapping.gravity_m_per_s2)
    data["trials"] = [
        {"role": t.role, "start": t.start} | t.model_dump(mode="json", exclude_defaults=True)
        for t in mapping.trials
    ]
    order = [name for name in type(mapping).model_fields if name in data]
    return {name: data[name] for name in order}


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="#   ")
