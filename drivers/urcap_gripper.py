"""Robotiq-type gripper (2F-85) on a UR's tool flange, by way of Robotiq's URCap.

source  Robotiq, "2F-85 & 2F-140 Instruction Manual for e-Series Universal Robots"; the URCap's
        server on the controller takes lines of text: `SET POS 255` → `ack`, `GET POS` → `POS 230`

The server answers with its last reading of the gripper, and ends an answer with a line feed or
with nothing.
"""

from __future__ import annotations

import socket
from dataclasses import dataclass
from typing import NoReturn

from drivers.interfaces import Clock, DeviceLostError
from drivers.robotiq_gripper import GripperAction, GripperStatus, RobotiqGripper, RobotiqOptions

_CONNECT_S = 2.0
_LOST_REMEDY = (
    "check the gripper's cable at the tool flange, the controller's network, and that Robotiq's "
    "URCap is installed and has found the gripper, then reset"
)


@dataclass(frozen=True)
class UrcapGripperOptions(RobotiqOptions):
    """Connection and motion of the gripper.

    host     the UR controller
    reply_s  time that an answer may take
    """

    host: str
    port: int = 63352
    reply_s: float = 0.07


class UrcapGripper(RobotiqGripper):
    """Robotiq-type gripper that is connected by the server of Robotiq's URCap."""

    def __init__(self, options: UrcapGripperOptions, clock: Clock, name: str = "gripper") -> None:
        super().__init__(options, clock, name, f"{options.host}:{options.port}", _LOST_REMEDY)
        self._options = options
        self._socket: socket.socket | None = None

    def close(self) -> None:
        """Close the connection, leaving the jaws as they are."""
        with self._lock:
            connection, self._socket = self._socket, None
            if connection is not None:
                connection.close()

    def _open(self) -> None:
        options = self._options
        self._socket = socket.create_connection((options.host, options.port), _CONNECT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.settimeout(options.reply_s)

    def _status(self) -> GripperStatus:
        with self._lock:
            # the request before its outcome, so that both are of one motion
            requested, going = self._get("PRE"), bool(self._get("GTO"))
            return GripperStatus(
                activation=self._get("STA"),
                object=self._get("OBJ"),
                going=going,
                fault=self._get("FLT"),
                requested=requested,
                count=self._get("POS"),
            )

    def _act(self, action: GripperAction) -> None:
        request = f"SET ACT {action.active:d} POS {action.count} SPE {action.speed} "
        request += f"FOR {action.force} GTO {action.going:d}"
        answer = self._transact(request)
        if answer != "ack":
            self._lose(f"answers {answer[:80]!r}")

    def _get(self, variable: str) -> int:
        answer = self._transact(f"GET {variable}")
        name, _, value = answer.partition(" ")
        if name != variable or not value.isdecimal():  # `?` without a gripper
            self._lose(f"answers {answer[:80]!r}")
        return int(value)

    def _transact(self, request: str) -> str:
        """The answer to a line; no repetition, as TCP loses nothing.  Raises DeviceLostError."""
        with self._lock:
            if self._socket is None:
                raise DeviceLostError(self.name, "not connected", "connect first")
            answer = ""
            try:
                self._socket.sendall(f"{request}\n".encode())
                while not answer:
                    received = self._socket.recv(1024)
                    if not received:
                        raise ConnectionError("the URCap has closed the connection")
                    answer = received.decode(errors="replace").strip()
            except OSError as error:
                self._lose(str(error), error)
            return answer

    def _lose(self, cause: str, error: OSError | None = None) -> NoReturn:
        self.close()
        raise DeviceLostError(self.name, cause, self._remedy) from error
