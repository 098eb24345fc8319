"""The emulated gripper as a process of its own, on a serial line whose name can be chosen."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path

from drivers.emulators.launch import EmulatorProcess, leave_interrupts_to_parent, serve_requests
from drivers.emulators.robotiq import EmulatedGripper, RobotiqFaults
from drivers.priority import run_in_real_time
from drivers.threads import GuardedThread, end_process

_PRIORITY = 10


@dataclass(frozen=True)
class JawsObserver:
    """State of the emulated gripper, as an observer sees it.

    held  a cable is between the closed jaws
    """

    held: bool
    count: float
    active: bool


class GripperProcess(EmulatorProcess):
    """A gripper in its own process, alive within a `with`; it ends when its parent does.

    link     name of the serial line, a symbolic link that is made; None = the terminal's own name
    address  Modbus slave
    """

    def __init__(self, link: Path | None = None, address: int = 9) -> None:
        super().__init__("gripper", serve, (link, address))
        self._faults = RobotiqFaults()
        self.port = "" if link is None else str(link)

    def started(self, port: str) -> None:
        """Take the name of the serial line."""
        self.port = port

    @property
    def faults(self) -> RobotiqFaults:
        """Active faults; to change them, set a new object."""
        return self._faults

    @faults.setter
    def faults(self, faults: RobotiqFaults) -> None:
        self._faults = faults
        self.request("faults", faults)

    def unplug(self) -> None:
        """Pull the cable, which is also its power: jaws stay, activation goes."""
        self.request("unplug")

    def plug(self) -> None:
        """Put the cable back."""
        self.request("plug")

    def lay_out(self, cable: bool) -> None:
        """Put a cable between the jaws, or take it away."""
        self.request("lay_out", cable)

    def observe(self) -> JawsObserver:
        """Present state of the jaws."""
        state: JawsObserver = self.request("look")
        return state


def serve(door: Connection, link: Path | None, address: int) -> None:
    """Main loop of the emulated gripper's process: run until the connection `door` is closed."""
    leave_interrupts_to_parent()
    run_in_real_time(_PRIORITY)  # a gripper does not slow down when the computer is busy
    try:
        bench = _Emulation(link, address)
    except OSError as error:
        door.send((False, str(error)))
        return
    GuardedThread("door", partial(serve_requests, door, bench.serve_request), end_process).start()
    door.send((True, bench.port))
    threading.Event().wait()


class _Emulation:
    """The gripper, its cable, and the gripper that pulls it."""

    def __init__(self, link: Path | None, address: int) -> None:
        self._link = link
        self._address = address
        self._gripper = EmulatedGripper(address)
        self._gripper.__enter__()
        self.port = self._gripper.port
        if link is not None:
            self._name_it(link)
            self.port = str(link)

    def serve_request(self, name: str, content: object) -> object:
        """Serve a request of the parent."""
        jaws = self._gripper.jaws
        match name, content:
            case "faults", RobotiqFaults() as faults:
                jaws.faults = faults
            case "lay_out", bool(cable):
                jaws.object_count = EmulatedGripper.CABLE_COUNT if cable else None
            case "unplug", _:
                self._gripper.unplug()
            case "plug", _:
                self._plug()
            case "look", _:
                return JawsObserver(jaws.holds, jaws.count, jaws.activation == 3)
            case _:
                raise ValueError(f"{name!r} is not understood")
        return None

    def _plug(self) -> None:
        before = self._gripper
        before.unplug()
        self._gripper = EmulatedGripper(self._address)
        jaws, old = self._gripper.jaws, before.jaws
        jaws.count, jaws.object_count, jaws.faults = old.count, old.object_count, old.faults
        self._gripper.__enter__()
        if self._link is not None:
            self._name_it(self._link)

    def _name_it(self, link: Path) -> None:
        """Raises FileExistsError: there is something else of that name."""
        if link.exists() and not link.is_symlink():
            raise FileExistsError(f"{link} exists and is no link to an emulated line")
        link.parent.mkdir(parents=True, exist_ok=True)
        new = link.with_name(link.name + ".new")
        new.unlink(missing_ok=True)
        new.symlink_to(self._gripper.port)
        new.rename(link)
