"""Base class of the settings' sections, and types of numbers with their ranges."""

from __future__ import annotations

import ipaddress
import re
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

_LABEL = r"[A-Za-z0-9_](?:[A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?"
_NAME, _NUMBERS = re.compile(rf"{_LABEL}(?:\.{_LABEL})*\.?"), re.compile(r"[0-9.]+")
_LONGEST_NAME = 253

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(gt=0.0, lt=1.0)]


def increasing(pair: tuple[float, float]) -> tuple[float, float]:
    """Validate a range [lower, upper], and return it.  Raises ValueError."""
    if not pair[0] < pair[1]:
        unlike = ", two numbers that differ" if pair[0] == pair[1] else ""
        message = f"[{pair[0]:g}, {pair[1]:g}] is not a range; give [lower, upper]{unlike}"
        raise ValueError(message)
    return pair


def address(host: str) -> str:
    """Validate a host name (RFC 1123) or IP address, and return it.  Raises ValueError."""
    wrong = f"{host!r} is no address; give a name or an IP address, such as 192.168.3.10"
    try:
        ipaddress.ip_address(host)
    except ValueError as error:
        if len(host) > _LONGEST_NAME or not _NAME.fullmatch(host) or _NUMBERS.fullmatch(host):
            raise ValueError(wrong) from error
    return host


def is_loopback(host: str) -> bool:
    """Whether an address or name is reachable from this computer only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name, which may stand for any address
        return False


Host = Annotated[str, Field(min_length=1), AfterValidator(address)]
Range = Annotated[tuple[Finite, Finite], AfterValidator(increasing)]

#: Coordinates in the cell's plane, m; distances and durations of a motion, m and s.
Place = Annotated[float, Field(ge=-10.0, le=10.0)]
Distance = Annotated[float, Field(gt=0.0, le=1.0)]
Duration = Annotated[float, Field(gt=0.0, le=30.0)]
Wait = Annotated[float, Field(ge=0.0, le=30.0)]
#: Lengths of a motion that may be 0; columns and rows of a picture, also beyond its edge.
Length = Annotated[float, Field(ge=0.0, le=1.0)]
Pixels = Annotated[float, Field(ge=-100_000.0, le=100_000.0)]
Exposure = Annotated[float, Field(ge=0.0, le=1.0)]
Angle = Annotated[float, Field(ge=-np.pi, le=np.pi)]
PlaceRange = Annotated[tuple[Place, Place], AfterValidator(increasing)]
PositiveRange = Annotated[tuple[Positive, Positive], AfterValidator(increasing)]


class Section(BaseModel):
    """A section of the settings: immutable, nothing in it but what it names."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)
