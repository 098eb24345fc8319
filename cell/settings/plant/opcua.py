"""What the settings say of the OPC UA server."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from cell.settings.section import Host, Section, is_loopback


class OpcUa(Section):
    """OPC UA server (`cell opcua`): the cell's states, counters and commands after PackML.

    Beyond this computer it demands encryption and a user's name; `cell user add` adds users.
    """

    listen: Host = "127.0.0.1"
    """Address at which it listens; 0.0.0.0 = all of this computer.  At a loopback address clients
    may also come without encryption and without a name."""
    port: Annotated[int, Field(ge=1, le=65535)] = 4840
    """TCP port; 4840 is that of OPC UA."""
    folder: Path = Path("opcua")
    """Folder of the server's key and certificate, and of the clients' certificates that it
    trusts."""
    name: Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[^/:]+$")] = "CableCell"
    """Of the object that stands for this cell among those of the server."""

    @property
    def is_loopback(self) -> bool:
        """Whether nobody beyond this computer can reach it."""
        return is_loopback(self.listen)
