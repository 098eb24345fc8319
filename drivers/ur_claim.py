"""Claims the command of a UR controller: three integer inputs of RTDE that only one client writes.

Any client may read them.  The controller frees them when the owner's connection ends, however that
ends, so a claim lives as long as the process that holds it.

source  Universal Robots, "Real-Time Data Exchange (RTDE) Guide": the registers 24 to 47 are for
        external clients; a variable that another client has claimed is answered with IN_USE
"""

from __future__ import annotations

import contextlib
import ipaddress
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drivers.rtde_client import InUseError, RtdeClient, RtdeError
from drivers.rtde_wire import Value

#: IPv4 address of the owner's computer, its process, and since when (Unix time, s).
REGISTERS = ("input_int_register_45", "input_int_register_46", "input_int_register_47")
#: With this one ur-rtde, and whatever else is made with it, gives its commands.
COMMANDS = "input_int_register_0"

_RATE_HZ = 125.0
_REMEDY = "end that program, or let it finish, then try again"


@dataclass(frozen=True)
class Commander:
    """The program that commands a controller.

    address  IPv4 address of its computer
    here     whether that is this computer
    since_s  Unix time
    """

    address: str
    pid: int
    since_s: float
    here: bool


class ClaimedError(ConnectionError):
    """Another program commands the controller.  Scenario: a second `cell run` for one arm.

    commander  None = it is no cell, and does not say who it is
    """

    def __init__(self, commander: Commander | None) -> None:
        self.commander = commander
        self.remedy = _REMEDY
        if commander is None:
            who = "a client of RTDE that is no cell, or a fieldbus of the installation"
            self.remedy = (
                "end that program; disable EtherNet/IP, PROFINET and Modbus units that write "
                "registers, at the pendant under Installation"
            )
        else:
            at = "this computer" if commander.here else commander.address
            since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(commander.since_s))
            who = f"process {commander.pid} on {at}, since {since}"
        super().__init__(f"it is commanded already: by {who}")


def claim(host: str, pid: int, further: Sequence[str] = (), *, seconds: float = 2.0) -> RtdeClient:
    """Claim the right to command a controller, until the returned connection is closed.

    pid      process by which others name this program
    further  input variables that must be free, too
    seconds  that any answer may take
    raises   ClaimedError: another program commands it; OSError: it does not answer
    """
    with contextlib.ExitStack() as stack:
        client = stack.enter_context(RtdeClient(host, seconds))
        client.report(REGISTERS, _RATE_HZ)
        try:
            recipe = client.claim(REGISTERS)
        except InUseError:
            client.start()
            raise ClaimedError(_commander(client.newest(seconds), client.address)) from None
        for name in further:
            try:
                client.claim([name])
            except InUseError:
                raise ClaimedError(None) from None
        client.start()
        client.write(recipe, _signed(_number(client.address), pid, int(time.time())))
        client.pause()
        stack.pop_all()
        return client


def _commander(values: Mapping[str, Value], address: str) -> Commander:
    """Whom the registers name."""
    number, pid, since_s = (values.get(name) for name in REGISTERS)
    if not (isinstance(number, int) and isinstance(pid, int) and isinstance(since_s, int)):
        raise RtdeError("the controller does not report who commands it")
    number %= 2**32
    named = str(ipaddress.IPv4Address(number))
    return Commander(named, pid % 2**32, float(since_s % 2**32), number == _number(address))


def _number(address: str) -> int:
    """The last 32 bits of an IP address."""
    return int(ipaddress.ip_address(address)) % 2**32


def _signed(*numbers: int) -> list[int]:
    """Numbers of 32 bits as a register holds them."""
    return [(number + 2**31) % 2**32 - 2**31 for number in numbers]
