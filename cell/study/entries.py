"""Plausibility of a study's entries: wrong units, and contradictions between entries."""

from __future__ import annotations

import re
import reprlib
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from cell.cable.geometry import Cable, Connector
from cell.files.words import counted
from cell.files.yaml_document import Complaint, Key

#: Limits beyond which a unit is assumed to be wrong.
MAX_LENGTH_M = 10.0
MAX_CONNECTOR_M, MAX_CONNECTOR_KG = 1.0, 10.0
MAX_GRAVITY_M_PER_S2 = 100.0
MAX_NOISE_FRACTION = 0.2
#: Largest shift of a marker along a straight line: farther along, the cable is curved (0.02 mm on
#: one of 0.1 m with a radius as long).
MAX_ARC_STD_FRACTION = 0.02

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class SectionPart(BaseModel):
    """A section of a file; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ConnectorEntry(SectionPart):
    """A rigid body at the cable's end; its default inertia is that of a rod."""

    mass_kg: Positive
    length_m: Positive
    inertia_kg_m2: Positive | None = None


class CableSection(SectionPart):
    """The cable; null = to be filled in."""

    free_length_m: Positive | None = None
    line_density_kg_per_m: Positive | None = None
    width_m: Positive | None = None
    thickness_m: Positive | None = None
    diameter_m: Positive | None = None
    connector: ConnectorEntry | None = None


def _trial_name(name: str) -> str:
    """A name that a folder may have on any computer.  Raises ValueError."""
    if re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}", name):
        return name
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", plain).strip("_.-")[:100] or "trial_1"
    raise ValueError(
        f"{reprlib.repr(name)} names a folder: it must begin with a letter A to Z or a digit, and "
        f"hold only these, '_', '.' and '-', 100 at most; write {plain!r}, and rename the folder"
    )


TrialName = Annotated[str, AfterValidator(_trial_name)]


def datasheet_of(cable: Mapping[str, Any]) -> Cable | None:
    """The datasheet; a round cable becomes a strip of its width and area; None: neither or both.

    cable  entries of the file
    """
    across = cable.get("width_m"), cable.get("thickness_m")
    diameter_m = cable.get("diameter_m")
    if diameter_m is not None and across == (None, None):
        across = diameter_m, np.pi / 4.0 * diameter_m
    elif diameter_m is not None:
        return None
    width_m, thickness_m = across
    if width_m is None or thickness_m is None:
        return None
    length_m, density = cable["free_length_m"], cable["line_density_kg_per_m"]
    return Cable(length_m, density, width_m, thickness_m, _connector_of(cable.get("connector")))


def _connector_of(entry: Mapping[str, float] | None) -> Connector | None:
    if entry is None:
        return None
    rod = Connector.rod(entry["mass_kg"], entry["length_m"])
    inertia = entry.get("inertia_kg_m2", rod.inertia_kg_m2)
    return Connector(entry["mass_kg"], entry["length_m"], inertia)


def implausible_entries(
    cable: Mapping[str, Any],
    datasheet: Cable | None,
    gravity_m_per_s2: tuple[float, float],
    arc_length_m: Sequence[float],
    noise_std_m: float | None,
    arc_length_std_m: Sequence[float] = (),
) -> Iterator[Complaint]:
    """Complaints about entries that the schema cannot check.

    cable         entries of the file
    datasheet     of these; None = they are not those of one cable
    arc_length_m  in the order of the file; arc_length_std_m likewise, or one for all
    """
    yield from _of_cable(cable, datasheet)
    yield from _of_gravity(gravity_m_per_s2)
    length_m = datasheet.length_m if datasheet else cable["free_length_m"]
    for i, arc in enumerate(arc_length_m):
        if not 0.0 <= arc <= length_m * (1 + 1e-9):
            message = f"{arc:g} m is not on the cable, 0 … {length_m:g} m; count from the gripping "
            yield ("markers", "arc_length_m", i), f"{message}point, in metres"
    sign = np.sign(np.diff(arc_length_m))
    for i in map(int, np.flatnonzero((sign != sign[:1]) | (sign == 0.0))):
        message = (
            f"{arc_length_m[i + 1]:g} m after {arc_length_m[i]:g} m: markers cross or coincide; "
        )
        yield ("markers", "arc_length_m", i + 1), f"{message}order them along the cable"
    yield from _of_arc_length_std(arc_length_std_m, len(arc_length_m), length_m)
    if noise_std_m and noise_std_m > MAX_NOISE_FRACTION * length_m:
        message = f"{noise_std_m:g} m is beyond {MAX_NOISE_FRACTION:g} of the free length; "
        yield ("noise_std_m",), f"{message}give metres, not millimetres"


def _of_arc_length_std(
    values: Sequence[float], markers: int, length_m: float
) -> Iterator[Complaint]:
    """One value per marker, or one for all; not negative, and not far beyond its marker."""
    key = ("markers", "arc_length_std_m")
    if len(values) not in (0, 1, markers):
        message = f"has {counted(len(values), 'value')} for {counted(markers, 'marker')}; "
        yield key, f"{message}give one for each, or one number"
        return
    limit_m = MAX_ARC_STD_FRACTION * length_m
    for i, std_m in enumerate(values):
        where: Key = (*key, i) if len(values) > 1 else key
        if std_m < 0.0:
            yield where, f"{std_m:g} m is negative; give 0 where the place is exact"
        elif std_m > limit_m:
            message = (
                f"{std_m:g} m is beyond {limit_m:g} m, {MAX_ARC_STD_FRACTION:g} of the cable; "
            )
            yield where, f"{message}measure where the marker is, in metres"


def _of_cable(cable: Mapping[str, Any], datasheet: Cable | None) -> Iterator[Complaint]:
    names = ("free_length_m", "width_m", "thickness_m", "diameter_m")
    too_long: list[Complaint] = [
        (
            ("cable", name),
            f"{cable[name]:g} m is beyond {MAX_LENGTH_M:g} m; give metres, not millimetres",
        )
        for name in names
        if (cable.get(name) or 0.0) > MAX_LENGTH_M
    ]
    yield from too_long
    if datasheet is None:
        section = [n for n in names[1:] if cable.get(n)]
        message = f"{' and '.join(section) or 'no section'} given; a flat cable has width_m and "
        yield ("cable",), f"{message}thickness_m, a round one diameter_m alone"
    of_connector = [*_of_connector(cable.get("connector"))]
    yield from of_connector
    implausible = datasheet.implausible() if datasheet else None
    if implausible and not too_long and not of_connector:
        yield ("cable", "line_density_kg_per_m"), implausible


def _of_connector(entry: Mapping[str, float] | None) -> Iterator[Complaint]:
    """An implausibly long connector, or one whose inertia exceeds that of masses at its ends."""
    if entry is None:
        return
    mass_kg, length_m = entry["mass_kg"], entry["length_m"]
    inertia, most = entry.get("inertia_kg_m2", 0.0), mass_kg * length_m**2 / 4.0
    key = ("cable", "connector")
    if length_m > MAX_CONNECTOR_M:
        message = f"{length_m:g} m is beyond {MAX_CONNECTOR_M:g} m; give metres, not millimetres"
        yield (*key, "length_m"), message
    elif mass_kg > MAX_CONNECTOR_KG:
        yield (
            (*key, "mass_kg"),
            f"{mass_kg:g} kg is beyond {MAX_CONNECTOR_KG:g} kg; give kg, not g",
        )
    elif inertia > most * (1.0 + 1e-9):
        message = f"{inertia:g} kg·m² is beyond {most:.3g} kg·m², all of its mass at its ends; "
        message += "give it about its middle, in kg·m², or leave it out"
        yield (*key, "inertia_kg_m2"), message


def _of_gravity(gravity_m_per_s2: tuple[float, float]) -> Iterator[Complaint]:
    key, vector = ("gravity_m_per_s2",), list(gravity_m_per_s2)
    if np.hypot(*gravity_m_per_s2) > MAX_GRAVITY_M_PER_S2:
        yield key, f"{vector} is beyond {MAX_GRAVITY_M_PER_S2:g} m/s²; give m/s², not mm/s²"
    elif gravity_m_per_s2[1] > 0.0:
        yield key, f"{vector} points up, for y is up; give [0.0, -9.81], and all y upwards"
