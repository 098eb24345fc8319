"""Which controller answers at an address: its software's version, and its serial number."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.rtde_client import RtdeClient
from drivers.ur_dashboard import Dashboard
from drivers.ur_versions import Version, has_dashboard, version_text


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
    """The controller at an address, asked without ur-rtde: nothing of it can hang or crash.

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
        number = dashboard.ask("get serial number")
    finally:
        dashboard.close()
    if not number.isdecimal():
        raise ConnectionError(f"the dashboard tells no serial number, but {number[:80]!r}")
    return number
