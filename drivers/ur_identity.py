"""Which controller answers at an address: its software's version, and its serial number."""

from __future__ import annotations

import socket
from dataclasses import dataclass

from drivers.rtde_client import RtdeClient
from drivers.ur_addresses import DASHBOARD_PORT
from drivers.ur_versions import Version, has_dashboard, version_text


@dataclass(frozen=True)
class Identity:
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


def identify(host: str, seconds: float = 2.0) -> Identity:
    """The controller at an address, asked without ur-rtde: nothing of it can hang or crash.

    seconds  that any answer may take
    raises   OSError: nobody is there, or it does not answer
    """
    with RtdeClient(host, seconds) as client:
        version = client.controller_version()
    number = _serial_number(host, seconds) if has_dashboard(version[:2]) else None
    return Identity(version, number)


def _serial_number(host: str, seconds: float) -> str:
    with (
        socket.create_connection((host, DASHBOARD_PORT), seconds) as dashboard,
        dashboard.makefile("rw", encoding="utf-8", errors="replace", newline="\n") as lines,
    ):
        lines.readline()  # its greeting
        lines.write("get serial number\n")
        lines.flush()
        number = lines.readline().strip()
    if not number.isdecimal():
        raise ConnectionError(f"the dashboard tells no serial number, but {number[:80]!r}")
    return number
