"""Finds which user of this computer owns the other end of a local connection."""

from __future__ import annotations

import socket
import struct
from ipaddress import ip_address
from pathlib import Path

#: Tables of connections, the kernel's.
_TABLES = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))

#: IP address and port.
Address = tuple[str, int]


def user_of_peer(peer: Address, here: Address) -> int | None:
    """User number (uid) of the program at the other end of a local TCP connection.

    peer, here  the two ends, as this process sees them
    returns     None = there is no such connection, or this system does not tell
    """
    wanted = [_written(peer), _written(here)]
    for table in _TABLES:
        try:
            lines = table.read_text(encoding="ascii").splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            _, local, remote, *_, user = line.split()[:8]
            if [_canonical(local), _canonical(remote)] == wanted:
                return int(user)
    return None


def _written(address: Address) -> str:
    """An address as `_canonical` writes it."""
    packed = ip_address(address[0].partition("%")[0]).packed
    words = struct.unpack(f"={len(packed) // 4}I", packed)
    return _canonical("".join(f"{word:08X}" for word in words) + f":{address[1]:04X}")


def _canonical(entry: str) -> str:
    """An entry of the tables; one of IPv4 in a table of IPv6 as that of IPv4."""
    mapped = f"{0:016X}{socket.htonl(0xFFFF):08X}"
    return entry.removeprefix(mapped)
