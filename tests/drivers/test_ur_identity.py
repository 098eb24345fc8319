"""Which controller answers; the usual case is that of the driver's own tests."""

from __future__ import annotations

import socket

import pytest

from drivers import ur_dashboard, ur_identity


@pytest.mark.parametrize(
    "answer", [b"", b"\n", b"could not understand: 'get serial number'\n", b"\xff\n"]
)
def test_what_is_no_serial_number_is_none(monkeypatch, answer) -> None:
    """A controller that starts up: two of them would pass for the same one."""
    ours, theirs = socket.socketpair()
    theirs.sendall(b"Connected: Universal Robots Dashboard Server\n" + answer)
    theirs.shutdown(socket.SHUT_WR)
    monkeypatch.setattr(ur_dashboard.socket, "create_connection", lambda *_: ours)
    with theirs, pytest.raises(OSError, match=r"tells no serial number|has closed"):
        ur_identity._serial_number("127.0.0.1", 1.0)
