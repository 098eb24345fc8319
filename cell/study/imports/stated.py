"""What the user states about cable and files, and what the files themselves state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from cell.files.input_error import InputError
from cell.study.imports.capture import Capture, ImportFindings

#: Numbers of the cable that a file may state by these names; by so much they may be rounded.
OF_CABLE = ("free_length_m", "line_density_kg_per_m", "width_m", "thickness_m", "diameter_m")
_ROUNDED = 0.02


@dataclass(frozen=True)
class Stated:
    """What the user states about cable and files; None = not stated."""

    name: str
    free_length_m: float | None = None
    line_density_kg_per_m: float | None = None
    width_m: float | None = None
    thickness_m: float | None = None
    diameter_m: float | None = None
    rate_hz: float | None = None


def with_files(stated: Stated, captures: Sequence[Capture], findings: ImportFindings) -> Stated:
    """With what files state of the cable and the user does not.

    findings  those about it are added
    raises    InputError: a file contradicts the user or another file
    """
    for name in OF_CABLE:
        of_user = getattr(stated, name)
        known, whose = of_user, f"--{name.rpartition('_m')[0] or name}"
        whose = {"line_density_kg_per_m": "--line-density"}.get(name, whose.replace("_", "-"))
        for capture in captures:
            value = dict(capture.of_cable).get(name)
            if value is None:
                continue
            if known is not None and abs(value - known) > _ROUNDED * known:
                message = f"states {name} {value:g}, {whose} is {known:g}; correct one of them"
                raise InputError.at(capture.path, message)
            if known is None:
                known, whose = value, capture.path.name
        if known is not None and of_user is None:
            stated = replace(stated, **{name: known})
            findings.said(f"cable.{name}", f"{name} is {known:g}, as {whose} says")
    return stated
