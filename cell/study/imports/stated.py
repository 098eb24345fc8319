"""What the user states about cable and files, and what the files themselves state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from cell.files.input_error import InputError
from cell.study.imports.capture import Capture, ImportFindings

#: Names of the cable's parameters that a file may state; maximum relative rounding error.
OF_CABLE = ("free_length_m", "line_density_kg_per_m", "width_m", "thickness_m", "diameter_m")
_ROUNDED = 0.02


@dataclass(frozen=True)
class Stated:
    """What the user states about cable and files; None = not stated.

    arc_lengths_m  of the markers, from the gripper on
    """

    name: str
    free_length_m: float | None = None
    line_density_kg_per_m: float | None = None
    width_m: float | None = None
    thickness_m: float | None = None
    diameter_m: float | None = None
    rate_hz: float | None = None
    clamp_angle_rad: float | None = None
    arc_lengths_m: tuple[float, ...] | None = None


def with_files(stated: Stated, captures: Sequence[Capture], findings: ImportFindings) -> Stated:
    """Add what files state about the cable where the user does not.

    findings  findings about it are added
    raises    InputError: a file contradicts the user or another file
    """
    for name in OF_CABLE:
        user_value = getattr(stated, name)
        known, source = user_value, f"--{name.rpartition('_m')[0] or name}"
        source = {"line_density_kg_per_m": "--line-density"}.get(name, source.replace("_", "-"))
        for capture in captures:
            value = dict(capture.of_cable).get(name)
            if value is None:
                continue
            if known is not None and abs(value - known) > _ROUNDED * known:
                message = f"states {name} {value:g}, {source} is {known:g}; correct one of them"
                raise InputError.at(capture.path, message)
            if known is None:
                known, source = value, capture.path.name
        if known is not None and user_value is None:
            stated = replace(stated, **{name: known})
            findings.stated(f"cable.{name}", f"{name} is {known:g}, as {source} says")
    return stated
