"""Table of tested UR controller versions, and whether the driver may run with a version.

source  ur-rtde 1.6.5: its source (`rtde_control_interface.cpp`), its README, its issue 334;
        Universal Robots Client Library: `doc/polyscope_compatibility.rst`
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from drivers.rtde_client import RtdeClient
from drivers.ur_dashboard import Dashboard

Version = tuple[int, int]  # major, minor

#: From this version on the software is PolyScope X: it has no dashboard server.
FIRST_WITHOUT_DASHBOARD = 10


class SupportLevel(StrEnum):
    """Level of support of a version."""

    PROVED = "proved"  # the driver's own tests run with it
    EXPECTED = "expected to work"  # ur-rtde 1.6.5 provides for it
    UNKNOWN = "unknown"
    BREAKS = "known not to work"


@dataclass(frozen=True)
class VersionRange:
    """Range of versions with the same support, first and last included."""

    first: Version
    last: Version
    known: SupportLevel
    says: str


_NEWEST = (99, 999)
#: Ascending, without a gap: every version is in one of them.
RANGES = (
    VersionRange(
        (0, 0),
        (5, 5),
        SupportLevel.BREAKS,
        "its dashboard server tells neither remote control nor the serial number",
    ),
    VersionRange((5, 6), (5, 21), SupportLevel.PROVED, "the driver is proved with it"),
    VersionRange(
        (5, 22),
        (5, 22),
        SupportLevel.UNKNOWN,
        "ur-rtde once could not start its program on 5.22 (its issue 334), and nobody says that "
        "1.6.5 can",
    ),
    VersionRange(
        (5, 23),
        (5, 23),
        SupportLevel.EXPECTED,
        "ur-rtde 1.6.5 has the registers and program lines of 5.23",
    ),
    VersionRange(
        (5, 24),
        (5, 25),
        SupportLevel.UNKNOWN,
        "ur-rtde 1.6.5 treats it as 5.23; nothing else is known",
    ),
    VersionRange(
        (5, 26), (5, 26), SupportLevel.EXPECTED, "ur-rtde 1.6.5 has lines of its program for 5.26"
    ),
    VersionRange(
        (5, 27), (9, 999), SupportLevel.UNKNOWN, "it is newer than what ur-rtde 1.6.5 knows"
    ),
    VersionRange(
        (10, 0),
        (10, 9),
        SupportLevel.BREAKS,
        "ur-rtde 1.6.5 starts its program on PolyScope X from 10.10 on only",
    ),
    VersionRange(
        (10, 10),
        (10, 13),
        SupportLevel.EXPECTED,
        "ur-rtde 1.6.5 starts its program on PolyScope X without a dashboard server",
    ),
    VersionRange(
        (10, 14), _NEWEST, SupportLevel.UNKNOWN, "it is newer than what ur-rtde 1.6.5 knows"
    ),
)

_PROVED = next(r for r in RANGES if r.known is SupportLevel.PROVED)
_FIRST, _LAST = (".".join(map(str, v)) for v in (_PROVED.first, _PROVED.last))
_INSTALL = f"install PolyScope {_FIRST} to {_LAST}"
_INSTALL_X = "install PolyScope X 10.10 or newer"


@dataclass(frozen=True)
class Refusal:
    """Refusal of a version: cause, and remedy for a person."""

    cause: str
    remedy: str


def known_of(version: Version) -> VersionRange:
    """Entry of the table for a version."""
    return next(r for r in RANGES if version <= r.last or r.last == _NEWEST)


def is_proved(version: Version) -> bool:
    """Whether a version is proved: the driver runs with it without `arm.allow_version`."""
    return known_of(version).known is SupportLevel.PROVED


def refusal(version: Version, allowed: Version | None) -> Refusal | None:
    """Why a controller is refused; None = the driver may run with it.

    allowed  version for which the user takes responsibility; None = none
    """
    entry = known_of(version)
    name = version_text(version)
    if entry.known is SupportLevel.PROVED or (
        entry.known is not SupportLevel.BREAKS and version == allowed
    ):
        return None
    cause = f"the controller runs PolyScope {name}, {entry.known}: {entry.says}"
    if entry.known is SupportLevel.BREAKS:
        return Refusal(cause, _INSTALL_X if version >= (10, 0) else _INSTALL)
    if allowed is not None:
        cause += f"; arm.allow_version allows {version_text(allowed)}"
    return Refusal(
        cause,
        f'{_INSTALL}; or take responsibility for {name}: write `allow_version: "{name}"` into the '
        "section `arm` and make a dry run at low speed, `cell run --dry-run --speed 0.1`",
    )


def has_dashboard(version: Version) -> bool:
    """Whether the controller has a dashboard server."""
    return version[0] < FIRST_WITHOUT_DASHBOARD


def version_text(version: tuple[int, ...]) -> str:
    """A version as it is written: 5.26."""
    return ".".join(map(str, version))


def read_version(text: str) -> tuple[int, int, int, int]:
    """Version (major, minor, bugfix, build) from text such as 5.12.2.1101534; missing parts are 0.

    raises  ValueError: it is no version
    """
    parts = [int(part) for part in text.split(".")]
    if not 2 <= len(parts) <= 4:
        raise ValueError(f"{text!r} is no version; an example is 5.12.2.1101534")
    major, minor, bugfix, build = (*parts, 0, 0)[:4]
    return major, minor, bugfix, build


@dataclass(frozen=True)
class ControllerIdentity:
    """A controller.

    version        major, minor, bugfix, build
    serial_number  as the dashboard tells it; None = PolyScope X, which has none
    """

    version: tuple[int, int, int, int]
    serial_number: str | None

    @property
    def release(self) -> Version:
        """Major and minor version."""
        return self.version[:2]

    @property
    def version_text(self) -> str:
        """The version as it is written: 5.26.0.12345."""
        return version_text(self.version)


def identify(host: str, seconds: float = 2.0) -> ControllerIdentity:
    """Identity of the controller at an address, requested without ur-rtde, with short timeouts.

    seconds  that any answer may take
    raises   OSError: nobody is there, or it does not answer
    """
    with RtdeClient(host, seconds) as client:
        version = client.controller_version()
    number = _serial_number(host, seconds) if has_dashboard(version[:2]) else None
    return ControllerIdentity(version, number)


def _serial_number(host: str, seconds: float) -> str:
    dashboard = Dashboard(host, seconds)
    try:
        number = dashboard.request("get serial number")
    finally:
        dashboard.close()
    if not number.isdecimal():
        raise ConnectionError(f"the dashboard tells no serial number, but {number[:80]!r}")
    return number
